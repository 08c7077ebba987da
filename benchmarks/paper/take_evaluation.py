"""Evaluation of a tracker on a simulated take: labels and poses, against the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves import GloveFit, Take, load_layout
from gloves.fit import nominal_fit
from handsim import HandModel
from handsim.hand.shape import NUM_QPOS, SIZES
from track import StreamedFrame, TrackedFrame, Tracker
from track.hand_size import fit_size, sample_frames
from train import Labeler

MOST_RMS: Final = 0.008
"""RMS distance [m] above which a pose is rejected; Han et al. 2018, section 4.4."""
OCCLUSIONS: Final = ((0, 0), (1, 2), (3, 5), (6, 99))
"""Classes of a hand's number of missing markers, from and to, for pose errors."""


class SeenFrame(NamedTuple):
    """The points of a frame and their true labels."""

    points: Float[np.ndarray, "N 3"]
    """[m]"""
    ids: Int[np.ndarray, "N"]
    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands, then the body; -1 for ghosts and strays."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackingReport:
    """Results of a tracker on a take."""

    right: Bool[np.ndarray, "T"]
    """Every point has its true label, see `is_right`."""
    valid: Bool[np.ndarray, "T"]
    """Every hand has a pose, fitted to its labeled markers within 8 mm RMS."""
    missing: Int[np.ndarray, "T H"]
    """Number of each hand's markers without a point."""
    joint_error: Float[np.ndarray, "T H"]
    """Mean distance of the wrist and the 15 joints of the digits from the truth [m]; NaN without a pose."""
    angle_error: Float[np.ndarray, "T H"]
    """Mean absolute error of the 20 joint angles [rad]; NaN without a pose."""

    def figures(self) -> dict[str, float]:
        """Averages over the take, by name; NaN where nothing was counted.

        Shares in [0, 1]: `right`; `valid`; `right_of_valid`, Table 7's second number; `valid_and_right`, its
        product. Errors in frames with a pose: `joint_error` [m], `angle_error` [rad].
        """
        both = self.valid & self.right
        return {
            "right": float(self.right.mean()),
            "valid": float(self.valid.mean()),
            "right_of_valid": float(both.sum() / self.valid.sum()) if self.valid.any() else np.nan,
            "valid_and_right": float(both.mean()),
            "joint_error": _mean(self.joint_error),
            "angle_error": _mean(self.angle_error),
        }

    def by_occlusion(self) -> dict[tuple[int, int], tuple[int, float, float]]:
        """Pose errors by the number of missing markers (`OCCLUSIONS`).

        Returns:
            Number of poses, mean joint error [m], mean angle error [rad].
        """
        found = {}
        for low, high in OCCLUSIONS:
            chosen = (self.missing >= low) & (self.missing <= high) & np.isfinite(self.joint_error)
            errors = _mean(self.joint_error[chosen]), _mean(self.angle_error[chosen])
            found[low, high] = int(chosen.sum()), *errors
        return found


def seen_frame(take: Take, frame: int) -> SeenFrame:
    """Points and true labels of one frame of a take."""
    here = np.isfinite(take.points[frame, :, 0])
    labels = take.labels[frame, here].astype(np.int64)
    return SeenFrame(take.points[frame, here], take.ids[frame, here].astype(np.int64), labels)


def true_users(take: Take) -> list[GloveFit]:
    """The hands of a take with their true shapes and gloves: the result of a perfect calibration."""
    return list(take.hands)


def nominal_users(take: Take) -> list[GloveFit]:
    """The hands of a take without calibration: the nearest of the five sizes, gloves as designed.

    Raises:
        LayoutError: The take's glove is not found.
    """
    layout = load_layout(str(take.settings["glove"]))
    return [nominal_fit(layout, nearest_size(hand.shape.length), hand.side) for hand in take.hands]


def measured_users(take: Take, labeler: Labeler) -> list[GloveFit]:
    """The hands of a take without calibration: of the size that is measured in it, gloves as designed.

    Hands whose size cannot be measured have the nearest of the five sizes.

    Raises:
        LayoutError: The take's glove is not found.
    """
    layout, sides = load_layout(str(take.settings["glove"])), [hand.side for hand in take.hands]
    frames = [
        StreamedFrame(number, number / take.rate, seen.points, seen.ids)
        for number in range(take.num_frames)
        for seen in [seen_frame(take, number)]
    ]
    size = fit_size(sample_frames(frames), layout, sides, labeler)
    return nominal_users(take) if size is None else list(size.hands(sides))


def nearest_size(length: float) -> str:
    """Name of the size whose hand length is nearest to a length [m]."""
    return min(SIZES, key=lambda size: abs(SIZES[size][0] - length))


def evaluate_tracker(
    take: Take,
    users: Sequence[GloveFit],
    tracker: Tracker,
    *,
    done: Callable[[], None] | None = None,
) -> TrackingReport:
    """Run a tracker, which has not seen a frame, over a simulated take and compare it with the truth.

    `users` are the tracker's hands in the take's order; `done` is called after each frame.
    """
    frames = range(take.num_frames)
    right, valid = np.zeros(len(frames), dtype=bool), np.zeros(len(frames), dtype=bool)
    poses = np.full((len(users), len(frames), NUM_QPOS), np.nan)
    for frame in frames:
        seen = seen_frame(take, frame)
        tracked = tracker.step(seen.points, seen.ids, frame / take.rate)
        right[frame], valid[frame] = is_right(take, tracked, seen), is_valid(tracked)
        poses[:, frame] = [hand.qpos for hand in tracked.hands]
        if done is not None:
            done()
    missing = [(~np.isfinite(take.observed(label)[..., 0])).sum(axis=1) for label in take.hand_labels]
    errors = [
        _pose_errors(user.model, poses[number], hand.model, take.qpos[:, number])
        for number, (user, hand) in enumerate(zip(users, take.hands, strict=True))
    ]
    joints, angles = (np.stack(parts, axis=1) for parts in zip(*errors, strict=True))
    return TrackingReport(right, valid, np.stack(missing, axis=1), joints, angles)


def is_right(take: Take, tracked: TrackedFrame, seen: SeenFrame) -> bool:
    """Whether every point of a frame has its true label: a marker its own, all others none.

    The markers of a body must have their labels if the body is tracked, and no label of a hand otherwise.
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
    """Mean errors of joints [m] and of joint angles [rad] per frame (T,), NaN without a pose."""
    there = np.flatnonzero(np.isfinite(poses[:, 0]))
    joints, angles = np.full((2, len(poses)), np.nan)
    if len(there):
        found, true = model.forward_kinematics(poses[there]), true_model.forward_kinematics(truth[there])
        joints[there] = np.linalg.norm((found - true)[..., :3, 3], axis=-1).mean(axis=-1)
        angles[there] = np.abs(poses[there, 7:] - truth[there, 7:]).mean(axis=-1)
    return joints, angles


def _of_hands(take: Take, labels: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """The labels of hands; -1 for all others."""
    return np.where(labels < take.hand_labels[-1].stop, labels, -1)


def _mean(values: Float[np.ndarray, "*shape"]) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
