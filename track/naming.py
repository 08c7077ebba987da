"""The points of one hand whose pose is coming: names carried over are checked, new points are named.

Names are places in the hand's layout; -1 is a point of something else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.topology import DIGITS
from track.digit_search import search_digit
from track.hand_memory import Coming, Estimate, HandMemory
from track.hinge_belief import belief_of_digit
from track.matching import gains, match, worth_of
from track.starting_poses import write_rotation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

_SURPRISE: Final = 0.004  # [m] by which the coming pose may be wrong where an ID carries a name over
_MOST_SURPRISES: Final = 0.3  # share of a hand's names that may be wrong at once
_FIT: Final = 0.0015  # [m] by which a fitted one may be
_GATE: Final = 16.0  # squared standard deviations
_BAD: Final = 0.004  # [m] RMS from which a pose may have been sought in the wrong place
_FEWEST_TO_FIT: Final = 4
_REACH_WHOLE, _REACH_MISSING = 0.012, 0.05  # [m] around a marker seen or not: points that may be its
_MOST_RIVALS: Final = 5  # points without a name that are tried on a digit


def targets_of(
    points: Float[np.ndarray, "N 3"], names: Int[np.ndarray, "N"], count: int
) -> Float[np.ndarray, "M 3"]:
    """Named points in the layout's order [m], NaN where none is."""
    targets = np.full((count, 3), np.nan)
    targets[names[names >= 0]] = points[names >= 0]
    return targets


def forget_surprises(
    memory: HandMemory,
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "N"],
    coming: Coming,
) -> None:
    """Take away names whose points are nowhere near where their markers were coming to.

    Where that is so of many, it is the pose that was not coming, and the names stay.
    """
    mine = np.flatnonzero(names >= 0)
    places = memory.place(coming.qpos)
    off = ((points[mine] - places[names[mine]]) ** 2).sum(axis=1)
    wrong = mine[off > _GATE * (memory.variance[names[mine]] + _SURPRISE**2)]
    if len(wrong) <= _MOST_SURPRISES * len(mine):
        names[wrong] = -1


def fit_names(
    memory: HandMemory,
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "N"],
    coming: Coming,
) -> Estimate | None:
    """The pose of the named points; names that do not go with the others are taken away, the worst first.

    Returns:
        None with fewer than four names.
    """
    start, sought_anew = coming.qpos, False
    while True:
        mine = np.flatnonzero(names >= 0)
        if len(mine) < _FEWEST_TO_FIT:
            return None
        targets = targets_of(points, names, memory.num_markers)
        estimate = memory.fit(targets, start, coming)
        off = ((points[mine] - estimate.places[names[mine]]) ** 2).sum(axis=1)
        off /= memory.variance[names[mine]] + _FIT**2
        if off.max() < _GATE:
            return estimate
        if estimate.rms > _BAD and not sought_anew:
            sought_anew = True
            anew = memory.solver.solve(targets[None])
            if anew.rms[0] < 0.5 * estimate.rms:
                start = anew.qpos[0]
                continue
        names[mine[off.argmax()]] = -1


def name_new(
    memory: HandMemory,
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "N"],
    free: Bool[np.ndarray, "N"],
    credit: Float[np.ndarray, "N"],
    born: Float[np.ndarray, "N"],
    estimate: Estimate,
    coming: Coming,
) -> Float[np.ndarray, "N"]:
    """Name points that are free, the palm's first, then each digit's together with those it has.

    Args:
        memory: The hand.
        points: The frame's points [m].
        names: Names of this hand, overwritten.
        free: Points that nobody has named.
        credit: What the name of each point is worth for the sake of its ID.
        born: When each point appeared [s].
        estimate: The pose of the names so far.
        coming: The pose that was coming.

    Returns:
        How sure each name is that has changed; NaN for those that have not.
    """
    sure = np.full(len(points), np.nan)
    there = np.zeros(memory.num_markers, dtype=bool)
    there[names[names >= 0]] = True
    places, covariances = estimate.places, estimate.covariances
    open_points = np.flatnonzero(free)
    palm = np.flatnonzero(~there & (memory.digits < 0))
    if len(palm) and len(open_points):
        odds = gains(points[open_points], places[palm], covariances[palm])
        found, how_sure = match(odds + memory.chances(born[open_points])[:, palm])
        chosen = open_points[found >= 0]
        names[chosen], sure[chosen] = palm[found[found >= 0]], how_sure[found >= 0]
    apart = np.linalg.norm(points[open_points, None] - places, axis=-1)
    for digit in range(len(DIGITS)):
        markers = np.flatnonzero(memory.digits == digit)
        reach = np.where(there[markers], _REACH_WHOLE, _REACH_MISSING)
        near = (apart[:, markers] < reach).any(axis=1) & (names[open_points] < 0)
        if not near.any():
            continue
        rivals = open_points[near][np.argsort(apart[near][:, markers].min(axis=1))[:_MOST_RIVALS]]
        own = np.flatnonzero(np.isin(names, markers))
        chosen = np.concatenate([own, rivals])
        new, how_sure_all = _search(
            memory, digit, markers, points, names, chosen, credit, born, estimate, coming
        )
        changed = new != names[chosen]
        names[chosen] = new
        sure[chosen[changed]] = how_sure_all
    return sure


def _search(
    memory: HandMemory,
    digit: int,
    markers: NDArray[np.int64],
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    chosen: NDArray[np.int64],
    credit: NDArray[np.float64],
    born: NDArray[np.float64],
    estimate: Estimate,
    coming: Coming,
) -> tuple[NDArray[np.int64], float]:
    """The likeliest names of some points on a digit, and how sure they are together."""
    qpos, turn = estimate.qpos, np.empty((3, 3))
    write_rotation(qpos[3:7], turn)
    kept = memory.chances(born[chosen])[:, markers]
    for row, point in enumerate(chosen):
        if names[point] >= 0:
            kept[row, np.searchsorted(markers, names[point])] = credit[point]
    hinges = slice(7 + 4 * digit, 11 + 4 * digit)
    best, angles = np.full(len(markers), -1), qpos[hinges].copy()
    believed, trust = belief_of_digit(coming.hinges, estimate.expected, digit)
    _, margin = search_digit(
        memory.adapted,
        memory.ranges,
        digit,
        markers,
        np.ascontiguousarray((points[chosen] - qpos[:3]) @ turn),
        kept,
        memory.variance,
        worth_of(memory.variance),
        qpos[7:].copy(),
        believed,
        trust,
        best,
        angles,
    )
    new = np.full(len(chosen), -1)
    new[best[best >= 0]] = markers[best >= 0]
    return new, float(1.0 / (1.0 + np.exp(-min(margin, 30.0))))
