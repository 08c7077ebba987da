"""Settings of tracking, and the hands, labeler and bodies that they name."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self, get_args

import numpy as np

from gloves.fit import GloveFit, attach
from gloves.layout import MarkerLayout, load_layout
from handsim._checks import check_choice, check_type, make_settings, shown_value
from handsim.errors import ArgumentError, HandSimWarning
from handsim.hand.shape import NUM_QPOS, SIDES, Side
from track.config import BOTH, Size, TrackerConfig
from track.hand_check import check_hands, check_scale
from track.hand_size import fit_size
from track.inputs import AnyGlove, AnyLabeler, designed_glove
from track.rigid_body import AnyBody, RigidTemplate, load_bodies
from track.streams.frame_source import StreamedFrame
from track.tracker import Tracker
from track.user import MEASURED, User, as_user, nominal_user
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler

AnyHands = User | Sequence[GloveFit] | Sequence[Side] | str | Path
"""A user, hands in their gloves, or the path of a user's file; or sides, whose hands are to be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackSettings:
    """How hands are tracked: keyword arguments of `track_capture`, recorded in the `settings` of a take."""

    glove: AnyGlove | None = None
    """Marker layout, or its shipped name or the path of its .toml file; when None that of `hands`, or dense19
    for hands that are measured."""
    hands: AnyHands = BOTH
    """A user, hands in their gloves or the path of a user's file; or sides."""
    size: Size = "auto"
    """Size of hands of which only the sides are given: XS, S, M, L, XL, or auto, which measures it, and the
    proportions, in the capture."""
    labeler: AnyLabeler = None
    """A labeler, or what `load_labeler` reads; that of the glove when None."""
    bodies: Sequence[AnyBody] = ()
    """Rigid bodies beside the hands: templates, names of handsim's objects, or .toml files."""
    calibrate: bool = False
    """Whether to track twice: hands are calibrated on the first take, as `track.calibrate` does it, and the
    second is made with those that fit better so."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    """Settings of the tracker itself, distances in [m] and times in [s]."""

    @classmethod
    def of(cls, settings: Self | None, options: Mapping[str, Any]) -> Self:
        """Settings with some that are given by name.

        Raises:
            ArgumentError: It is something else, or a name is unknown.
        """
        if settings is not None:
            check_type("settings", settings, cls, f"a {cls.__name__}; its fields can be given by name")
        return make_settings(cls, "setting of tracking", options, default=settings)

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Self:
        """The settings that the `settings` of a take record.

        What was given as an object is recorded by its name, and is the thing of that name here.
        """
        known = {one.name for one in dataclasses.fields(cls)}
        values = {name: value for name, value in record.items() if name in known}
        if "tracker" in values:
            values["tracker"] = make_settings(TrackerConfig, "setting of the tracker", values["tracker"])
        return cls(**values)

    def record(self) -> dict[str, Any]:
        """Itself as JSON; objects by their names."""
        return {
            "glove": _name_of(self.glove),
            "hands": _hands_of(self.hands),
            "size": self.size,
            "labeler": _name_of(self.labeler),
            "bodies": [_name_of(body) for body in self.bodies],
            "calibrate": self.calibrate,
            "tracker": dataclasses.asdict(self.tracker),
        }


def _name_of(thing: Any) -> str | None:
    """What settings call a thing that has a name, or a path, or only a type."""
    if thing is None:
        return None
    return str(thing) if isinstance(thing, str | Path) else str(getattr(thing, "name", type(thing).__name__))


def _hands_of(hands: AnyHands) -> str | list[str]:
    """Sides, or the path of a user's file; sides alone of hands that were given as objects."""
    if isinstance(hands, str | Path):
        return str(hands)
    return [hand.side if isinstance(hand, GloveFit) else str(hand) for hand in hands]


USUAL_GLOVE: Final = "dense19"
USUAL_SIZE: Final = "M"
"""The size of hands that could not be measured."""
_HANDS: Final = "a User, GloveFits, the path of a user's file, or sides"
_SHOWN: Final = 0.8  # share of one hand's markers in a frame in which its size can be measured
_HAND_SPACING: Final = 0.5  # [m] between the hands of the warm-up
_UNSURE_EXTENT: Final = 0.12  # of clouds that no labeler is sure of [m]


@dataclass(frozen=True, slots=True, eq=False)
class TrackerSetup:
    """Everything that a tracker needs but frames to measure its hands in."""

    user: User
    """The hands; of the usual size where they are to be measured."""
    is_measured: bool
    """Whether their size is to be measured."""
    labeler: Labeler
    """Labeler of their glove."""
    bodies: tuple[RigidTemplate, ...]
    config: TrackerConfig
    settings: dict[str, Any]
    """What makes a take, as JSON."""

    @classmethod
    def of(cls, settings: TrackSettings) -> Self:
        """The setup that settings name.

        Raises:
            ArgumentError: Hands and size do not go together, a hand wears another glove, a size or a body is
                unknown, or a name is given twice.
            UserError: A user's file cannot be read.
            LayoutError: The glove is unknown, or does not fit a hand.
            WeightsError: The labeler is unknown, or knows other markers.
        """
        user, is_measured = choose_user(settings.glove, settings.hands, settings.size)
        templates = load_bodies(settings.bodies)
        network = load_labeler(designed_glove(user.layout), settings.labeler)
        record = settings.record()
        record |= {"glove": record["glove"] or user.layout.name, "user": user.notes or str(user)}
        return cls(user, is_measured, network, templates, settings.tracker, record)

    @property
    def fewest_points(self) -> float:
        """Points of a frame in which hands can be measured."""
        return _SHOWN * self.user.layout.num_markers

    def measured(self, frames: Sequence[StreamedFrame]) -> TrackerSetup:
        """The setup with the hands as measured in some frames, if they are to be measured.

        Raises:
            ArgumentError: See `check_hands`, which warns of hands that do not fit.
        """
        check_scale(frames, self.user, self.labeler)
        if not self.is_measured:
            named = self.user.notes in get_args(Size)
            options = ("--hands", "--glove") if named else ()
            check_hands(frames, self.user, self.labeler, options=options)
            return self
        user = measured_user(frames, self.user.layout, self.user.sides, self.labeler)
        check_hands(frames, user, self.labeler)
        settings = {**self.settings, "user": user.notes}
        return dataclasses.replace(self, user=user, is_measured=False, settings=settings)

    def tracker(self) -> Tracker:
        """A tracker of the hands and bodies."""
        return Tracker(self.user, self.labeler, self.bodies, self.config)


def measured_user(
    frames: Sequence[StreamedFrame], layout: MarkerLayout, sides: Sequence[Side], labeler: Labeler
) -> User:
    """The user whose hands are in some frames; of size M, with a warning, if no hand is found."""
    found = found_user(frames, layout, sides, labeler)
    if found is not None:
        return found
    warnings.warn(
        f"no hand was found to measure its size; size {USUAL_SIZE} is used, or name a size",
        HandSimWarning,
        stacklevel=3,
    )
    return nominal_user(layout, USUAL_SIZE, sides)


def found_user(
    frames: Sequence[StreamedFrame], layout: MarkerLayout, sides: Sequence[Side], labeler: Labeler
) -> User | None:
    """The user whose hands are in some frames, measured; None if no hand is found."""
    size = fit_size(frames, layout, sides, labeler)
    return None if size is None else User(size.hands(sides), f"{MEASURED}{size}")


def as_designed(user: User) -> tuple[GloveFit, ...]:
    """The hands of a user in the glove as it was designed."""
    return tuple(attach(hand.layout, hand.model) for hand in user)


def warm_up(hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Load the tracker's kernels, which the first run on a machine compiles for half a minute.

    Otherwise the first frames of a stream would have to wait.
    """
    tracker = Tracker(hands, labeler)
    qpos = np.zeros((len(hands), NUM_QPOS))
    qpos[:, 0], qpos[:, 3] = _HAND_SPACING * np.arange(len(hands)), 1.0
    points = np.concatenate(
        [
            hand.attachment.centers(hand.model, hand.model.forward_kinematics(row[None]))[0]
            for hand, row in zip(hands, qpos, strict=True)
        ]
    )
    for number in range(3):  # initialized, tracked, and labeled again
        ids = np.arange(len(points)) + (number == 2) * len(points) * (np.arange(len(points)) % 4 == 0)
        for hand in tracker.step(points, ids, 0.01 * number).hands:
            _ = hand.angle_spread
    unsure = np.random.default_rng(0).uniform(0.0, _UNSURE_EXTENT, (4, len(points) // len(hands), 3))
    for cloud in unsure:  # labels that a pose has to verify
        labeler.label_frames([cloud])


def choose_user(glove: AnyGlove | None, hands: AnyHands, size: Size) -> tuple[User, bool]:
    """The hands that arguments name, and whether they are still to be measured.

    Without a glove they wear their own, or dense19 where they are measured. See `TrackerSetup.of` for errors.
    """
    check_choice(size, get_args(Size), noun="size")
    check_type("hands", hands, (Sequence, Path), _HANDS)
    if isinstance(hands, str) and hands in SIDES:
        hands = (hands,)
    if isinstance(hands, str) and not hands.endswith(".json") and not Path(hands).is_file():
        names = ", ".join(SIDES)
        raise ArgumentError(f"hands is {shown_value(hands)}, expected {_HANDS}; valid names: {names}")
    if isinstance(hands, str | Path | User):
        return _in_glove(as_user(hands), glove, size), False
    for hand in hands:
        check_type("one of hands", hand, (GloveFit, str), _HANDS)
    sides = [hand for hand in hands if not isinstance(hand, GloveFit)]
    if not sides and hands:
        fits = [hand for hand in hands if isinstance(hand, GloveFit)]
        return _in_glove(as_user(fits), glove, size), False
    layout = load_layout(USUAL_GLOVE if glove is None else glove)
    return nominal_user(layout, USUAL_SIZE if size == "auto" else size, sides), size == "auto"


def _in_glove(user: User, glove: AnyGlove | None, size: Size) -> User:
    """A user whose hands wear a glove, and for whom no size is named."""
    if size != "auto":
        raise ArgumentError(f"given size {size} and hands as they are, expected one of them")
    if glove is None:
        return user
    names, expected = user.layout.names, load_layout(glove).names
    if names != expected:
        name = glove if isinstance(glove, str | Path) else glove.name
        raise ArgumentError(
            f"the hands wear a glove with the markers {', '.join(names)}, but glove '{name}' has "
            f"{', '.join(expected)}"
        )
    return user
