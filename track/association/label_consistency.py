"""The points of one hand whose pose is coming: names carried over are checked against it.

Names are places in the hand's layout; -1 is a point of something else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from track.association.hand_state import Coming, Estimate, HandMemory

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_SURPRISE: Final = 0.004  # [m] by which the coming pose may be wrong where an ID carries a name over
_MOST_SURPRISES: Final = 0.3  # share of a hand's names that may be wrong at once
_FIT: Final = 0.0015  # [m] by which a fitted one may be
_GATE: Final = 16.0  # squared standard deviations
_BAD: Final = 0.004  # [m] RMS from which a pose may have been sought in the wrong place


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
    places = memory.solver.place(coming.qpos)
    off = ((points[mine] - places[names[mine]]) ** 2).sum(axis=1)
    wrong = mine[off > _GATE * (memory.variance[names[mine]] + _SURPRISE**2)]
    if len(wrong) <= _MOST_SURPRISES * len(mine):
        names[wrong] = -1


def fit_names(
    memory: HandMemory,
    points: Float[np.ndarray, "N 3"],
    names: Int[np.ndarray, "N"],
    coming: Coming,
) -> Estimate:
    """The pose of the named points; names that do not go with the others are taken away, the worst first."""
    start, sought_anew = coming.qpos, False
    while True:
        mine = np.flatnonzero(names >= 0)
        targets = targets_of(points, names, memory.num_markers)
        estimate = memory.fit(targets, start, coming)
        if len(mine) == 0:
            return estimate
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
