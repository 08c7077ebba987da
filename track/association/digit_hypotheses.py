"""Which points are a digit's markers: every way to name a few points is tried on the digit itself, compiled.

The palm being known, a digit is four hinges, and three markers on it leave five of nine coordinates to check.
So a handful of points near a digit can be named by trying: each naming is fitted, and what counts is how well
its points lie on the digit, how far its hinges are from where they were coming to, and for how long an ID has
carried a name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from handsim.hand.topology import DIGITS
from track.kinematics.joint_prior import HingeBelief, believe_digit
from track.kinematics.marker_kinematics import (
    FAST,
    HandArrays,
    find_slopes,
    place_digit,
    place_marker,
    place_markers,
    workspace,
)
from track.kinematics.marker_prediction import Expectation
from track.kinematics.small_systems import eliminate, solve_positive
from track.kinematics.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_STEPS: Final = 10
_SMALL_GAIN: Final = 0.01  # of a misfit
_APART: Final = np.deg2rad(5.0)  # between two starts, or one will do
_LIMIT_WEIGHT: Final = np.deg2rad(2.0) ** -2
_FREEDOM: Final = 20.0  # squared deviations of a prior from which on it loses its say
_SLACK: Final = 0.003  # [m] that two markers may be nearer or farther than on any pose of the hand
_CLEAR: Final = 7.0  # log odds behind another naming from which on a naming is not looked at
NEVER: Final = 1e9
"""Score below zero of what cannot be."""


class DigitRanges(NamedTuple):
    """How near and how far two markers of one digit can be from each other."""

    nearest: Float[np.ndarray, "M M"]
    farthest: Float[np.ndarray, "M M"]


def digit_ranges(hand: HandArrays) -> DigitRanges:
    """The distances of a hand's markers over a grid of its hinges."""
    work = workspace(len(hand.digits))
    shares = np.linspace(0.0, 1.0, 5)
    grid = np.stack(np.meshgrid(*[shares] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    count = len(hand.digits)
    nearest, farthest = np.full((count, count), np.inf), np.zeros((count, count))
    for angles in grid:
        low, high = hand.ranges[:, 0], hand.ranges[:, 1]
        posed = low + np.tile(angles, len(DIGITS)) * (high - low)
        place_markers(hand, posed, work)
        apart = np.linalg.norm(work.markers[:, None] - work.markers[None], axis=-1)
        nearest, farthest = np.minimum(nearest, apart), np.maximum(farthest, apart)
    return DigitRanges(nearest, farthest)


class DigitNamings(NamedTuple):
    """For each digit the best naming of every set of points, a row a set: bit n is its n-th candidate."""

    scores: Float[np.ndarray, "D S"]
    """Log odds against all points being strays; far below zero where there is none."""
    runners_up: Float[np.ndarray, "D S"]
    """The same of the next best naming of the same points."""
    names: Int[np.ndarray, "D S K"]
    """Candidate of each of the digit's markers, -1 for none."""


def digit_namings(num_digits: int, num_candidates: int, num_markers: int) -> DigitNamings:
    """Room for the namings of some digits."""
    sets = num_digits, 1 << num_candidates
    return DigitNamings(np.full(sets, -NEVER), np.full(sets, -NEVER), np.full((*sets, num_markers), -1))


class DigitTrust(NamedTuple):
    """What a digit's points are measured by."""

    belief: HingeBelief
    """What was believed of the hand's hinges before its markers were asked."""
    seen: Expectation
    """What they said."""
    variance: Float[np.ndarray, "M"]
    """Of each marker around its place [m^2]."""
    worth: Float[np.ndarray, "M"]
    """What naming a point is worth that lies where its marker is expected."""
    slack: Float[np.ndarray, "M"]
    """How far each marker may be off its place on the hand of the ranges [m]."""
    ranges: DigitRanges


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def search_digit(
    hand: Any,
    trusted: Any,
    digit: Any,
    markers: Any,
    points: Any,
    candidates: Any,
    odds: Any,
    scores: Any,
    runners_up: Any,
    names: Any,
) -> None:
    """Try all namings of points as markers of one digit.

    Args:
        hand: The hand, its markers where their habits have them.
        trusted: See `DigitTrust`.
        digit: Which digit.
        markers: Its markers (K,).
        points: The frame's points (N, 3) [m].
        candidates: Those that the digit may take (C,).
        odds: What each name is worth to each point (N, M) beyond the fit, for the IDs' sake.
        scores: The digit's row of `DigitNamings`, filled, as are the next two.
        runners_up: See there.
        names: See there.
    """
    posed, wrist = trusted.seen.qpos, np.empty((3, 3))
    write_rotation(posed[3:7], wrist)
    near, credit = np.zeros((len(candidates), 3)), np.empty((len(candidates), len(markers)))
    for number, point in enumerate(candidates):
        for i in range(3):
            for j in range(3):
                near[number, i] += (points[point, j] - posed[j]) * wrist[j, i]
        for place, marker in enumerate(markers):
            credit[number, place] = odds[point, marker]
    coming, trust = np.empty(4), np.empty((4, 4))
    believe_digit(trusted.belief, trusted.seen.told, trusted.seen.pull, digit, coming, trust)
    _try_all(hand, trusted, digit, markers, near, credit, posed[7:], coming, trust, scores, runners_up, names)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _try_all(
    hand: Any,
    trusted: Any,
    digit: Any,
    markers: Any,
    points: Any,
    credit: Any,
    posed: Any,
    coming: Any,
    trust: Any,
    scores: Any,
    runners_up: Any,
    names: Any,
) -> None:
    """Fit all namings that may be the best of their points, those with fewer names before those with more."""
    count, choices = len(markers), len(points) + 1
    work = workspace(len(hand.digits))
    place_markers(hand, posed, work)
    naming, angles = np.full(count, -1), np.empty(4)
    own = posed[4 * digit : 4 * digit + 4]
    starts = 2 if np.abs(coming - own).max() > _APART else 1
    total = choices**count
    misfits, poses = np.zeros(total), np.empty((total, 4))
    below = np.full(len(scores), -NEVER)
    poses[0] = coming
    for number in range(total):
        chosen = _read_naming(number, choices, naming)
        smaller = _worst_part(number, choices, naming, misfits)
        misfits[number], poses[number] = misfits[smaller], poses[smaller]
        if number > 0 and misfits[smaller] >= NEVER:
            continue
        most = _most(trusted, markers, points, credit, naming)
        if most <= -NEVER:
            misfits[number] = NEVER
            continue
        beaten = _best_below(chosen, scores, below)
        hopeless = most - max(runners_up[chosen], max(scores[chosen], beaten) - _CLEAR)
        if misfits[smaller] >= hopeless:
            continue
        score = -NEVER
        for start in range(starts):
            angles[:] = poses[smaller] if start == 0 else own
            misfit, gap = _fit(
                hand, digit, markers, points, trusted.variance, naming, coming, trust, hopeless, angles, work
            )
            if most - misfit - gap > score:
                score = most - misfit - gap
                misfits[number], poses[number] = misfit, angles
        if score > scores[chosen]:
            runners_up[chosen], scores[chosen] = scores[chosen], score
            names[chosen, :count] = naming
        elif score > runners_up[chosen]:
            runners_up[chosen] = score


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _read_naming(number: Any, choices: Any, naming: Any) -> Any:
    """The naming with a number, and the set of points that it uses."""
    chosen = 0
    for place in range(len(naming)):
        naming[place] = number % choices - 1
        number //= choices
        if naming[place] >= 0:
            chosen |= 1 << naming[place]
    return chosen


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _worst_part(number: Any, choices: Any, naming: Any, misfits: Any) -> Any:
    """Of the namings with one name less that which misses most: with one more it cannot miss less."""
    worst, radix = 0, 1
    for place in range(len(naming)):
        part = number - (naming[place] + 1) * radix
        radix *= choices
        if naming[place] >= 0 and misfits[part] >= misfits[worst]:
            worst = part
    return worst


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _best_below(chosen: Any, scores: Any, below: Any) -> Any:
    """Best score so far of any part of a set of points."""
    bit = 1
    while bit <= chosen:
        if chosen & bit:
            part = chosen ^ bit
            below[chosen] = max(below[chosen], scores[part], below[part])
        bit <<= 1
    return below[chosen]


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _most(trusted: Any, markers: Any, points: Any, credit: Any, naming: Any) -> Any:
    """What a naming is worth if every point lies where it should; far below zero if they cannot."""
    ranges, slack, total = trusted.ranges, trusted.slack, 0.0
    for place in range(len(markers)):
        point = naming[place]
        if point < 0:
            continue
        total += trusted.worth[markers[place]] + credit[point, place]
        for other in range(place):
            if naming[other] < 0:
                continue
            if naming[other] == point:
                return -NEVER
            apart = 0.0
            for i in range(3):
                apart += (points[point, i] - points[naming[other], i]) ** 2
            apart = np.sqrt(apart)
            one, two = markers[place], markers[other]
            loose = _SLACK + slack[one] + slack[two]
            if apart < ranges.nearest[one, two] - loose or apart > ranges.farthest[one, two] + loose:
                return -NEVER
    return total


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _fit(
    hand: Any,
    digit: Any,
    markers: Any,
    points: Any,
    variance: Any,
    naming: Any,
    coming: Any,
    trust: Any,
    hopeless: Any,
    angles: Any,
    work: Any,
) -> Any:
    """Bring four hinges to a minimum; returns the misfit of named points and hinges, and what it leaves open.

    That is half the logarithm of how much surer the hinges are than before (Laplace): a naming that any pose
    would fit says little. A misfit that is `hopeless` and would stay so is left where it is.
    """
    trial, factor, step = angles.copy(), np.empty((4, 4)), np.empty(4)
    normal, gradient = np.empty((4, 4)), np.empty(4)
    new_normal, new_gradient = np.empty((4, 4)), np.empty(4)
    cost = _gather(
        hand, digit, markers, points, variance, naming, coming, trust, angles, work, normal, gradient
    )
    damping = 1e-3
    for _ in range(_STEPS):
        for row in range(4):
            step[row] = -gradient[row]
            for column in range(4):
                factor[row, column] = normal[row, column]
            factor[row, row] *= 1.0 + damping
        solve_positive(factor, step)
        gain = 0.0
        for row in range(4):
            gain -= gradient[row] * step[row]
            trial[row] = angles[row] + step[row]
        if gain < _SMALL_GAIN:
            break
        if cost - 2.0 * gain > hopeless:
            cost -= 2.0 * gain
            break
        tried = _gather(
            hand,
            digit,
            markers,
            points,
            variance,
            naming,
            coming,
            trust,
            trial,
            work,
            new_normal,
            new_gradient,
        )
        if tried < cost:
            small = cost - tried < _SMALL_GAIN
            cost = tried
            angles[:] = trial
            normal[:] = new_normal
            gradient[:] = new_gradient
            damping = max(damping * 0.1, 1e-9)
            if small:
                break
        else:
            damping *= 30.0
            if damping > 1e5:
                break
    return cost, 0.5 * (_log_determinant(normal) - _log_determinant(trust))


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _gather(
    hand: Any,
    digit: Any,
    markers: Any,
    points: Any,
    variance: Any,
    naming: Any,
    coming: Any,
    trust: Any,
    angles: Any,
    work: Any,
    normal: Any,
    gradient: Any,
) -> Any:
    """Cost at some angles, with its normal matrix and half its gradient."""
    normal[:] = 0.0
    gradient[:] = 0.0
    cost, first = 0.0, 4 * digit
    place_digit(hand, digit, angles, work)
    for place in range(len(markers)):
        if naming[place] < 0:
            continue
        marker, point = markers[place], points[naming[place]]
        place_marker(hand, marker, work)
        find_slopes(hand, marker, work)
        weight, slopes, placed = 1.0 / variance[marker], work.slopes[marker], work.markers[marker]
        x, y, z = placed[0] - point[0], placed[1] - point[1], placed[2] - point[2]
        cost += 0.5 * weight * (x * x + y * y + z * z)
        for row in range(4):
            a, b, c = slopes[0, first + row], slopes[1, first + row], slopes[2, first + row]
            a, b, c = weight * a, weight * b, weight * c
            gradient[row] += a * x + b * y + c * z
            for column in range(row + 1):
                other = first + column
                normal[row, column] += a * slopes[0, other] + b * slopes[1, other] + c * slopes[2, other]
    for row in range(4):
        for column in range(row):
            normal[column, row] = normal[row, column]
    away = 0.0
    for row in range(4):
        for column in range(4):
            away += (angles[row] - coming[row]) * trust[row, column] * (angles[column] - coming[column])
    say = 1.0 / (1.0 + away / _FREEDOM)
    cost += 0.5 * _FREEDOM * np.log(1.0 + away / _FREEDOM)
    for row in range(4):
        for column in range(4):
            gradient[row] += say * trust[row, column] * (angles[column] - coming[column])
            normal[row, column] += say * trust[row, column]
        low, high = hand.ranges[first + row, 0], hand.ranges[first + row, 1]
        beyond = max(angles[row] - high, 0.0) + min(angles[row] - low, 0.0)
        if beyond != 0.0:
            cost += 0.5 * _LIMIT_WEIGHT * beyond * beyond
            gradient[row] += _LIMIT_WEIGHT * beyond
            normal[row, row] += _LIMIT_WEIGHT
    return cost


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _log_determinant(matrix: Any) -> Any:
    """Of a small positive matrix, by elimination."""
    factor, total = matrix.copy(), 0.0
    eliminate(factor, np.zeros(4), 0, 4)
    for row in range(4):
        total += np.log(factor[row, row])
    return total
