"""Calibration of all hands in a capture of unlabeled points: labels, hands, and whether they are better."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.fit import GloveFit, attach
from gloves.takes.take import INITIALIZED, TRACKED, Take
from handsim.errors import HandSimWarning
from handsim.hand.topology import Side
from track.calibration.frames import CalibrationError
from track.calibration.hand_size import sample_frames
from track.calibration.user_calibration import (
    MOST_STEPS,
    Calibration,
    HeldOut,
    calibrate_hand,
    calibrate_hands,
)
from track.capture_tracking import track_capture
from track.config import BOTH, Size, TrackerConfig
from track.given import AnyCapture, AnyGlove, AnyLabeler, capture_of
from track.kinematics.pose_solver import PoseSolver
from track.setup import AnyHands, TrackerSetup, found_user
from track.streams.frame_source import checked_frames
from track.user import User
from train.labelers.protocol import Labeler

CalibrationProgress = Callable[[str, int, int], None]
_SHOWN: Final = 0.05  # share of the frames in which a hand must be tracked to be calibrated
_NEAR: Final = 0.015  # [m]: largest residual of a marker on a hand of another size
_LEFT_OVER: Final = 0.005  # share of the markers that the first round may leave unlabeled
_BLOCK: Final = 1.0  # [s] of frames that are held out together, since neighbors are much alike
_HELD_OUT: Final = 5  # one block of so many is held out
_MOST_CHECKED: Final = 400  # frames that are held out
_FEWEST_SEEN: Final = 0.75  # share of the markers of such a frame


def calibrate(
    capture: AnyCapture,
    glove: AnyGlove | None = None,
    *,
    hands: AnyHands = BOTH,
    size: Size = "auto",
    labeler: AnyLabeler = None,
    progress: CalibrationProgress | None = None,
) -> User:
    """Fit hands and gloves to their user, from a capture in which every joint moves and fingertips touch.

    The capture is labeled by the tracker. If some markers stay unlabeled, it is labeled once more with the
    calibrated hands. Whether a hand became better is measured on frames that another calibration of it did
    not use; a warning says where it did not.

    Args:
        capture: Points [m] of half a minute or more, or the path of a marker file or a take; names of markers
            are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file; when not given that of
            `hands`, or dense19 for hands that are measured.
        hands: Which hands may be in the capture; or hands to begin with, as `track_capture` takes them.
        size: The size to begin with: XS, S, M, L, XL, or auto, which measures it in the capture.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        progress: Called with what is done, such as "frames", how much of it, and of how much.

    Returns:
        The hands that are in the capture; its `calibrations` tell of each how it was found: residuals,
        standard errors, `held_out` and `suggestions()` for a better capture.

    Raises:
        CalibrationError: No hand is in the capture, or it tells too little of one.
        ArgumentError: The capture is not in meters, or arguments do not go together.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.
    """
    told = progress if progress is not None else _untold
    setup = TrackerSetup.of(glove, hands, size, labeler, (), TrackerConfig())
    source = capture_of(capture)
    first, network = setup.user, setup.labeler
    start = first.hands
    if setup.is_measured:
        found = found_user(sample_frames(checked_frames(source)), first.layout, first.sides, network)
        first = found or first
        start = tuple(attach(hand.layout, hand.model) for hand in first)
    take = _label(source, first, network, told)
    done = _calibrate(take, start, told)
    if _leaves_markers(take, done):
        take = _label(source, [calibration.hand for calibration in done], network, told)
        done = _calibrate(take, start, told)
    done = tuple(_checked(take, one, first, told) for one in done)
    name = Path(capture).name if isinstance(capture, str | Path) else "a capture"
    notes = f"calibrated from {name}, {first.notes.removeprefix('auto, ') or first} to begin with"
    return User(tuple(one.hand for one in done), notes, done)


def _untold(what: str, done: int, total: int) -> None:
    """Nobody asks how far it is."""


def _label(
    source: AnyCapture, known: Sequence[GloveFit], labeler: Labeler, told: CalibrationProgress
) -> Take:
    """The capture with labels, by the hands that are known so far."""
    return track_capture(source, hands=known, labeler=labeler, progress=partial(told, "frames"))


def _calibrate(take: Take, start: Sequence[GloveFit], told: CalibrationProgress) -> tuple[Calibration, ...]:
    """The hands that are in a take, calibrated."""
    shown = [side for side in take.sides if _reliable(take, side).mean() > _SHOWN]
    if not shown:
        raise CalibrationError(
            f"no {' and no '.join(take.sides)} hand was found in the capture; expected half a minute of one"
        )
    return calibrate_hands(
        {side: _markers(take, side) for side in shown},
        [hand for hand in start if hand.side in shown],
        take.rate,
        progress=lambda side, step, *_: told(f"steps for the {side} hand", step, MOST_STEPS),
    )


def _checked(
    take: Take, done: Calibration, before: Sequence[GloveFit], told: CalibrationProgress
) -> Calibration:
    """A calibration with how it does on held-out frames; a warning says if that is no better than before."""
    side = done.hand.side
    (worn,) = (hand for hand in before if hand.side == side)
    told(f"check of the {side} hand", 0, 1)
    held_out = _held_out(_markers(take, side), done.start, worn, take.rate)
    if held_out is not None and not held_out.is_better:
        warnings.warn(
            f"the calibrated {side} hand is no better on held-out frames: its markers are "
            f"{1e3 * held_out.after:.2f} mm off, {1e3 * held_out.before:.2f} mm before; capture a minute in "
            "which every joint moves, or track without it",
            HandSimWarning,
            stacklevel=3,
        )
    return dataclasses.replace(done, held_out=held_out)


def _held_out(
    markers: Float[np.ndarray, "T M 3"], start: GloveFit, before: GloveFit, rate: float
) -> HeldOut | None:
    """How well hands fit one second in five that a calibration does not see; None if they tell too little.

    Args:
        markers: Labeled markers [m], NaN where missing.
        start: What the calibration begins with.
        before: The hand without calibration.
        rate: Frames per second [Hz].
    """
    block = max(1, round(_BLOCK * rate))
    out = np.arange(len(markers)) // block % _HELD_OUT == _HELD_OUT - 1
    seen = np.isfinite(markers[..., 0]).mean(axis=1) >= _FEWEST_SEEN
    frames = np.flatnonzero(out & seen)
    frames = frames[:: -(-len(frames) // _MOST_CHECKED) or 1]
    try:
        without = calibrate_hand(np.where(out[:, None, None], np.nan, markers), start, rate).hand
    except CalibrationError:
        return None
    if not len(frames):
        return None
    rms = [float(np.median(PoseSolver(hand).solve(markers[frames]).rms)) for hand in (before, without)]
    return HeldOut(rms[0], rms[1], len(frames))


def _markers(take: Take, side: Side) -> Float[np.ndarray, "T M 3"]:
    """The reliably labeled markers of a hand [m]; NaN for the others."""
    markers = take.observed(side)
    markers[~_reliable(take, side)] = np.nan
    return markers


def _reliable(take: Take, side: Side) -> Bool[np.ndarray, "T"]:
    """Frames whose labels are reliable."""
    reliable: Bool[np.ndarray, "T"] = np.isin(take.status[:, take.hand(side)], (TRACKED, INITIALIZED))
    return reliable


def _leaves_markers(take: Take, done: Sequence[Calibration]) -> bool:
    """Whether too many missing markers had an unlabeled point nearby."""
    from scipy.spatial.distance import cdist

    left, total = 0, 0
    for one in done:
        side = one.hand.side
        filled, markers = take.filled(side), take.markers(side)
        total += filled.size
        for frame in np.flatnonzero(filled.any(axis=1) & _reliable(take, side)):
            free = take.points[frame, take.labels[frame] < 0]
            expected = markers[frame, filled[frame]]
            left += int((cdist(expected, free[np.isfinite(free[:, 0])]) < _NEAR).any(axis=1).sum())
    return left > _LEFT_OVER * total
