"""A first guess of the clock, the lens and the pose of a camera, from the hands in its video.

For each shift of the clock an affine camera is fitted to the keypoints that a detector found. PnP then finds
the pose for a few focal lengths.
"""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import cv2
import numpy as np

from handsim.errors import HandSimError
from render.film.bundle import FEWEST_KEYPOINTS, FOCAL, OFFSET, POSES, Bundle, State
from render.frames import Doubles, Flags

_STEP: Final = 1.0 / 15.0  # [s] step between the shifts of the clock
_ROUNDS: Final = 4  # rounds of matching
_MOST_MATCHED: Final = 64  # largest number of detections that are matched
_NOWHERE: Final = 1e3  # [m] where hands are that the take does not have
_TRIED: Final = 3  # number of best shifts for which PnP is tried
_APART: Final = 0.3  # [s] least distance of two of them
_FOCALS: Final = (0.5, 0.65, 0.85, 1.1, 1.45, 1.9, 2.5, 3.3)  # [widths] focal lengths that PnP is tried with
GATE: Final = 0.08  # [widths] A detection farther than this from a hand, in the median, is not its.
UNLIKE: Final = (
    "the hands in the video do not move as those of the take at any shift of the clock; expected a video of "
    "this take, of a camera that stood still"
)


def first_guess(bundle: Bundle) -> State:
    """Unknowns that explain most of what was found: clock by all shifts, pose by PnP."""
    gate, best, most = GATE * bundle.size[0], None, 0.0
    taken, filmed = bundle.motion.times, bundle.found.times
    shifts = np.arange(taken[0] - filmed[-1], taken[-1] - filmed[0], _STEP).tolist()
    tried: list[float] = []
    # The best fits are computed again, because those of all shifts together would fill the memory.
    clocks = itertools.product((False, True), shifts)
    for swapped, shift in sorted(clocks, key=lambda clock: -_affine_fit(bundle, *clock).agreeing):
        if len(tried) == _TRIED:
            break
        if any(abs(shift - other) < _APART for other in tried):
            continue
        tried.append(shift)
        start = _posed(bundle, _affine_fit(bundle, swapped, shift))
        if start is None:
            continue
        samples = bundle.samples(bundle.match(start, gate))
        state, *_ = bundle.solve(start, samples, 0.01 * bundle.size[0], first=True)
        agreeing = float(np.nansum(1.0 - bundle.match(state, gate).distances / gate))
        if agreeing > most:
            best, most = state, agreeing
    if best is None:
        raise HandSimError(UNLIKE)
    return best


class _AffineFit(NamedTuple):
    """What an affine camera explains at a shift of the clock."""

    offset: float
    points: Doubles  # (N, 21, 3): keypoints [m] of the hands that are nearest to some detections
    pixels: Doubles  # (N, 21, 2): of those detections [px]
    sure: Flags  # (N, 21): keypoints that were found, of hands that the take has
    agreeing: float  # number of detections that are explained


def _affine_fit(bundle: Bundle, swapped: bool, offset: float) -> _AffineFit:
    """The affine camera that explains most of what was found at a shift.

    It begins with the sides that the detector told, or with the other ones, and then gives each detection to
    the hand that is nearest in the picture: a detector is often wrong about sides.
    """
    found, motion = bundle.found, bundle.motion
    some = np.unique(np.linspace(0, len(found.frames) - 1, _MOST_MATCHED).astype(int))
    pixels, weights = found.pixels[some], found.weights[some]
    times = found.times[found.frames[some]] + offset
    points = np.nan_to_num(motion.at(times)[0], nan=_NOWHERE)  # (N, H, 21, 3)
    there = points[..., 0, 0] != _NOWHERE
    rows = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    told = there & (motion.sides == np.where(swapped, 1 - found.sides[some], found.sides[some])[:, None])
    hand, counts, each = told.argmax(axis=1), told.any(axis=1).astype(float), np.arange(len(some))
    for _ in range(_ROUNDS):
        mine = rows[each, hand]
        weighted = mine * (weights * counts[:, None])[..., None]
        normal = np.einsum("nki,nkj->ij", weighted, mine) + 1e-6 * np.eye(4)
        affine = np.linalg.solve(normal, np.einsum("nki,nkj->ij", weighted, pixels))
        away = np.linalg.norm(rows @ affine - pixels[:, None], axis=-1)
        away = (away * weights[:, None]).sum(axis=-1) / weights.sum(axis=1)[:, None]
        distances = np.where(there, away, np.inf)
        hand = distances.argmin(axis=1)
        counts = 1.0 / (1.0 + (distances.min(axis=1) / (2.0 * GATE * bundle.size[0])) ** 2)
    sure = (weights > 0.0) & there[each, hand, None]
    return _AffineFit(offset, points[each, hand], pixels, sure, float(counts.sum()))


def _posed(bundle: Bundle, fit: _AffineFit) -> State | None:
    """The focal length and pose by which most keypoints are explained, or None."""
    points, pixels = fit.points[fit.sure], fit.pixels[fit.sure]
    if len(points) < 6 * FEWEST_KEYPOINTS:
        return None
    best, most = None, 0
    for focal in _FOCALS if bundle.given is None else (1.0,):
        values = np.zeros(POSES + 6)
        values[OFFSET], values[FOCAL] = fit.offset, np.log(focal)
        try:
            done, turn, shift, inliers = cv2.solvePnPRansac(
                points, pixels, bundle.matrix(values), None, iterationsCount=300,
                reprojectionError=0.025 * bundle.size[0], flags=cv2.SOLVEPNP_EPNP,
            )  # fmt: skip
        except cv2.error:  # points of a degenerate draw
            continue
        if done and inliers is not None and len(inliers) > most:
            values[POSES:] = np.concatenate([turn.ravel(), shift.ravel()])
            best, most = State(values), len(inliers)
    return best
