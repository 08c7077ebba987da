"""Calibration of the hands of a labeled take, and its test on held-out frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.fit import GloveFit
from gloves.takes.take import INITIALIZED, TRACKED, Take
from handsim.arrays import Flags
from handsim.errors import CalibrationError
from handsim.hand.shape import Side
from track.alternatives.alternatives import doubts_of
from track.calibration.energy import Progress
from track.calibration.user_calibration import MOST_STEPS, Calibration, HeldOut, calibrate_hand
from track.kinematics.pose_solver import PoseSolver
from track.user import AS_MEASURED, MEASURED, User

OnPart = Callable[[str, int, int], None]
"""Called with the name of a step, such as "frames", and the amounts done and in total."""
_LEAST_SHOWN_SHARE: Final = 0.05  # A hand must be tracked in this share of the frames to be calibrated.
# [m] An unlabeled point this close may be the missing marker of a hand of another size.
_NEAR_DISTANCE: Final = 0.015
_MOST_LEFT_SHARE: Final = 0.005  # The first round may leave this share of missing markers unlabeled.
_BLOCK_TIME: Final = 1.0  # [s] duration of frames held out together, since neighbors are much alike
_FEWEST_BLOCKS: Final = 6  # least number of such blocks
_HELD_OUT_PERIOD: Final = 3  # One of this many blocks is held out.
_MOST_CHECKED: Final = 400  # largest number of held-out frames
_LEAST_SEEN_SHARE: Final = 0.75  # A held-out frame must show this share of the markers.


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
    shown = [hand for hand in there if _is_reliable(take, hand.side).mean() > _LEAST_SHOWN_SHARE]
    if not shown:
        raise CalibrationError(
            f"no {' and no '.join(take.sides)} hand was found in the capture; expected half a minute of one"
        )
    worn = {hand.side: hand for hand in before}
    # Hold out every third second, or a shorter block of a short take.
    block = max(1, min(round(_BLOCK_TIME * take.rate), take.num_frames // _FEWEST_BLOCKS))
    out: Flags = np.arange(take.num_frames) // block % _HELD_OUT_PERIOD == _HELD_OUT_PERIOD - 1
    done = []
    for hand in shown:
        markers = _reliable_markers(take, hand.side)
        seen = np.where(out[:, None, None], np.nan, markers)
        one = calibrate_hand(seen, hand, take.rate, progress=_steps(hand.side, on_part))
        tried = _compare(markers[out], worn[hand.side], one.hand)
        done.append(dataclasses.replace(one, held_out=tried))
    return _with_likelier_labels(take, done)


def _with_likelier_labels(take: Take, done: Sequence[Calibration]) -> tuple[Calibration, ...]:
    """Note in calibrations of better hands which other labels fit the points better than the take's.

    A calibration explains labels that are wrong throughout by shifted markers, and held-out frames, which
    have the same labels, confirm it.
    """
    doubts = doubts_of(take) if any(one.is_better for one in done) else {}  # of all hands, in seconds
    noted = []
    for one in done:
        tried, doubt = one.held_out, doubts.get(one.hand.side)
        if tried is not None and tried.is_better and doubt is not None:
            tried = tried._replace(other_labels=doubt.tried[0].words)
        noted.append(dataclasses.replace(one, held_out=tried))
    return tuple(noted)


def kept_user(
    take: Take,
    done: Sequence[Calibration],
    before: User,
    source: str,
    on_part: OnPart = lambda step, done, total: None,
) -> User:
    """The user with calibrated hands where these fit held-out frames better, and the hands before elsewhere.

    `done` comes from `calibrate_take`, `before` are the hands that labeled the take, and `source` names the
    origin of the frames, such as "from take.c3d".
    """
    worn, hands, whole, errors = {hand.side: hand for hand in before}, [], [], dict(before.errors)
    notes = [f"calibrated {source}, {before.notes.removeprefix(MEASURED) or before} to begin with"]
    for one in done:
        side, remark = one.hand.side, ""
        if one.is_better:
            markers, on_step = _reliable_markers(take, side), _steps(side, on_part)
            again = calibrate_hand(markers, one.start, take.rate, progress=on_step)
            one = dataclasses.replace(again, held_out=one.held_out)  # noqa: PLW2901
            errors[side] = one.errors
        elif not before.is_calibrated(side):
            remark = AS_MEASURED  # `User.is_calibrated` recognizes this remark.
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
        for frame in np.flatnonzero(filled.any(axis=1) & _is_reliable(take, side)):
            own = take.point_list.of(frame)
            free = take.point_list.points[own][take.point_list.labels[own] < 0]
            expected = markers[frame, filled[frame]]
            left += int((cdist(expected, free) < _NEAR_DISTANCE).any(axis=1).sum())
    return left > _MOST_LEFT_SHARE * total


def _compare(markers: Float[np.ndarray, "T M 3"], before: GloveFit, after: GloveFit) -> HeldOut | None:
    """Compare two hands on held-out markers [m], NaN where missing; None if no frame shows enough."""
    frames = np.flatnonzero(np.isfinite(markers[..., 0]).mean(axis=1) >= _LEAST_SEEN_SHARE)
    if not len(frames):
        return None
    seen = markers[frames[:: -(-len(frames) // _MOST_CHECKED)]]
    first = PoseSolver(before).solve(seen)
    last = PoseSolver(after).solve(seen, first.qpos)
    return HeldOut(float(np.median(first.rms)), float(np.median(last.rms)), len(seen))


def _steps(side: Side, on_part: OnPart) -> Progress:
    """Progress callback of one hand."""
    return lambda step: on_part(f"steps for the {side} hand", min(step, MOST_STEPS), MOST_STEPS)


def _reliable_markers(take: Take, side: Side) -> Float[np.ndarray, "T M 3"]:
    """The reliably labeled markers of a hand [m]; NaN for the others."""
    markers = take.observed(side)
    markers[~_is_reliable(take, side)] = np.nan
    return markers


def _is_reliable(take: Take, side: Side) -> Bool[np.ndarray, "T"]:
    """Whether the labels of each frame are reliable."""
    return np.isin(take.status[:, take.hand_index(side)], (TRACKED, INITIALIZED))
