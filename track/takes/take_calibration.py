"""Calibration of the hands of a labeled take, and its test on held-out frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.takes.take import INITIALIZED, TRACKED, Take
from handsim.errors import CalibrationError
from handsim.hand.shape import Side
from track.alternatives.alternatives import doubts_of
from track.calibration.energy import Progress
from track.calibration.user_calibration import MOST_STEPS, Calibration, HeldOut, calibrate_hand
from track.kinematics.pose_solver import PoseSolver
from track.user import AS_MEASURED, MEASURED, User

OnPart = Callable[[str, int, int], None]
"""Called with the name of a step, such as "frames", and the amounts done and in total."""
_SHOWN: Final = 0.05  # A hand must be tracked in this share of the frames to be calibrated.
_NEAR: Final = 0.015  # [m] largest residual of a marker on a hand of another size
_LEFT_OVER: Final = 0.005  # The first round may leave this share of missing markers unlabeled.
_BLOCK: Final = 1.0  # [s] duration of frames held out together, since neighbors are much alike
_BLOCKS: Final = 6  # least number of such blocks
_HELD_OUT: Final = 3  # one of this many blocks is held out
_MOST_CHECKED: Final = 400  # largest number of held-out frames
_FEWEST_SEEN: Final = 0.75  # Held-out frames must show this share of the markers.


def calibrate_take(
    take: Take,
    start: Sequence[GloveFit],
    before: Sequence[GloveFit],
    on_part: OnPart = lambda step, done, total: None,
) -> tuple[Calibration, ...]:
    """Calibrate the hands in a take on two thirds of its frames, and test them on the others.

    Only labels of tracked hands count. Each side starts from `start`; the take was labeled with `before`.
    """
    there = [hand for hand in start if hand.side in take.sides]
    shown = [hand for hand in there if _reliable(take, hand.side).mean() > _SHOWN]
    if not shown:
        raise CalibrationError(
            f"no {' and no '.join(take.sides)} hand was found in the capture; expected half a minute of one"
        )
    worn = {hand.side: hand for hand in before}
    # Hold out every third second, or a shorter block of a short take.
    block = max(1, min(round(_BLOCK * take.rate), take.num_frames // _BLOCKS))
    out: NDArray[np.bool_] = np.arange(take.num_frames) // block % _HELD_OUT == _HELD_OUT - 1
    done = []
    for hand in shown:
        markers = _markers(take, hand.side)
        seen = np.where(out[:, None, None], np.nan, markers)
        one = calibrate_hand(seen, hand, take.rate, progress=_steps(hand.side, on_part))
        tried = _tried(markers[out], worn[hand.side], one.hand)
        done.append(dataclasses.replace(one, held_out=tried))
    return _with_likelier_labels(take, done)


def _with_likelier_labels(take: Take, done: Sequence[Calibration]) -> tuple[Calibration, ...]:
    """Calibrations that say which other labels fit the points of a better hand better than the take's.

    Shifted places of markers explain labels that are wrong throughout, and held-out frames, labeled alike,
    confirm them.
    """
    doubts = doubts_of(take) if any(one.is_better for one in done) else {}  # of all hands, in seconds
    told = []
    for one in done:
        tried, doubt = one.held_out, doubts.get(one.hand.side)
        if tried is not None and tried.is_better and doubt is not None:
            tried = tried._replace(other_labels=doubt.tried[0].words)
        told.append(dataclasses.replace(one, held_out=tried))
    return tuple(told)


def kept_user(
    take: Take,
    done: Sequence[Calibration],
    before: User,
    source: str,
    on_part: OnPart = lambda step, done, total: None,
) -> User:
    """The user with calibrated hands where these fit held-out frames better, and the hands before elsewhere.

    `done` comes from `calibrate_take`, `before` are the hands that labeled the take, and `source` tells where
    the frames are from, such as "from take.c3d".
    """
    worn, hands, whole, errors = {hand.side: hand for hand in before}, [], [], dict(before.errors)
    notes = [f"calibrated {source}, {before.notes.removeprefix(MEASURED) or before} to begin with"]
    for one in done:
        side, remark = one.hand.side, ""
        if one.is_better:
            markers, on_step = _markers(take, side), _steps(side, on_part)
            again = calibrate_hand(markers, one.start, take.rate, progress=on_step)
            one = dataclasses.replace(again, held_out=one.held_out)  # noqa: PLW2901
            errors[side] = one.errors
        elif not before.is_calibrated(side):
            remark = AS_MEASURED  # `is_calibrated` recognizes this remark
        hands.append(one.hand if one.is_better else worn[side])
        notes.append(f"{side} hand: {one}{remark}")
        whole.append(one)
    return User(tuple(hands), "; ".join(notes), tuple(whole), errors)


def leaves_markers(take: Take, done: Sequence[Calibration]) -> bool:
    """Whether too many missing markers have an unlabeled point nearby."""
    from scipy.spatial.distance import cdist

    left, total = 0, 0
    for one in done:
        side = one.hand.side
        filled, markers = take.filled(side), take.markers(side)
        total += filled.size
        for frame in np.flatnonzero(filled.any(axis=1) & _reliable(take, side)):
            own = take.point_list.of(frame)
            free = take.point_list.points[own][take.point_list.labels[own] < 0]
            expected = markers[frame, filled[frame]]
            left += int((cdist(expected, free) < _NEAR).any(axis=1).sum())
    return left > _LEFT_OVER * total


def _tried(markers: Float[np.ndarray, "T M 3"], before: GloveFit, after: GloveFit) -> HeldOut | None:
    """Residuals of two hands on held-out markers [m], NaN where missing; None if no frame shows enough."""
    frames = np.flatnonzero(np.isfinite(markers[..., 0]).mean(axis=1) >= _FEWEST_SEEN)
    if not len(frames):
        return None
    seen = markers[frames[:: -(-len(frames) // _MOST_CHECKED)]]
    first = PoseSolver(before).solve(seen)
    last = PoseSolver(after).solve(seen, first.qpos)
    return HeldOut(float(np.median(first.rms)), float(np.median(last.rms)), len(seen))


def _steps(side: Side, on_part: OnPart) -> Progress:
    """Progress callback of one hand."""
    return lambda step: on_part(f"steps for the {side} hand", min(step, MOST_STEPS), MOST_STEPS)


def _markers(take: Take, side: Side) -> Float[np.ndarray, "T M 3"]:
    """The reliably labeled markers of a hand [m]; NaN for the others."""
    markers = take.observed(side)
    markers[~_reliable(take, side)] = np.nan
    return markers


def _reliable(take: Take, side: Side) -> Bool[np.ndarray, "T"]:
    """Whether the labels of each frame are reliable."""
    return np.isin(take.status[:, take.hand_index(side)], (TRACKED, INITIALIZED))
