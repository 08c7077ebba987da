"""A layout tried: short simulated captures of people in the glove, labeled and tracked as users' are.

Nothing is calibrated: the size of the hands is measured in each capture, as `handsim label` and `handsim
track` do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim.errors import HandSimWarning
from handsim.hand.shape import Side
from handsim.space.rig import CameraRig
from track.captures import label_capture, track_capture
from track.config import BOTH
from track.frames import checked_frames
from track.hand_size import measured_user, sample_frames
from track.settings import USUAL_SIZE
from track.user import nominal_user
from train.evaluation import LabelCounts
from train.labelers.protocol import Labeler
from train.simulation.scenes import SimulatedKind
from train.simulation.takes import simulate_take

FRAMES: Final = 240
"""Frames of a capture: two seconds."""
CAPTURES: Final = 3
"""Captures of each kind of work; those of one number have the same people and motions for every layout."""
METHODS: Final = ("label", "track")
_SAME_SLOTS: Final = 0.002  # by which the slots of two layouts differ by chance


@dataclass(frozen=True, slots=True)
class Work:
    """What hands do in a capture."""

    kind: SimulatedKind
    sides: tuple[Side, ...]


WORK: Final[Mapping[str, Work]] = {
    "one hand": Work("single-hand", ("right",)),
    "two apart": Work("single-hand", ("right", "left")),
    "two touching": Work("hand-hand", ("right", "left")),
}


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What became of the captures of one kind of work."""

    slots: dict[str, Float[np.ndarray, "M"]]
    """Share of the frames in which each marker's slot is right, by `METHODS`."""
    frames: dict[str, float]
    """Share of the frames without any error, by both."""
    joints: Float[np.ndarray, "20"]
    """Root mean square error of each joint that `track` gives [rad]; NaN if no hand was found."""
    size_error: float
    """Mean distance of the measured from the true length of the hands [m]."""

    @property
    def right(self) -> Float[np.ndarray, "M"]:
        """Share of each marker's slots that are right, the mean of both methods."""
        share: Float[np.ndarray, "M"] = np.mean([self.slots[name] for name in METHODS], axis=0)
        return share

    @property
    def worst(self) -> int:
        """The marker with most wrong slots."""
        return int(self.right.argmin())

    def share(self, method: str) -> float:
        """Share of all slots that are right."""
        return float(self.slots[method].mean())


def try_layout(
    layout: MarkerLayout,
    rig: CameraRig | str,
    labeler: Labeler,
    *,
    count: int = CAPTURES,
    first: int = 0,
    frames: int = FRAMES,
    told: Callable[[str], None] = lambda words: None,
) -> dict[str, Trial]:
    """Label and track simulated captures of each kind of work that the glove is for.

    Args:
        count: Captures of each kind, each of another person.
        first: Number of the first capture.
        told: Called before each capture with what it is.
    """
    found: dict[str, Trial] = {}
    for name in WORK if count else ():
        sides = tuple(side for side in WORK[name].sides if side in layout.sides)
        if name == "one hand":
            sides = sides or layout.sides
        elif len(sides) < len(WORK[name].sides):
            continue
        tried = []
        for number in range(1, count + 1):
            told(f"{name}, capture {number} of {count}")
            kind = WORK[name].kind
            take = simulate_take(
                kind, glove=layout, num_frames=frames, rig=rig, seed=first + number, hands=sides
            )
            tried.append(try_take(take, layout, labeler))
        found[name] = mean_trial(tried)
    return found


def try_take(truth: Take, layout: MarkerLayout, labeler: Labeler) -> Trial:
    """Label and track the points of a simulated capture whose hands are not known.

    Args:
        truth: The capture, whose gloves have slipped a little.
        layout: The glove as designed.
    """
    capture = truth.capture()
    sides = [side for side in BOTH if side in layout.sides]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)
        sample = sample_frames(checked_frames(capture))
        user = measured_user(sample, nominal_user(layout, USUAL_SIZE, sides), labeler)
        tracked = track_capture(capture, hands=user, labeler=labeler)
        labeled = label_capture(capture, glove=layout, hands=user, labeler=labeler)
    slots, frames = {}, {}
    for name, take in zip(METHODS, (labeled, tracked), strict=True):
        slots[name], frames[name] = _rights(truth, take)
    errors = [
        (tracked.qpos[:, tracked.hand_index(hand.side), 7:] - truth.qpos[:, number, 7:]) ** 2
        for number, hand in enumerate(truth.hands)
    ]
    size_error = abs(tracked.hands[0].shape.length - truth.hands[0].shape.length)
    return Trial(slots, frames, _root_mean(np.concatenate(errors)), size_error)


def mean_trial(trials: Sequence[Trial]) -> Trial:
    """The mean of captures of equal length."""
    return Trial(
        {name: np.mean([one.slots[name] for one in trials], axis=0) for name in METHODS},
        {name: float(np.mean([one.frames[name] for one in trials])) for name in METHODS},
        _root_mean(np.array([one.joints**2 for one in trials])),
        float(np.mean([one.size_error for one in trials])),
    )


def _root_mean(squares: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "20"]:
    """Root mean of the squares that are known; NaN where none is."""
    known = np.isfinite(squares)
    sums: Float[np.ndarray, "20"] = np.where(known, squares, 0.0).sum(axis=0)
    return np.sqrt(sums / np.where(known.any(axis=0), known.sum(axis=0), np.nan))


def _rights(truth: Take, take: Take) -> tuple[Float[np.ndarray, "M"], float]:
    """Share of the frames in which each marker's slots are right, of hands that are there; and of frames."""
    markers = truth.hands[0].layout.num_markers
    of_hands = [truth.label_names.index(name) if name in truth.label_names else -1
                for name in take.label_names]  # fmt: skip
    others = len(truth.hands) * markers  # labels of hands that are not there
    known = np.array([number if 0 <= number < others else others for number in of_hands] + [-1])
    counts, right = LabelCounts(), np.zeros(others)
    for points, true, given in zip(truth.points, truth.labels, take.labels, strict=True):
        here = np.isfinite(points[:, 0])
        worn = np.where(true[here] < others, true[here], -1)
        right += counts.add(known[given[here]], worn, others + 1)[:others]
    share: Float[np.ndarray, "M"] = (right / counts.frames).reshape(len(truth.hands), markers).mean(axis=0)
    return share, counts.frames_right / counts.frames


def verdict(before: Mapping[str, Trial], after: Mapping[str, Trial]) -> str:
    """Whether a layout did better in captures than another one, in a sentence."""
    slots, joints = (
        [
            float(np.mean([measure(one) for one in trials.values()]))
            for trials in (before, after)
        ]
        for measure in (_slots_right, _joint_error)
    )  # fmt: skip
    told = (
        f"{100 * slots[0]:.2f} % of the slots were right before and {100 * slots[1]:.2f} % after, joints "
        f"{joints[0]:.1f} and {joints[1]:.1f} deg off"
    )
    if slots[1] < slots[0] - _SAME_SLOTS or (slots[1] < slots[0] + _SAME_SLOTS and not joints[1] < joints[0]):
        return f"Not better in captures: {told}. Keep the layout that you have, or search longer."
    return f"Better in captures: {told}."


def _slots_right(trial: Trial) -> float:
    return float(trial.right.mean())


def _joint_error(trial: Trial) -> float:
    """Root mean square over the joints [deg]."""
    return float(np.rad2deg(np.sqrt(np.mean(trial.joints**2))))
