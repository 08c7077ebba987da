"""A user: a person's hands in their gloves, and their JSON file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, cast, get_args, overload

import numpy as np

from gloves.fit import Attachment, GloveFit, mean_hand, nominal_fit
from gloves.hand_files import write_hand
from gloves.layout import MarkerLayout, list_layouts, load_layout, stored_layout
from handsim._checks import check_choice, check_type, shown_value
from handsim.errors import DAMAGE, ArgumentError, FileError
from handsim.files.inputs import checksum, read_bytes
from handsim.files.outputs import write_text, writing
from handsim.hand.model import HandModel
from handsim.hand.shape import SIDES, HandShape, Side
from track.calibration.user_calibration import Calibration
from track.config import HandOrigin, SizeChoice
from track.kinematics.pose_spread import SKELETON_NUMBERS, HandErrors
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler

AnyGlove = MarkerLayout | str | Path
AnyLabeler = Labeler | str | Path | None
"""A labeler, what `load_labeler` reads, or None for the one of the glove."""
SCHEMA: Final = 1
MEASURED: Final = "auto, "
"""Prefix of the notes on measured hands; the size follows."""
AS_MEASURED: Final = ", as measured"
"""Suffix of a calibration's sentence on a hand that stayed as measured."""
ATTACHMENT_ARRAYS: Final = {"points": "f8", "normals": "f8", "bone_indices": None, "bone_weights": "f8"}
"""Stored arrays of an attachment and their types; None keeps the type, so that fractional indices fail."""


class UserError(FileError):
    """A user's file cannot be read or written."""


@dataclass(frozen=True, slots=True, eq=False)
class User(Sequence[GloveFit]):
    """A person's hands in their gloves, as a sequence: measured, calibrated or read from a file.

    Raises:
        ArgumentError: There is no hand, two are of one side, or they wear different gloves.
    """

    hands: tuple[GloveFit, ...]
    """One or two hands with the same markers; lengths in [m], angles in [rad]."""
    notes: str = ""
    """Origin of the hands, in words."""
    calibrations: tuple[Calibration, ...] = ()
    """Results of `calibrate` for each hand, with its fit to held-out frames; not stored in files."""
    errors: Mapping[Side, HandErrors] = field(default_factory=dict)
    """Errors that calibration left in each hand; standard deviations of its poses follow from them."""
    checksum: str = ""
    """SHA-256 of the file that it was read from; empty if there is none."""

    def __post_init__(self) -> None:
        expected = "a left hand, a right hand, or one of each in its glove"
        if not isinstance(self.hands, Sequence):
            raise ArgumentError(f"hands is {shown_value(self.hands)}, expected {expected}")
        object.__setattr__(self, "hands", tuple(self.hands))
        for hand in self.hands:
            if not isinstance(hand, GloveFit):
                raise ArgumentError(f"one of hands is {shown_value(hand)}, expected a GloveFit")
        sides = [hand.side for hand in self.hands]
        if not sides or len(set(sides)) < len(sides):
            raise ArgumentError(f"hands are {sides}, expected a left hand, a right hand, or one of each")
        if any(hand.layout.names != self.layout.names for hand in self.hands):
            raise ArgumentError("the hands wear different gloves, expected the same markers on all")

    @property
    def layout(self) -> MarkerLayout:
        """The glove of the first hand."""
        return self.hands[0].layout

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the hands in order."""
        return tuple(hand.side for hand in self.hands)

    def origin(self, side: Side) -> HandOrigin:
        """Origin of the hand of a side: a named size, measured, or calibrated."""
        return hand_origin(self.notes, side)

    def is_calibrated(self, side: Side) -> bool:
        """Whether the hand of a side was calibrated to the person."""
        return self.origin(side) == "calibrated"

    def __str__(self) -> str:
        """Length and breadth of the hands [mm]; one pair if both are alike."""
        return " and ".join(dict.fromkeys(map(size_words, self.hands)))

    @overload
    def __getitem__(self, index: int) -> GloveFit: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[GloveFit, ...]: ...
    def __getitem__(self, index: int | slice) -> GloveFit | tuple[GloveFit, ...]:
        """One hand or several."""
        return self.hands[index]

    def __len__(self) -> int:
        """Number of hands."""
        return len(self.hands)

    def of_sides(self, sides: Sequence[Side]) -> User:
        """The user's hands of these sides, in their order.

        Raises:
            ArgumentError: The user has no such hand.
        """
        known = {hand.side: hand for hand in self.hands}
        for side in sides:
            check_choice(side, known, noun="hand")
        return dataclasses.replace(self, hands=tuple(known[side] for side in sides))

    def of_side(self, side: Side | None = None) -> GloveFit:
        """The hand of a side; if not given, the right hand or the only one.

        Raises:
            ArgumentError: The user has no such hand.
        """
        return self.of_sides(["right" if "right" in self.sides else "left"] if side is None else [side])[0]

    def export(self, path: str | Path, side: Side | None = None, *, actuators: bool = False) -> None:
        """Write a hand in the flat pose for other programs, in meters, radians and kilograms.

        Args:
            path: The file: .xml (MuJoCo, with the markers as sites), .urdf, .osim (OpenSim, with the markers)
                or .glb (rigged skin, y up).
            side: Which hand; if not given, the right hand or the only one.
            actuators: Whether the .xml gets position servos.

        Raises:
            ArgumentError: The file's ending is unknown, or the user has no such hand.
            OSError: The file cannot be written.
        """
        write_hand(Path(path), self.of_side(side), actuators=actuators)

    def save(self, path: str | Path) -> None:
        """Write hands and gloves as JSON; `load_user` reads the same numbers again.

        Args:
            path: The file, usually `user.json`.

        Raises:
            ArgumentError: The hands wear the same markers in gloves of different design.
            UserError: The file cannot be written.
        """
        if any(hand.layout != self.layout for hand in self.hands):
            raise ArgumentError("the hands wear different gloves, expected one layout for all")
        errors = stored_errors(self)
        units = "metres, radians, errors in millionths" if errors else "metres, radians"
        content = {
            "schema": SCHEMA,
            "units": f"{units}; every hand is described as a right one, its markers as they are",
            "notes": self.notes,
            "glove": self.layout.record(),
            "hands": [_to_json(hand) for hand in self.hands],
            **({"errors": errors} if errors else {}),
        }
        with writing(path, UserError):
            write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def size_words(hand: GloveFit) -> str:
    """Length and breadth of a hand in millimeters, in words."""
    return f"{1e3 * hand.shape.length:.0f} x {1e3 * hand.shape.breadth:.0f} mm"


def hand_like(hand: GloveFit) -> GloveFit:
    """A right hand of the same length and breadth, of mean proportions in the glove as designed."""
    return mean_hand(hand.shape.length, hand.shape.breadth, hand.layout)


def hand_origin(notes: str, side: Side) -> HandOrigin:
    """Origin of the hand of a side, from the notes of its user.

    Hands that could not be measured have a named size; one that calibration did not improve is measured.
    """
    size = _size_of(notes)
    if size.removeprefix(MEASURED) in get_args(SizeChoice):
        return "named"
    left = any(sentence.startswith(f"{side} hand: ") for sentence in _left_as_measured(notes))
    return "measured" if left or size else "calibrated"


def _size_of(notes: str) -> str:
    """The size with which the notes begin, named or measured; empty if they begin with something else."""
    first = notes.split("; ", maxsplit=1)[0]
    return first if first.startswith(MEASURED) or first in get_args(SizeChoice) else ""


def _left_as_measured(notes: str) -> list[str]:
    """Sentences of the notes on hands that stayed as measured."""
    return [sentence for sentence in notes.split("; ") if sentence.endswith(AS_MEASURED)]


def nominal_user(layout: MarkerLayout, size: str, sides: str | Sequence[str] | None) -> User:
    """Hands of one of the five sizes in gloves as designed: of these sides, or of all that the glove has."""
    sides = layout.sides[::-1] if sides is None else sides  # the right hand comes first
    sides = (sides,) if isinstance(sides, str) else tuple(map(str, sides))
    if not sides or len(set(sides)) < len(sides) or not set(sides) <= set(SIDES):
        raise ArgumentError(f"hands are '{' '.join(sides)}', expected right, left, or one of each")
    return User(tuple(nominal_fit(layout, size, cast("Side", side)) for side in sides), size)


def as_user(hands: User | Sequence[GloveFit] | str | Path) -> User:
    """Make a user of hands or of a user's file; return a user as it is.

    The notes of a file's user are the file's name and the origin of the hands.
    """
    if isinstance(hands, str | Path):
        user = load_user(hands)
        notes = [_size_of(user.notes), Path(hands).name, *_left_as_measured(user.notes)]
        return dataclasses.replace(user, notes="; ".join(filter(None, notes)))
    if not isinstance(hands, User):
        check_type("hands", hands, Sequence, "a User, hands in their gloves (GloveFit), or a user's file")
        return User(tuple(hands))
    return hands


def load_user(path: str | Path) -> User:
    """Hands and gloves of a user, from the JSON file that `handsim calibrate` or `User.save` wrote.

    Args:
        path: The file, usually `user.json`; lengths are in [m], angles in [rad].

    Returns:
        The user; `hands` holds one or two hands in their gloves.

    Raises:
        UserError: The file does not exist, is not a user's file, has another schema, or is damaged.
    """
    check_type("path", path, (str, Path), "the path of a user's file, .json")
    path = Path(path)
    try:
        # A user of two hands takes 40,000 bytes.
        content = json.loads(read_bytes(path, error=UserError, max_bytes=1 << 24))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a user's file of handsim calibrate (.json): no JSON text") from error
    if not isinstance(content, dict) or "schema" not in content:
        raise UserError(f"{path}: not a user's file: it has no schema number")
    if content["schema"] != SCHEMA:
        raise UserError(f"{path}: a user's file of schema {content['schema']!r}, expected {SCHEMA}")
    try:
        layout = stored_layout(content["glove"])
        hands = tuple(_from_json(hand, layout) for hand in content["hands"])
        errors = read_errors(content.get("errors", {}), hands)
        return User(hands, str(content.get("notes", "")), errors=errors, checksum=checksum(path))
    except DAMAGE as error:
        raise UserError(f"{path}: a damaged user's file: {_damage_words(error)}") from error


def stored_errors(user: User) -> dict[Side, dict[str, Any]]:
    """Errors that calibration left in a user's hands, as JSON in millionths of their units."""
    return {
        side: {name: np.rint(1e6 * values).astype(int).tolist() for name, values in kept._asdict().items()}
        for side, kept in user.errors.items()
        if side in user.sides
    }


def read_errors(stored: Any, hands: Sequence[GloveFit]) -> dict[Side, HandErrors]:
    """Inverse of `stored_errors` for these hands; a `ValueError` if the data are invalid."""
    errors = {}
    for hand in hands:
        if hand.side in stored:
            mine = stored[hand.side]
            values = [1e-6 * np.array(mine[name], dtype=np.float64) for name in HandErrors._fields]
            count = max(values[0].size // SKELETON_NUMBERS, 1)
            shapes = [(SKELETON_NUMBERS, count), (hand.layout.num_markers, 3, count)]
            if [one.shape for one in values] != shapes or not all((abs(one) <= 1.0).all() for one in values):
                raise ValueError(f"errors of the {hand.side} hand are not small numbers")
            errors[hand.side] = HandErrors(*values)
    return errors


def _damage_words(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"the key {error} is missing"
    if isinstance(error, TypeError | AttributeError | OverflowError):  # rather than Python's message
        return "a value is of another kind than handsim calibrate writes"
    return " ".join(str(error).splitlines())


def _to_json(hand: GloveFit) -> dict[str, Any]:
    shape = dataclasses.asdict(hand.model.shape)
    values = {name: np.asarray(value).tolist() for name, value in shape.items()}
    if not hand.model.shape.arch.any():  # as files without an arch have it
        del values["arch"]
    markers = {name: np.asarray(getattr(hand.attachment, name)).tolist() for name in ATTACHMENT_ARRAYS}
    return {"shape": values, "markers": markers}


def _from_json(stored: dict[str, Any], layout: MarkerLayout) -> GloveFit:
    fields = {field.name for field in dataclasses.fields(HandShape)}
    shape: dict[str, Any] = stored["shape"]
    if set(shape) | {"arch"} != fields:
        raise ValueError(f"a hand's shape has the keys {', '.join(map(str, shape))}")
    values: dict[str, Any] = {
        name: np.asarray(value, dtype=np.float64) if isinstance(value, list) else value
        for name, value in shape.items()
    }
    markers = {name: np.asarray(stored["markers"][name], dtype) for name, dtype in ATTACHMENT_ARRAYS.items()}
    return GloveFit(HandModel(HandShape(**values)), Attachment(layout, **markers))


def labeler_of(worn: MarkerLayout, labeler: AnyLabeler) -> Labeler:
    """Load a labeler for the markers of a glove; see `load_labeler` for errors."""
    return load_labeler(worn if hasattr(labeler, "label_frames") else designed_glove(worn), labeler)


def designed_glove(worn: MarkerLayout) -> MarkerLayout:
    """The shipped layout of a worn, perhaps slipped glove, because labelers know that layout."""
    if worn.name not in list_layouts():
        return worn
    designed = load_layout(worn.name)
    bones = [[(marker.name, marker.bone) for marker in glove.markers] for glove in (designed, worn)]
    return designed if bones[0] == bones[1] else worn
