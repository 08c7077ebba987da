"""What a tracker is made of: hands that are known or still to be measured, their labeler, and bodies."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self, get_args

import numpy as np

from gloves.fit import GloveFit, attach
from gloves.layout import MarkerLayout, load_layout
from handsim._checks import check_choice, check_type, shown_value
from handsim.errors import ArgumentError, HandSimWarning
from handsim.hand.shape import NUM_QPOS, SIDES, Side
from track.bodies.body_file import load_bodies
from track.bodies.rigid_body import RigidTemplate
from track.config import BOTH, Size, TrackerConfig
from track.given import AnyCapture, AnyGlove, AnyLabeler, capture_of, designed_glove
from track.hand_check import check_hands, check_scale
from track.hand_size import fit_size, sample_frames
from track.settings import AnyHands, TrackSettings
from track.streams.frame_source import StreamedFrame, checked_frames
from track.tracker import Tracker
from track.user import MEASURED, User, as_user, checked_sides, nominal_user
from train.glove_labeler import load_labeler
from train.labelers.protocol import Labeler

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


def measure_hands(
    capture: AnyCapture,
    glove: AnyGlove = "dense19",
    *,
    labeler: AnyLabeler = None,
    hands: Side | Sequence[Side] = BOTH,
) -> User:
    """The hands of a capture with their size and proportions measured; a `Tracker` takes them.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        hands: Which hands.

    Returns:
        The hands, all of one shape; printed, it is their length and breadth. Where no hand is found that
        shows most of its markers, hands of size M, with a warning.

    Raises:
        ArgumentError: The capture is not in meters, or a hand is named twice.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.
    """
    sides = checked_sides(hands)
    layout = load_layout(glove)
    frames = checked_frames(capture_of(capture))
    return measured_user(sample_frames(frames), layout, sides, load_labeler(layout, labeler))


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
