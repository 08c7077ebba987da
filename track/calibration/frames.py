"""Frames of a capture: those that a calibration can use, their poses, and the most informative of them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import Attachment, GloveFit
from handsim.errors import ArgumentError, HandSimError
from handsim.hand.shape import BONES, DIGITS
from track.kinematics.pose_solver import PoseSolver

NUM_FRAMES: Final = 240
"""Frames that a calibration is solved on."""
FEWEST_FRAMES: Final = 100
"""Usable frames without which a capture is refused."""
_INITIAL_FRAMES: Final = 800
_FEWEST_MARKERS: Final = 6  # that a frame must have
_MARKER_SHARE: Final = 0.75  # of the markers that a frame must have
_MOST_RMS: Final = 3.0  # times the median RMS, up to which a frame is used


class CalibrationError(HandSimError):
    """A capture that does not determine what is calibrated from it."""


class PoseTrack(NamedTuple):
    """Poses of K frames of a capture."""

    frames: Int[np.ndarray, "K"]
    """Their numbers in the capture."""
    qpos: Float[np.ndarray, "K 27"]
    rms: Float[np.ndarray, "K"]
    """3D RMS distance of the markers from the model's [m]."""
    residuals: Float[np.ndarray, "K M 3"]
    """Model minus marker [m], NaN where a marker is missing."""


def check_markers(markers: Float[np.ndarray, "T M 3"], start: GloveFit, rate: float) -> NDArray[np.float64]:
    """A copy of the markers [m] in which a marker has three finite coordinates or three NaN."""
    values = np.array(markers, dtype=np.float64)
    count = start.attachment.layout.num_markers
    if values.ndim != 3 or values.shape[1:] != (count, 3):
        raise ArgumentError(f"markers have shape {values.shape}, expected (T, {count}, 3) for this glove")
    if not 0.0 < rate < np.inf:
        raise ArgumentError(f"rate is {rate:g} Hz, expected a positive number")
    values[~np.isfinite(values).all(axis=2)] = np.nan
    return values


def usable_frames(markers: Float[np.ndarray, "T M 3"], hand: GloveFit) -> NDArray[np.int64]:
    """Numbers of the frames with enough markers for a pose."""
    count = markers.shape[1]
    needed = min(count, max(_FEWEST_MARKERS, round(_MARKER_SHARE * count)))
    usable = np.flatnonzero(np.isfinite(markers[..., 0]).sum(axis=1) >= needed)
    if len(usable) < FEWEST_FRAMES:
        raise CalibrationError(
            f"{len(usable)} of {len(markers)} frames have {needed} or more of the {hand.side} hand's {count} "
            f"markers, expected at least {FEWEST_FRAMES} such frames"
        )
    return usable


def solve_frames(
    markers: Float[np.ndarray, "T M 3"],
    hand: GloveFit,
    frames: NDArray[np.int64],
    initial: NDArray[np.float64] | None = None,
) -> PoseTrack:
    """Solve the poses of some frames.

    Args:
        markers: All markers of the capture [m]; NaN where missing.
        frames: Numbers of the frames (K,).
        initial: Poses to start from (K, 27).
    """
    solved = PoseSolver(hand).solve(markers[frames], initial)
    return PoseTrack(frames, solved.qpos, solved.rms, solved.residuals)


def initial_poses(
    markers: Float[np.ndarray, "T M 3"], hand: GloveFit, usable: NDArray[np.int64]
) -> PoseTrack:
    """Poses of frames spread over the capture, on the hand that a calibration begins with."""
    return solve_frames(markers, hand, usable[:: max(1, len(usable) // _INITIAL_FRAMES)])


def complete_digits(markers: Float[np.ndarray, "T M 3"], attachment: Attachment) -> Bool[np.ndarray, "T 5"]:
    """Whether all markers of a digit are seen."""
    present = np.isfinite(markers[..., 0])
    bones = attachment.main_bones
    digits = np.array([BONES[bone].digit for bone in bones])
    return np.stack([present[:, digits == digit].all(axis=1) for digit in range(len(DIGITS))], axis=1)


def informative_frames(track: PoseTrack, markers: Float[np.ndarray, "T M 3"]) -> NDArray[np.int64]:
    """Indices into a track of up to `NUM_FRAMES` frames with poses as different as possible.

    Frames without missing markers are preferred; frames with an unusual RMS are left out.
    """
    missing = np.isnan(markers[track.frames, :, 0]).sum(axis=1)
    well_fitted = track.rms <= _MOST_RMS * np.median(track.rms)
    for allowed in range(markers.shape[1]):
        candidates = np.flatnonzero((missing <= allowed) & well_fitted)
        if len(candidates) >= min(3 * NUM_FRAMES, well_fitted.sum()):
            break
    angles = track.qpos[candidates, 7:]
    distance = np.full(len(candidates), np.inf)
    chosen = [int(np.abs(angles - angles.mean(axis=0)).sum(axis=1).argmax())]
    while len(chosen) < min(NUM_FRAMES, len(candidates)):
        distance = np.minimum(distance, ((angles - angles[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(distance.argmax()))
    picked: NDArray[np.int64] = candidates[np.sort(chosen)]
    return picked
