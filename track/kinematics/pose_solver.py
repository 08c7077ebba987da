"""Inverse kinematics from labeled markers: the paper's E_IK (Han et al. 2018, section 4.3) for one hand.

Frames are solved one by one, each from its own start; a missing marker is NaN. Where markers leave angles
open, the soft limits of the joints' ranges and a prior determine them. The prior acts on digits with a
missing marker or fewer than three; it is weak around the resting angles, or that of predicted angles if
given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim._checks import as_numbers, check_array, check_type
from handsim.arrays import Doubles, Integers
from handsim.errors import ArgumentError
from handsim.hand.model import join_qpos
from handsim.hand.shape import DIGITS, NUM_JOINTS, NUM_QPOS
from handsim.kernels import align_rigid, kernel, write_quaternion_matrix
from track.kinematics.marker_kinematics import (
    MARKER_NOISE,
    NUM_UNKNOWNS,
    HandArrays,
    PoseEnergy,
    Workspace,
    compute_markers,
    hand_arrays,
    levenberg_marquardt,
    marker_residuals,
    workspace,
)

FEWEST_MARKERS: Final = 4  # A pose needs this many markers in a frame.
FEWEST_ON_PART: Final = 3
"""This many markers determine a digit's joint angles, even if it is straight, or a palm's pose."""
OUTLIER_DISTANCE: Final = 0.01
"""Usual scale of the robust loss of poses [m]; labels farther from a robust fit are wrong."""
RESTING: Final = np.tile(np.deg2rad([0.0, 25.0, 35.0, 20.0]), 5)  # joint angles of a relaxed hand [rad]
# Six shapes of a digit [deg], in the order of its joints: relaxed, straight, half closed, bent in the knuckle
# only, bent in all other joints, closed; for the thumb: relaxed, away from the palm, beside the index finger,
# opposed, opposed and bent, across the palm.
_FINGERS_DEG: Final = (
    (0, 25, 35, 20),
    (0, 0, 5, 5),
    (0, 45, 60, 35),
    (0, 75, 10, 10),
    (0, 10, 95, 55),
    (0, 80, 100, 55),
)
_THUMBS_DEG: Final = (
    (0, 25, 35, 20),
    (25, -25, 0, 0),
    (-20, -20, 10, 10),
    (25, 20, 10, 10),
    (20, 25, 45, 60),
    (-20, 35, 50, 40),
)
_ALIGNMENT_ROUNDS: Final = 3  # After these rounds of choosing digits and aligning, the choice is stable.
_LEAST_SHAPE_SPREAD: Final = 0.005  # [m] least standard deviation of a marker over the shapes
_ROBUST_SCALES: Final = (1 / 64, 1 / 8, 1.0)  # factors of the robust scale, wide first for poor starts
_STEPS_AT_WIDE_SCALES: Final = 8  # most steps at each wide scale
_REST_PRECISION: Final = float(np.deg2rad(90.0)) ** -2  # [1/rad^2] weak prior around resting angles
_COMPLETE_DIGIT_FACTOR: Final = 1e-4  # factor of that precision for digits with all markers
_RMS_OF_LAST_START: Final = 0.0005  # [m] A start with a smaller RMS, limits and prior included, is the last.
_MOST_STEPS: Final = 30  # largest number of steps from each start
_CONVERGED_GAIN: Final = (1e-6 / MARKER_NOISE) ** 2  # gain in cost: one marker 1 um closer
_REAL_TIME_GAIN: Final = (3e-5 / MARKER_NOISE) ** 2  # gain in cost, in real time: all markers 30 um closer
_NO_ROWS: Final = np.empty((0, NUM_JOINTS))
_NO_WRIST: Final = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # no rotation, and zero precisions


class _StartingShapes(NamedTuple):
    """K starting shapes of a hand, with their markers."""

    angles: Float[np.ndarray, "K 20"]  # joint angles [rad]
    markers: Float[np.ndarray, "K M 3"]  # markers in the wrist's frame [m]
    weights: Float[np.ndarray, "M"]  # weights to align whole hands [1/m^2]: small if shapes differ


class FramePriors(NamedTuple):
    """Priors of poses before the markers of their frames are used."""

    angles: Float[np.ndarray, "P 20"]  # mean joint angles [rad], one row per frame, or no row
    precision: Float[np.ndarray, "P 20"]  # their precision [1/rad^2]
    wrist: Float[np.ndarray, "9"]  # position [m] and orientation of the wrist, then both precisions


def priors_of_frame(
    angles: Float[np.ndarray, "20"],
    spread: Float[np.ndarray, "20"],
    wrist: Float[np.ndarray, "7"],
    wrist_spread: tuple[float, float],
) -> FramePriors:
    """Priors of one frame's joint angles and wrist, from means and standard deviations [m, rad]."""
    wrist_prior = np.concatenate([wrist, np.array(wrist_spread) ** -2.0])
    return FramePriors(angles[None], spread[None] ** -2.0, wrist_prior)


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Poses and their residuals."""

    qpos: Float[np.ndarray, "T 27"]
    """The poses."""
    rms: Float[np.ndarray, "T"]
    """RMS distance of the present markers [m]."""
    residuals: Float[np.ndarray, "T M 3"]
    """Model minus marker [m], NaN where a marker is missing."""
    iterations: Int[np.ndarray, "T"]
    """Number of tried steps, over all starts of a frame."""


class PoseSolver:
    """Solves poses of one hand in one glove; precomputes all that is equal for all frames."""

    # `outlier_distance` [m] is the scale of a robust loss (Geman and McClure 1987), which keeps a wrong label
    # from bending the hand but needs a good start. Without it a fit is plain least squares.

    def __init__(self, fit: GloveFit, *, outlier_distance: float | None = None) -> None:
        self.hand: HandArrays = hand_arrays(fit)
        """The hand and its glove; changed marker positions take effect in the next solution."""
        pairs = zip(_THUMBS_DEG, _FINGERS_DEG, strict=True)
        angles = np.deg2rad([[*thumb, *finger * 4] for thumb, finger in pairs])
        markers = fit.markers(join_qpos(angles))[0]
        weights = 1.0 / (_LEAST_SHAPE_SPREAD**2 + markers.var(axis=0).sum(axis=1))
        self._shapes = _StartingShapes(angles, markers, weights)
        self._robust_scale = 0.0 if outlier_distance is None else outlier_distance**-2
        self.on_part: Int[np.ndarray, "6"] = np.array(
            [(self.hand.digits == part).sum() for part in (*range(len(DIGITS)), -1)]
        )
        """Markers on each digit, and on the palm (last)."""

    def solve(
        self,
        targets: Float[np.ndarray, "T M 3"],
        initial: Float[np.ndarray, "T 27"] | None = None,
        *,
        prior: tuple[Float[np.ndarray, "T 20"], float] | None = None,
        iterations: int = _MOST_STEPS,
    ) -> PoseFit:
        """Solve poses of frames with at least four markers, each by itself; see `solve_pose`."""
        # `prior` holds mean angles and their standard deviation [rad], for digits with too few markers.
        # Arrays are copied because a kernel is compiled anew for read-only or non-contiguous ones.
        targets = np.array(targets, dtype=np.float64, order="C")
        targets[~np.isfinite(targets).all(axis=-1)] = np.nan
        starts = np.array(np.empty((0, NUM_QPOS)) if initial is None else initial, np.float64, order="C")
        known = FramePriors(_NO_ROWS, _NO_ROWS, _NO_WRIST)
        if prior is not None:
            precision = np.full(prior[0].shape, np.asarray(prior[1]) ** -2)
            known = FramePriors(np.array(prior[0], order="C"), precision, _NO_WRIST)
        steps = self._robust_scale, iterations, _CONVERGED_GAIN
        return PoseFit(*_fit_frames(self.hand, self._shapes, self.on_part, targets, starts, known, *steps))

    def solve_frame(
        self, target: Float[np.ndarray, "M 3"], start: Float[np.ndarray, "27"], prior: FramePriors
    ) -> PoseFit:
        """Solve one frame in real time from a close start; a marker [m] is complete or NaN."""
        steps = self._robust_scale, _MOST_STEPS, _REAL_TIME_GAIN
        targets, starts = target[None], start[None]
        return PoseFit(*_fit_frames(self.hand, self._shapes, self.on_part, targets, starts, prior, *steps))

    def marker_positions(self, qpos: Float[np.ndarray, "27"]) -> Float[np.ndarray, "M 3"]:
        """Positions of a pose's markers in the world [m]."""
        return _world_markers(self.hand, np.array(qpos, dtype=np.float64))


def solve_pose(
    fit: GloveFit,
    targets: Float[np.ndarray, "T M 3"],
    *,
    initial: Float[np.ndarray, "T 27"] | None = None,
    iterations: int | None = None,
) -> PoseFit:
    """Poses of a hand with the least distances to labeled markers, each frame by itself.

    Args:
        fit: The hand in its glove.
        targets: Labeled markers in the glove's order [m]; NaN where missing.
        initial: Poses to start from [m, rad]; several general poses if not given.
        iterations: Largest number of steps from each start.

    Returns:
        Poses (T, 27) [m, rad], RMS distances (T,) [m] and residuals (T, M, 3) [m].

    Raises:
        ArgumentError: The arrays do not fit the glove or each other, or a frame has fewer than 4 markers.
    """
    check_type("fit", fit, GloveFit, "a GloveFit, as attach returns it")
    count = fit.layout.num_markers
    targets = as_numbers("targets", targets)
    if targets.ndim != 3 or targets.shape[1:] != (count, 3):
        raise ArgumentError(f"targets have shape {targets.shape}, expected (T, {count}, 3)")
    present = np.isfinite(targets).all(axis=-1).sum(axis=1)
    if (present < FEWEST_MARKERS).any():
        wrong = int((present < FEWEST_MARKERS).argmax())
        raise ArgumentError(f"frame {wrong} has {present[wrong]} markers, expected at least {FEWEST_MARKERS}")
    if initial is not None:
        initial = check_array("initial", initial, (None, NUM_QPOS))
        if initial.shape != (len(targets), NUM_QPOS):
            raise ArgumentError(f"initial has shape {initial.shape}, expected ({len(targets)}, {NUM_QPOS})")
        without = np.flatnonzero(~initial[:, 3:7].any(axis=1))
        if len(without):
            reason = f"initial has a quaternion of length zero in frame {without[0]}"
            raise ArgumentError(f"{reason}, expected an orientation")
    steps = _MOST_STEPS if iterations is None else iterations
    return PoseSolver(fit).solve(targets, initial, iterations=steps)


@kernel
def _fit_frames(
    hand: HandArrays,
    shapes: _StartingShapes,
    on_part: Int[np.ndarray, "6"],
    targets: Float[np.ndarray, "T M 3"],
    initial: Float[np.ndarray, "S 27"],
    prior: FramePriors,
    robust_scale: float,
    iterations: int,
    small_gain: float,
) -> tuple[Doubles, Doubles, Doubles, Integers]:
    """Solve frames one by one; returns the fields of a `PoseFit`."""
    frames, count = targets.shape[:2]
    qpos, residuals = np.empty((frames, NUM_QPOS)), np.empty((frames, count, 3))
    rms, steps = np.zeros(frames), np.zeros(frames, dtype=np.int64)
    mean, precision = np.empty(NUM_QPOS), np.empty(NUM_UNKNOWNS)
    work, pose = workspace(count), np.empty(NUM_QPOS)
    for frame in range(frames):
        target = targets[frame]
        present = _set_prior(hand.digits, on_part, target, prior, frame, mean, precision)
        if len(initial) > 0:
            starts = initial[frame : frame + 1].copy()
            starts[0, 3:7] /= np.sqrt((starts[0, 3:7] ** 2).sum())
        else:
            starts = _initial_poses(shapes, hand.digits, target)
        least = np.inf
        qpos[frame] = starts[0]
        for number in range(len(starts)):
            pose[:] = starts[number]
            cost = np.inf
            for part in _ROBUST_SCALES:
                if robust_scale == 0.0 and part < 1.0:
                    continue
                most = iterations if part == 1.0 else min(iterations, _STEPS_AT_WIDE_SCALES)
                energy = PoseEnergy(target, mean, precision, part * robust_scale)
                cost, tried = levenberg_marquardt(hand, energy, pose, most, small_gain, work)
                steps[frame] += tried
            if cost < least:
                least = cost
                qpos[frame] = pose
            if least < present * (_RMS_OF_LAST_START / MARKER_NOISE) ** 2:
                break
        rms[frame] = _write_residuals(hand, target, qpos[frame], work, residuals[frame])
    return qpos, rms, residuals, steps


@kernel
def _set_prior(
    digits: Int[np.ndarray, "M"],
    on_part: Int[np.ndarray, "6"],
    target: Float[np.ndarray, "M 3"],
    prior: FramePriors,
    frame: int,
    mean: Float[np.ndarray, "27"],
    precision: Float[np.ndarray, "26"],
) -> int:
    """Write the prior of a frame, see `PoseEnergy`; return its number of markers, each complete or NaN."""
    seen = np.zeros(len(on_part), dtype=np.int64)
    for marker in range(len(target)):
        if not np.isnan(target[marker, 0]):
            seen[digits[marker]] += 1
    mean[:7] = prior.wrist[:7]
    incomplete = seen[-1] < max(on_part[-1], FEWEST_ON_PART)
    precision[NUM_JOINTS : NUM_JOINTS + 3] = prior.wrist[7] if incomplete else 0.0
    precision[NUM_JOINTS + 3 :] = prior.wrist[8] if incomplete else 0.0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        complete = seen[digit] == on_part[digit] and seen[digit] >= FEWEST_ON_PART
        rest, weight = RESTING[hinge], _REST_PRECISION * (_COMPLETE_DIGIT_FACTOR if complete else 1.0)
        if len(prior.angles) > frame and not complete:
            both = weight + prior.precision[frame, hinge]
            rest += (prior.angles[frame, hinge] - rest) * prior.precision[frame, hinge] / both
            weight = both
        mean[7 + hinge], precision[hinge] = rest, weight
    return int(seen.sum())


@kernel
def _write_residuals(
    hand: HandArrays,
    target: Float[np.ndarray, "M 3"],
    pose: Float[np.ndarray, "27"],
    work: Workspace,
    residuals: Float[np.ndarray, "M 3"],
) -> float:
    """Write the residuals in the world [m], NaN where a marker is missing; return their RMS [m]."""
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


@kernel
def _world_markers(hand: HandArrays, pose: Float[np.ndarray, "27"]) -> Float[np.ndarray, "M 3"]:
    """Positions of a pose's markers in the world [m]."""
    positions, wrist = np.empty((len(hand.digits), 3)), np.empty((3, 3))
    work = workspace(len(positions))
    write_quaternion_matrix(wrist, pose[3], pose[4], pose[5], pose[6])
    compute_markers(hand, pose[7:], work)
    for marker in range(len(positions)):
        positions[marker] = pose[:3] + wrist @ work.markers[marker]
    return positions


@kernel
def _initial_poses(
    shapes: _StartingShapes, digits: Int[np.ndarray, "M"], target: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "S 27"]:
    """Starting poses of a frame (K + 1, 27): one of the nearest digits, then all shapes, nearest first."""
    count = len(shapes.angles)
    aligned, poses, squares = np.empty((count, NUM_QPOS)), np.empty((count + 1, NUM_QPOS)), np.empty(count)
    for number in range(count):
        aligned[number, 7:] = shapes.angles[number]
        squares[number] = align_rigid(shapes.markers[number], target, shapes.weights, aligned[number])
    for number in range(count):
        better = 0
        for other in range(count):
            if squares[other] < squares[number] or (squares[other] == squares[number] and other < number):
                better += 1
        poses[1 + better] = aligned[number]
    markers = np.empty_like(target)
    poses[0] = poses[1]
    for _ in range(_ALIGNMENT_ROUNDS):
        _choose_digits(shapes, digits, target, poses[0], markers)
        align_rigid(markers, target, shapes.weights, poses[0])
    return poses


@kernel
def _choose_digits(
    shapes: _StartingShapes,
    digits: Int[np.ndarray, "M"],
    target: Float[np.ndarray, "M 3"],
    pose: Float[np.ndarray, "27"],
    markers: Float[np.ndarray, "M 3"],
) -> None:
    """Take each digit from the shape with the nearest markers, with the wrist fixed."""
    rotation = np.empty((3, 3))
    write_quaternion_matrix(rotation, pose[3], pose[4], pose[5], pose[6])
    squares = np.zeros((5, len(shapes.angles)))
    for marker in range(len(target)):
        if digits[marker] < 0 or np.isnan(target[marker, 0]):
            continue
        for i in range(3):
            local = 0.0
            for j in range(3):
                local += rotation[j, i] * (target[marker, j] - pose[j])
            for number in range(len(shapes.angles)):
                squares[digits[marker], number] += (shapes.markers[number, marker, i] - local) ** 2
    for digit in range(5):
        nearest = squares[digit].argmin()
        pose[7 + 4 * digit : 11 + 4 * digit] = shapes.angles[nearest, 4 * digit : 4 * digit + 4]
        for marker in range(len(target)):
            if digits[marker] == digit:
                markers[marker] = shapes.markers[nearest, marker]
    for marker in range(len(target)):
        if digits[marker] < 0:
            markers[marker] = shapes.markers[0, marker]
