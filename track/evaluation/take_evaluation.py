"""Measure a tracker on simulated takes: labels, poses and time, frame by frame, against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import Take
from handsim.hand.model import HandModel
from handsim.hand.shape import SIZES
from handsim.hand.topology import NUM_QPOS
from track.baselines.plain_hand import MOST_RMS
from track.tracked_frame import TrackedFrame

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

OCCLUSIONS: Final = ((0, 0), (1, 2), (3, 5), (6, 99))
"""Missing markers of a hand, from and to, by which pose errors are told apart."""


class FrameTracker(Protocol):
    """Anything that takes in a capture frame by frame."""

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame: points [m], their IDs, and the time [s]."""
        ...


class SeenFrame(NamedTuple):
    """What there is to see of a frame, and what it is."""

    points: Float[np.ndarray, "N 3"]
    """[m]"""
    ids: Int[np.ndarray, "N"]
    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands, then the body; -1 for ghosts and strays."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackingReport:
    """What a tracker made of a take."""

    right: Bool[np.ndarray, "T"]
    """Every point has its true label, see `is_right`."""
    valid: Bool[np.ndarray, "T"]
    """Every hand has a pose, fitted to its labeled markers within 8 mm RMS."""
    missing: Int[np.ndarray, "T H"]
    """Markers of each hand that the system does not see."""
    joint_error: Float[np.ndarray, "T H"]
    """Distance of the wrist and the 15 joints of the digits from the truth, on average [m]; NaN: no pose."""
    angle_error: Float[np.ndarray, "T H"]
    """Distance of the 20 hinges from the truth, on average [rad]; NaN without a pose."""
    seconds: Float[np.ndarray, "T"]
    """Time that the tracker took."""

    def figures(self) -> dict[str, float]:
        """The figures in one place, by name; NaN where there is nothing to count.

        Shares in [0, 1]: `right`; `valid`; `right_of_valid`, Table 7's second number; `valid_and_right`, its
        product. Errors where there is a pose: `joint_error` [m], `angle_error` [rad]. Time of a frame [s]:
        `seconds_p50`, `seconds_p99`.
        """
        both = self.valid & self.right
        return {
            "right": float(self.right.mean()),
            "valid": float(self.valid.mean()),
            "right_of_valid": float(both.sum() / self.valid.sum()) if self.valid.any() else np.nan,
            "valid_and_right": float(both.mean()),
            "joint_error": _mean(self.joint_error),
            "angle_error": _mean(self.angle_error),
            "seconds_p50": float(np.quantile(self.seconds, 0.5)),
            "seconds_p99": float(np.quantile(self.seconds, 0.99)),
        }

    def by_occlusion(self) -> dict[tuple[int, int], tuple[int, float, float]]:
        """Pose errors by how many markers a hand lacks, from and to (`OCCLUSIONS`).

        Returns:
            Hands counted frame by frame that have a pose, mean joint error [m], mean angle error [rad].
        """
        found = {}
        for low, high in OCCLUSIONS:
            chosen = (self.missing >= low) & (self.missing <= high) & np.isfinite(self.joint_error)
            errors = _mean(self.joint_error[chosen]), _mean(self.angle_error[chosen])
            found[low, high] = int(chosen.sum()), *errors
        return found


def seen_frame(take: Take, frame: int) -> SeenFrame:
    """What there is to see of one frame of a take."""
    here = np.isfinite(take.points[frame, :, 0])
    labels = take.labels[frame, here].astype(np.int64)
    return SeenFrame(take.points[frame, here], take.ids[frame, here].astype(np.int64), labels)


def true_users(take: Take) -> list[GloveFit]:
    """The hands of a take with their true shapes and gloves as worn: the best that calibration can find."""
    return [hand.fit for hand in take.hands]


def usual_users(take: Take) -> list[GloveFit]:
    """The hands of a take without calibration: of the five sizes the nearest in length, gloves as designed.

    Raises:
        LayoutError: The glove that the take was made with is not there.
    """
    layout = load_layout(str(take.settings["glove"]))
    return [nominal_fit(layout, nearest_size(hand.fit.shape.length), hand.side) for hand in take.hands]


def nearest_size(length: float) -> str:
    """The one of the five sizes whose hand length is nearest to a length [m]."""
    return min(SIZES, key=lambda size: abs(1e-3 * SIZES[size][0] - length))


def evaluate_tracker(
    take: Take,
    users: Sequence[GloveFit],
    tracker: FrameTracker,
    *,
    done: Callable[[], None] | None = None,
) -> TrackingReport:
    """Run a tracker over a take and count.

    Args:
        take: A simulated take.
        users: The hands that the tracker was told to follow, in the take's order.
        tracker: One that nothing was tracked with yet.
        done: Called after every frame.
    """
    frames = range(take.num_frames)
    right, valid = np.zeros(len(frames), dtype=bool), np.zeros(len(frames), dtype=bool)
    seconds, poses = np.zeros(len(frames)), np.full((len(users), len(frames), NUM_QPOS), np.nan)
    for frame in frames:
        seen = seen_frame(take, frame)
        start = time.perf_counter()
        tracked = tracker.step(seen.points, seen.ids, frame / take.rate)
        seconds[frame] = time.perf_counter() - start
        right[frame], valid[frame] = is_right(take, tracked, seen), is_valid(tracked)
        poses[:, frame] = [hand.qpos for hand in tracked.hands]
        if done is not None:
            done()
    missing = [(~np.isfinite(take.observed(label)[..., 0])).sum(axis=1) for label in take.hand_labels]
    errors = [
        _pose_errors(user.model, pose, hand.fit.model, hand.qpos)
        for user, pose, hand in zip(users, poses, take.hands, strict=True)
    ]
    joints, angles = (np.stack(parts, axis=1) for parts in zip(*errors, strict=True))
    return TrackingReport(right, valid, np.stack(missing, axis=1), joints, angles, seconds)


def is_right(take: Take, tracked: TrackedFrame, seen: SeenFrame) -> bool:
    """Whether every point of a frame has its true label: a marker its own, all others none.

    Markers of a body that was tracked are to have theirs; of one that was not, none of a hand's.
    """
    if tracked.bodies:
        return np.array_equal(tracked.labels, seen.labels)
    return np.array_equal(_of_hands(take, tracked.labels), _of_hands(take, seen.labels))


def is_valid(tracked: TrackedFrame) -> bool:
    """Whether every hand of a frame has a pose that passes the paper's test."""
    return all(hand.has_pose and bool(hand.rms <= MOST_RMS) for hand in tracked.hands)


def _pose_errors(
    model: HandModel, poses: NDArray[np.float64], true_model: HandModel, truth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean distance of joints [m] and hinges [rad] in every frame, NaN without a pose."""
    there = np.flatnonzero(np.isfinite(poses[:, 0]))
    joints, angles = np.full((2, len(poses)), np.nan)
    if len(there):
        found, true = model.forward_kinematics(poses[there]), true_model.forward_kinematics(truth[there])
        joints[there] = np.linalg.norm((found - true)[..., :3, 3], axis=-1).mean(axis=-1)
        angles[there] = np.abs(poses[there, 7:] - truth[there, 7:]).mean(axis=-1)
    return joints, angles


def _of_hands(take: Take, labels: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """Labels of hands alone: markers of bodies count as none."""
    return np.where(labels < take.hand_labels[-1].stop, labels, -1)


def _mean(values: Float[np.ndarray, "*shape"]) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
