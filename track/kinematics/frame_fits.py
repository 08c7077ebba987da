"""Compiled fits of frames, one by one: starts, prior, robust scale, residuals."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from handsim.hand.shape import NUM_JOINTS, NUM_QPOS
from handsim.kernels.kernel import kernel
from track.kinematics.levenberg_marquardt import MARKER_NOISE, levenberg_marquardt, marker_residuals
from track.kinematics.marker_kinematics import NUM_UNKNOWNS, HandArrays, Workspace, workspace
from track.kinematics.starting_poses import RESTING, StartingShapes, initial_poses

FEWEST_MARKERS: Final = 4
"""Least number of markers of a frame for a pose to be solved."""
_EASING: Final = (1 / 64, 1 / 8, 1.0)  # factors of the robust scale, so that a start may be far off
_EASING_STEPS: Final = 8  # at most at each widened scale
_REST_PRECISION: Final = float(np.deg2rad(90.0)) ** -2  # [1/rad^2] of a hinge around its resting angle: weak
_COMPLETE_DIGIT: Final = 1e-4  # factor of that precision for a digit that has all its markers
_FEWEST_ON_PART: Final = 3  # markers that determine a digit's hinges, also when straight, or a palm's pose
_GOOD_RMS: Final = 0.0005  # [m] limits and prior included, below which no further start is tried


@kernel
def fit_frames(
    hand: HandArrays,
    shapes: StartingShapes,
    on_part: Int[np.ndarray, "6"],
    targets: Float[np.ndarray, "T M 3"],
    initial: Float[np.ndarray, "S 27"],
    predicted: Float[np.ndarray, "P 20"],
    predicted_precision: Float[np.ndarray, "P 20"],
    wrist: Float[np.ndarray, "9"],
    robust_scale: float,
    iterations: int,
    small_gain: float,
) -> tuple[
    int,
    Float[np.ndarray, "T 27"],
    Float[np.ndarray, "T"],
    Float[np.ndarray, "T M 3"],
    Int[np.ndarray, "T"],
]:
    """Solve frames one by one.

    Args:
        shapes: Shapes to start from where there are no initial poses.
        on_part: Markers on each digit, and on the palm (last).
        targets: Labeled markers [m]; NaN where missing.
        initial: Poses to start from, one row per frame or none.
        predicted: Mean of the hinges [rad], one row per frame or none.
        predicted_precision: Their precision [1/rad^2].
        wrist: Predicted position [m] and orientation of the wrist, then the precisions of both.
        robust_scale: See `levenberg_marquardt`.
        iterations: Steps at most from each start.
        small_gain: See `levenberg_marquardt`.

    Returns:
        Index of the first frame that cannot be solved (or -1), and the arrays of a `PoseFit`.
    """
    frames, count = targets.shape[:2]
    qpos, residuals = np.empty((frames, NUM_QPOS)), np.empty((frames, count, 3))
    rms, steps = np.zeros(frames), np.zeros(frames, dtype=np.int64)
    prior_mean, precision, seen = (
        np.empty(NUM_QPOS),
        np.empty(NUM_UNKNOWNS),
        np.empty(len(on_part), dtype=np.int64),
    )
    work, pose, target = workspace(count), np.empty(NUM_QPOS), np.empty((count, 3))
    for frame in range(frames):
        present = _read_markers(hand.digits, targets[frame], target, seen)
        if present < FEWEST_MARKERS:
            return frame, qpos, rms, residuals, steps
        _set_prior(
            seen,
            on_part,
            predicted[frame:],
            predicted_precision[frame:],
            wrist,
            prior_mean,
            precision,
        )
        if len(initial) > 0:
            starts = initial[frame : frame + 1].copy()
            length = np.sqrt((starts[0, 3:7] ** 2).sum())
            if not length > 0.0:
                return frame, qpos, rms, residuals, steps
            starts[0, 3:7] /= length
        else:
            starts = initial_poses(shapes, hand.digits, target)
        least = np.inf
        qpos[frame] = starts[0]
        for number in range(len(starts)):
            pose[:] = starts[number]
            cost = np.inf
            for part in _EASING:
                if robust_scale == 0.0 and part < 1.0:
                    continue
                most = iterations if part == 1.0 else min(iterations, _EASING_STEPS)
                cost, tried = levenberg_marquardt(
                    hand, target, pose, prior_mean, precision, part * robust_scale, most, small_gain, work
                )
                steps[frame] += tried
            if cost < least:
                least = cost
                qpos[frame] = pose
            if least < present * (_GOOD_RMS / MARKER_NOISE) ** 2:
                break
        rms[frame] = _write_residuals(hand, target, qpos[frame], work, residuals[frame])
    return -1, qpos, rms, residuals, steps


@kernel
def _read_markers(
    digits: Int[np.ndarray, "M"],
    given: Float[np.ndarray, "M 3"],
    target: Float[np.ndarray, "M 3"],
    seen: Int[np.ndarray, "6"],
) -> int:
    """Copy the markers of one frame to `target`, each complete or NaN, and return how many are present.

    `seen` is filled with how many are present on each digit and on the palm (last).
    """
    seen[:] = 0
    present = 0
    for marker in range(len(given)):
        if np.isfinite(given[marker, 0] + given[marker, 1] + given[marker, 2]):
            target[marker] = given[marker]
            present += 1
            seen[digits[marker]] += 1
        else:
            target[marker] = np.nan
    return present


@kernel
def _set_prior(
    seen: Int[np.ndarray, "6"],
    on_part: Int[np.ndarray, "6"],
    predicted: Float[np.ndarray, "P 20"],
    predicted_precision: Float[np.ndarray, "P 20"],
    wrist: Float[np.ndarray, "9"],
    prior_mean: Float[np.ndarray, "27"],
    precision: Float[np.ndarray, "26"],
) -> None:
    """Mean and precision of the prior of one frame, both filled; see `levenberg_marquardt`.

    The frame's rows of `predicted` and `predicted_precision` come first, if there are any.
    """
    prior_mean[:7] = wrist[:7]
    incomplete = seen[-1] < max(on_part[-1], _FEWEST_ON_PART)
    precision[NUM_JOINTS : NUM_JOINTS + 3] = wrist[7] if incomplete else 0.0
    precision[NUM_JOINTS + 3 :] = wrist[8] if incomplete else 0.0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        complete = seen[digit] == on_part[digit] and seen[digit] >= _FEWEST_ON_PART
        rest, weight = (
            RESTING[hinge],
            _REST_PRECISION * (_COMPLETE_DIGIT if complete else 1.0),
        )
        if len(predicted) > 0 and not complete:
            both = weight + predicted_precision[0, hinge]
            rest += (predicted[0, hinge] - rest) * predicted_precision[0, hinge] / both
            weight = both
        prior_mean[7 + hinge], precision[hinge] = rest, weight


@kernel
def _write_residuals(
    hand: HandArrays,
    target: Float[np.ndarray, "M 3"],
    pose: Float[np.ndarray, "27"],
    work: Workspace,
    residuals: Float[np.ndarray, "M 3"],
) -> float:
    """Fill the residuals in the world [m], NaN where a marker is missing, and return their RMS [m]."""
    marker_residuals(hand, target, pose, work)
    w, x, y, z = pose[3:7]
    total, present = 0.0, 0
    for marker in range(len(target)):
        a, b, c = work.residuals[marker]
        i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
        residuals[marker, 0] = a + 2.0 * (w * i + y * k - z * j)
        residuals[marker, 1] = b + 2.0 * (w * j + z * i - x * k)
        residuals[marker, 2] = c + 2.0 * (w * k + x * j - y * i)
        if not np.isnan(a):
            present += 1
            total += a * a + b * b + c * c
    return np.sqrt(total / present)  # type: ignore[no-any-return]
