"""A first guess of the clock, the lens and the pose of a camera, from the hands in its video.

For each shift of the clock an affine camera is fitted to the keypoints that a detector found. PnP then finds
the pose for a few focal lengths.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from handsim.errors import HandSimError
from render.film.bundle import FEWEST_KEYPOINTS, FOCAL, OFFSET, POSES, Bundle, State
from render.frames import Doubles, Flags

_STEP: Final = 1.0 / 30.0  # [s] step between the shifts of the clock
_OVERLAP: Final = 0.5  # A shift must cover this share of the most keypoints that any shift covers.
_SHIFTS: Final = 60  # number of shifts at which hands are matched, with sides as told and exchanged
_CLOSE, _APART = 0.1, 0.3  # [s] least distance of two such shifts, and of two for which PnP is tried
_ROUNDS: Final = 5  # rounds of matching
_MOST_MATCHED: Final = 400  # largest number of detections that are matched
_NOWHERE: Final = 1e3  # [m] where hands are that the take does not have
_TRIED: Final = 3  # number of best matches for which PnP is tried
_FOCALS: Final = (0.5, 0.65, 0.85, 1.1, 1.45, 1.9, 2.5, 3.3)  # [widths] focal lengths that PnP is tried with
_CLOCK_KEYPOINTS: Final = (0, 4, 5, 8, 9, 12, 16, 17, 20)
GATE: Final = 0.08  # [widths] A detection farther than this from a hand, in the median, is not its.
UNLIKE: Final = (
    "the hands in the video do not move as those of the take at any shift of the clock; expected a video of "
    "this take, of a camera that stood still"
)


def first_guess(bundle: Bundle) -> State:
    """Unknowns that explain most of what was found: clock by all shifts, pose by PnP."""
    gate, best, most = GATE * bundle.size[0], None, 0.0
    fits = [_affine_fit(bundle, *one) for swapped in (False, True) for one in _shifts(bundle, swapped)]
    tried: list[float] = []
    for fit in sorted(fits, key=lambda fit: -fit.agreeing):
        if len(tried) == _TRIED:
            break
        if any(abs(fit.offset - other) < _APART for other in tried):
            continue
        tried.append(fit.offset)
        start = _posed(bundle, fit)
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


def _affine_fit(bundle: Bundle, offset: float, swapped: bool) -> _AffineFit:
    """The affine camera that explains most of what was found at a shift.

    It begins with the sides that the detector told, or with the other ones, and then gives each detection to
    the hand that is nearest in the picture: a detector is often wrong about sides.
    """
    found, motion = bundle.found, bundle.motion
    some = np.unique(np.linspace(0, len(found.frames) - 1, _MOST_MATCHED).astype(int))
    pixels, weights = found.pixels[some], found.weights[some]
    points = np.nan_to_num(
        motion.at(found.times[found.frames[some]] + offset)[0], nan=_NOWHERE
    )  # (N, H, 21, 3)
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


def _shifts(bundle: Bundle, swapped: bool) -> list[tuple[float, bool]]:
    """The offsets of the clock at which an affine camera explains the pictures best.

    An affine camera maps keypoints x to pixels A x + b. All sums that its fit needs are correlations of the
    two series, which FFT yields for all shifts at once.
    """
    found, motion = bundle.found, bundle.motion
    first, begin = float(motion.times[0]), float(found.times.min())
    ticks = np.arange(first, motion.times[-1], _STEP)
    points = motion.at(ticks)[0][:, :, list(_CLOCK_KEYPOINTS)]
    points = points - np.nanmedian(points, axis=(0, 1, 2))
    nodes = np.rint((found.times - begin) / _STEP).astype(np.int64)
    count = int(nodes.max()) + 1
    length = next_fast_len(len(ticks) + count, real=True)
    order = np.argsort(found.confidence, kind="stable")
    sums = np.zeros((19, length // 2 + 1), dtype=np.complex128)
    for hand, side in enumerate(motion.sides):
        mine = order[found.sides[order] == (1 - side if swapped else side)]
        for number, keypoint in enumerate(_CLOCK_KEYPOINTS):
            seen = np.zeros((4, count))
            sure = mine[found.weights[mine, keypoint] > 0.0]
            pixels = found.pixels[sure, keypoint] / bundle.size[0] - 0.5
            at = nodes[found.frames[sure]]
            seen[:, at] = np.stack([np.ones(len(at)), *pixels.T, (pixels**2).sum(axis=1)])
            x = points[:, hand, number]
            rows = np.concatenate([np.isfinite(x[:, :1]), np.nan_to_num(x)], axis=1).T
            rows = np.concatenate([rows, rows[[1, 1, 1, 2, 2, 3]] * rows[[1, 2, 3, 2, 3, 3]]])
            taken, filmed = rfft(rows, length), np.conj(rfft(seen, length))
            sums[:10] += taken * filmed[0]
            sums[10:14] += taken[:4] * filmed[1]
            sums[14:18] += taken[:4] * filmed[2]
            sums[18] += taken[0] * filmed[3]
    values = irfft(sums, length)
    shifts = np.arange(length)
    shifts = np.where(shifts >= len(ticks), shifts - length, shifts)
    score = values[0] * np.log(_affine_residuals(values))
    score[values[0] < max(_OVERLAP * values[0].max(), 6.0 * len(_CLOCK_KEYPOINTS))] = np.inf
    offsets: list[float] = []
    for index in np.argsort(score):
        offset = float(first + shifts[index] * _STEP - begin)
        if not np.isfinite(score[index]) or len(offsets) == _SHIFTS:
            break
        if all(abs(offset - other) >= _CLOSE for other in offsets):
            offsets.append(offset)
    return [(offset, swapped) for offset in offsets]


def _affine_residuals(sums: Doubles) -> Doubles:
    """The share of the pixels' variance that an affine camera leaves, for sums (19, L) of `_shifts`."""
    count = np.maximum(sums[0], 1.0)
    order = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
    normal = np.moveaxis(sums[order], -1, 0) + 1e-6 * np.eye(4) * count[:, None, None]
    right = np.stack([sums[10:14].T, sums[14:18].T], axis=-1)
    explained = (right * np.linalg.solve(normal, right)).sum(axis=(1, 2))
    variance = sums[18] - (sums[10] ** 2 + sums[14] ** 2) / count
    return np.asarray(np.clip((sums[18] - explained) / np.maximum(variance, 1e-9), 1e-3, 1.0))
