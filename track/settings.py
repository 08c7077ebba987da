"""Settings of labeling, tracking and calibration, and the tracker setup that they describe."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Self, get_args

from gloves.fit import GloveFit
from gloves.layout import layout_checksum, list_layouts, load_layout
from handsim._checks import check_choice, check_number, check_type, shown_value
from handsim._version import provenance
from handsim.errors import ArgumentError
from handsim.hand.shape import JOINT_NAMES, SIDES, Side
from handsim.settings import Expected, Settings
from track.bodies.rigid_body import AnyBody, RigidTemplate, load_bodies
from track.config import SizeChoice, TrackerConfig
from track.frames import StreamedFrame
from track.hand_size import check_hands, check_scale, measured_user
from track.tracker import Tracker
from track.user import AnyGlove, AnyLabeler, User, as_user, hand_like, labeler_of, nominal_user
from train.labelers.protocol import Labeler

AnyHands = User | Sequence[GloveFit] | Sequence[Side] | str | Path
"""A user, hands in their gloves, or the path of a user's file; or sides, whose hands are to be measured."""
USUAL_GLOVE: Final = "dense19"
USUAL_SIZE: Final = "M"
"""Size of hands that could not be measured."""
_ANY_HANDS: Final = "a User, GloveFits, the path of a user's file, or sides"
# A frame is used to measure hands if it has points for this share of a hand's markers.


@dataclass(frozen=True, slots=True, eq=False)
class LabelSettings(Settings):
    """How the hands of a capture are labeled: keyword arguments of `label_capture`."""

    noun: ClassVar[str] = "setting of labeling"
    glove: Annotated[
        AnyGlove | None, Expected("a MarkerLayout, or the name or path of one", list_layouts)
    ] = None
    """Marker layout, or its shipped name or the path of its .toml file; when None that of `hands`, or dense19
    for hands that are measured."""
    hands: AnyHands | None = None
    """A user, hands in their gloves or the path of a user's file; or sides, those of the glove when None."""
    size: SizeChoice = "auto"
    """Size of hands given by sides alone: XS, S, M, L, XL, or auto, which measures size and proportions in
    the capture."""
    labeler: AnyLabeler = None
    """A labeler, or what `load_labeler` reads; that of the glove when None."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrateSettings(LabelSettings):
    """How hands and gloves are fitted to their user: keyword arguments of `calibrate`."""

    noun: ClassVar[str] = "setting of calibration"


@dataclass(frozen=True, slots=True, eq=False)
class TrackSettings(LabelSettings):
    """How hands are tracked: keyword arguments of `track_capture`, recorded in the `settings` of a take."""

    noun: ClassVar[str] = "setting of tracking"
    bodies: Sequence[AnyBody] = ()
    """Rigid bodies beside the hands: templates, names of handsim's objects, or .toml files."""
    calibrate: bool = False
    """Whether to track twice: hands are calibrated on the first take, as `track.calibrate` does, and the
    second take uses those hands that fit better after it."""
    smooth: bool = True
    """Whether the poses of a file are solved over its whole time, forward and backward. Those of a stream are
    solved frame by frame."""
    known: Mapping[str, float] = field(default_factory=dict)
    """Angles of joints that do not move, as a goniometer found them [deg], by name, such as
    `index_PIP_flexion`, or `right:index_PIP_flexion` of one hand; the poses of a file follow them."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    """Settings of the tracker itself, distances in [m] and times in [s]."""

    def check(self) -> None:
        """Refuse names that no joint has, and known angles of poses that are not solved over time."""
        if self.known and not self.smooth:
            raise ArgumentError("known angles were given with smooth=False, expected poses solved over time")
        for name, angle in self.known.items():
            *sides, joint = str(name).split(":", 1)
            check_choice("".join(sides) or SIDES[0], SIDES, noun="side of a known angle")
            check_choice(joint, JOINT_NAMES, noun="joint with a known angle")
            check_number(f"the known angle of {name}", angle, -180.0, 180.0)

    def record(self) -> dict[str, Any]:
        """The settings as JSON: objects by their names, hands in their gloves by their sides."""
        record, hands, labeler = Settings.record(self), self.hands, self.labeler
        if not isinstance(hands, str | Path | None):
            record["hands"] = [hand.side if isinstance(hand, GloveFit) else str(hand) for hand in hands]
        if hasattr(labeler, "label_frames"):
            record["labeler"] = str(getattr(labeler, "name", type(labeler).__name__))
        return record


@dataclass(frozen=True, slots=True, eq=False)
class TrackerSetup:
    """All that a tracker needs, as objects."""

    user: User
    """The hands; of the usual size until they are measured."""
    is_auto: bool
    """Whether the hands must be measured in the capture or stream."""
    labeler: Labeler
    """Labeler of their glove."""
    bodies: tuple[RigidTemplate, ...]
    config: TrackerConfig
    settings: dict[str, Any]
    """Settings that a take records, as JSON."""

    @classmethod
    def of(cls, settings: LabelSettings) -> Self:
        """Load what the settings name."""
        user, is_auto = _chosen_user(settings)
        tracking = settings if isinstance(settings, TrackSettings) else TrackSettings()
        bodies, config = load_bodies(tracking.bodies), tracking.tracker
        # Given hands may wear a slipped layout, which has no labeler; a named glove has one.
        glove = user.layout if settings.glove is None else load_layout(settings.glove)
        labeler, record = labeler_of(glove, settings.labeler), settings.record()
        record |= {"glove": record["glove"] or user.layout.name, "user": user.notes or str(user)}
        record["hands"] = record["hands"] or list(user.sides)
        # The glove of objects may have no file, and then it has no checksum.
        sums = {"user_sha256": user.checksum, "glove_sha256": layout_checksum(record["glove"])}
        record |= provenance() | {key: value for key, value in sums.items() if value}
        return cls(user, is_auto, labeler, bodies, config, record)

    @property
    def start(self) -> tuple[GloveFit, ...]:
        """The hands that a calibration begins with: measured ones are replaced by hands of mean proportions.

        Their measured proportions contain the prior of people, which would count twice.
        """
        if not self.is_auto:
            return self.user.hands
        return tuple(hand_like(hand).with_side(hand.side) for hand in self.user)

    def measured(self, frames: Sequence[StreamedFrame], *, warns: bool = True) -> TrackerSetup:
        """Measure the hands in some frames, if their size is automatic, and check that they fit."""
        check_scale(frames, self.user, self.labeler)
        user, is_named = self.user, self.user.notes in get_args(SizeChoice)
        if self.is_auto:
            user = measured_user(frames, user, self.labeler, warns=warns)
        check_hands(frames, user, self.labeler, options=("--hands", "--glove") if is_named else ())
        return self.with_user(user, user) if self.is_auto else self

    def with_user(self, user: User, hands: Iterable[GloveFit]) -> TrackerSetup:
        """The setup with another user: with these hands, and its own hands of other sides."""
        by_side = {hand.side: hand for hand in (*self.user, *hands)}
        user = dataclasses.replace(user, hands=tuple(by_side.values()))
        return dataclasses.replace(self, user=user, settings={**self.settings, "user": user.notes})

    def tracker(self) -> Tracker:
        """A tracker of the hands and bodies."""
        return Tracker(self.user, self.labeler, self.bodies, self.config)


def _chosen_user(settings: LabelSettings) -> tuple[User, bool]:
    """The hands that the settings describe, and whether they must be measured."""
    hands = settings.hands
    layout = None if settings.glove is None else load_layout(settings.glove)
    check_type("hands", hands, (Sequence, Path, type(None)), _ANY_HANDS)
    if isinstance(hands, str) and hands in SIDES:
        hands = (hands,)
    if isinstance(hands, str) and not hands.endswith(".json") and not Path(hands).is_file():
        names = ", ".join(SIDES)
        raise ArgumentError(f"hands is {shown_value(hands)}, expected {_ANY_HANDS}; valid names: {names}")
    if isinstance(hands, str | Path | User) or any(isinstance(hand, GloveFit) for hand in hands or ()):
        user = as_user(hands)  # type: ignore[arg-type]  # no sides are left
        if settings.size != "auto":
            raise ArgumentError(f"given size {settings.size} and hands as they are, expected one of them")
        if layout is not None and user.layout.names != layout.names:
            name = settings.glove if isinstance(settings.glove, str | Path) else layout.name
            worn, asked = (", ".join(one.names) for one in (user.layout, layout))
            raise ArgumentError(f"the hands' glove has the markers {worn}, but glove '{name}' has {asked}")
        return user, False
    glove, is_auto = layout or load_layout(USUAL_GLOVE), settings.size == "auto"
    return nominal_user(glove, USUAL_SIZE if is_auto else settings.size, hands), is_auto  # type: ignore[arg-type]
