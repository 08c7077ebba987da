"""Frames of a capture: which a calibration can use, their poses, and which of them tell most."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from gloves.attachment import Attachment
from gloves.fit import GloveFit
from handsim.errors import ArgumentError, HandSimError
from handsim.hand.topology import BONES, DIGITS, NUM_JOINTS
from track.calibration.report import ENOUGH_RANGE, still_joints
from track.kinematics.pose_solver import PoseSolver

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

NUM_FRAMES: Final = 160
FEWEST_FRAMES: Final = 100
_CANDIDATES: Final = 800
_SOLVABLE: Final = 6  # markers at least
_SHARE: Final = 0.75  # of the markers
_STEADY: Final = 3.0  # times the usual RMS


class CalibrationError(HandSimError):
    """A capture that says too little of the hand."""


class Track(NamedTuple):
    """Poses of some frames."""

    frames: NDArray[np.int64]
    qpos: NDArray[np.float64]
    rms: NDArray[np.float64]


def check_markers(markers: Float[np.ndarray, "T M 3"], start: GloveFit, rate: float) -> NDArray[np.float64]:
    """A copy in which a marker is there or NaN.

    Raises:
        ArgumentError: `markers` do not fit the glove, or `rate` is not positive.
    """
    values = np.array(markers, dtype=np.float64)
    count = start.attachment.layout.num_markers
    if values.ndim != 3 or values.shape[1:] != (count, 3):
        raise ArgumentError(f"markers have shape {values.shape}, expected (T, {count}, 3) for this glove")
    if not 0.0 < rate < np.inf:
        raise ArgumentError(f"rate is {rate:g} Hz, expected a positive number")
    values[~np.isfinite(values).all(axis=2)] = np.nan
    return values


def usable_frames(markers: Float[np.ndarray, "T M 3"], hand: GloveFit) -> NDArray[np.int64]:
    """Frames with enough markers to be looked at.

    Raises:
        CalibrationError: They are too few.
    """
    count = markers.shape[1]
    needed = min(count, max(_SOLVABLE, round(_SHARE * count)))
    usable = np.flatnonzero(np.isfinite(markers[..., 0]).sum(axis=1) >= needed)
    if len(usable) < FEWEST_FRAMES:
        raise CalibrationError(
            f"{len(usable)} of {len(markers)} frames have {needed} or more of the {hand.side} hand's {count} "
            f"markers, expected at least {FEWEST_FRAMES} such frames"
        )
    return usable


def follow(
    markers: Float[np.ndarray, "T M 3"],
    hand: GloveFit,
    frames: NDArray[np.int64],
    initial: NDArray[np.float64] | None = None,
) -> Track:
    """Poses of some frames."""
    found = PoseSolver(hand).solve(markers[frames], initial)
    return Track(frames, found.qpos, found.rms)


def first_look(markers: Float[np.ndarray, "T M 3"], hand: GloveFit, usable: NDArray[np.int64]) -> Track:
    """Poses of frames all along the capture, on the hand that a calibration begins with."""
    return follow(markers, hand, usable[:: max(1, len(usable) // _CANDIDATES)])


def check_motion(track: Track, whole: Bool[np.ndarray, "T 5"], hand: GloveFit) -> None:
    """See that the hand moves.

    Raises:
        CalibrationError: More than half of its hinges are still.
    """
    still = still_joints(track.qpos[:, 7:], whole[track.frames], hand.model)
    if 2 * len(still) > NUM_JOINTS:
        raise CalibrationError(
            f"{len(still)} of the {hand.side} hand's {NUM_JOINTS} hinges cover less than {ENOUGH_RANGE:.0%} "
            "of their range while their digit's markers are all there, expected a capture in which all move"
        )


def whole_digits(markers: Float[np.ndarray, "T M 3"], attachment: Attachment) -> Bool[np.ndarray, "T 5"]:
    """Whether all markers of a digit are there."""
    there = np.isfinite(markers[..., 0])
    bones = attachment.main_bones
    digits = np.array([BONES[bone].digit for bone in bones])
    return np.stack([there[:, digits == digit].all(axis=1) for digit in range(len(DIGITS))], axis=1)


def telling_frames(track: Track, markers: Float[np.ndarray, "T M 3"]) -> NDArray[np.int64]:
    """Places in a track of frames as unlike each other as can be, those that lack no marker first."""
    lacking = np.isnan(markers[track.frames, :, 0]).sum(axis=1)
    steady = track.rms <= _STEADY * np.median(track.rms)
    for allowed in range(markers.shape[1]):
        candidates = np.flatnonzero((lacking <= allowed) & steady)
        if len(candidates) >= min(3 * NUM_FRAMES, steady.sum()):
            break
    angles = track.qpos[candidates, 7:]
    distance = np.full(len(candidates), np.inf)
    chosen = [int(np.abs(angles - angles.mean(axis=0)).sum(axis=1).argmax())]
    while len(chosen) < min(NUM_FRAMES, len(candidates)):
        distance = np.minimum(distance, ((angles - angles[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(distance.argmax()))
    picked: NDArray[np.int64] = candidates[np.sort(chosen)]
    return picked
