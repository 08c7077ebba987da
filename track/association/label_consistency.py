"""Tests of the labels that go along with IDs: exchanged ones, gating by the predicted pose, then by the fit.

Labels are indices into the hand's layout; -1 is a point that is none of its markers.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from track.association.hand_state import Estimate, HandState, Prediction
from track.config import GatingConfig

_MEDIAN_SQUARE: Final = 2.366  # median of the squared length of a standard normal vector


def targets_of(
    points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], count: int
) -> Float[np.ndarray, "M 3"]:
    """Labeled points in the layout's order [m], NaN where a marker has no point.

    Args:
        points: Points [m].
        labels: Their labels.
        count: Markers of the layout.
    """
    targets = np.full((count, 3), np.nan)
    targets[labels[labels >= 0]] = points[labels >= 0]
    return targets


def gate_labels(
    state: HandState,
    points: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    prediction: Prediction,
    config: GatingConfig,
) -> None:
    """Drop labels whose points are outside the gate around their markers at the predicted pose.

    The gate is as wide as the innovations of the hand's other markers in this frame are large. Where too many
    labels are outside, the prediction is wrong, and all labels stay.

    Args:
        state: The hand.
        points: The frame's points [m].
        labels: Their labels, overwritten.
        prediction: The hand's predicted pose.
        config: The gate.
    """
    _gate(
        points,
        labels,
        prediction.positions,
        state.variance,
        config.prediction_spread,
        config.prediction_factor,
        config.gate,
        config.most_gated,
    )


@kernel
def _gate(
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    positions: NDArray[np.float64],
    variance: NDArray[np.float64],
    spread: float,
    factor: float,
    gate: float,
    most_gated: float,
) -> None:
    """Kernel of `gate_labels`.

    Args:
        points: The frame's points (P, 3) [m].
        labels: Their labels (P,), overwritten.
        positions: Predicted markers (M, 3) [m].
        variance: Their variance (M,) [m^2].
        spread: Least standard deviation beside it [m].
        factor: The same as a multiple of what the hand's markers show.
        gate: Squared Mahalanobis distance of the gate.
        most_gated: Largest share of the labels to drop.
    """
    labeled = np.flatnonzero(labels >= 0)
    if len(labeled) == 0:
        return
    squares = np.empty(len(labeled))
    for row, point in enumerate(labeled):
        squares[row] = ((points[point] - positions[labels[point]]) ** 2).sum()
    shown = max(spread**2, factor**2 * np.median(squares) / _MEDIAN_SQUARE)
    outside = squares > gate * (variance[labels[labeled]] + shown)
    if outside.sum() <= most_gated * len(labeled):
        labels[labeled[outside]] = -1


def exchange_labels(
    points: Float[np.ndarray, "N 3"],
    assigned: Int[np.ndarray, "N"],
    positions: Float[np.ndarray, "K 3"],
    config: GatingConfig,
) -> Int[np.ndarray, "E"]:
    """Exchange the labels of two points where that explains both much better.

    A motion that the prediction misses moves both points alike and cancels in the comparison.

    Args:
        points: The frame's points [m].
        assigned: Marker of each point, -1 for none; overwritten.
        positions: Predicted positions of the markers [m].
        config: The margin.

    Returns:
        The points whose label has changed.
    """
    return _exchange(
        points,
        assigned,
        positions,
        config.exchange_spread,
        config.prediction_factor,
        config.exchange_distance,
        config.exchange_margin,
    )


@kernel
def _exchange(
    points: NDArray[np.float64],
    assigned: NDArray[np.int64],
    positions: NDArray[np.float64],
    spread: float,
    factor: float,
    distance: float,
    margin: float,
) -> NDArray[np.int64]:
    """Kernel of `exchange_labels`.

    What an exchange of i and j gains, (|p_i-m_i|^2 + |p_j-m_j|^2 - |p_i-m_j|^2 - |p_j-m_i|^2) / (2 s^2), is
    -(p_i-p_j).(m_i-m_j) / s^2. The pair that gains most comes first; a point is exchanged once.

    Args:
        points: The frame's points (P, 3) [m].
        assigned: Marker of each point (P,), -1 for none; overwritten.
        positions: Predicted markers (K, 3) [m].
        spread: Least standard deviation of the offset of two markers [m].
        factor: The same as a multiple of what the markers show.
        distance: Largest distance of two points that are exchanged [m].
        margin: Least gain (log-odds).

    Returns:
        The points whose label has changed (E,).
    """
    labeled = np.flatnonzero(assigned >= 0)
    changed = np.empty(len(labeled), dtype=np.int64)
    count = 0
    if len(labeled) < 2:
        return changed[:0]
    seen, markers = points[labeled], positions[assigned[labeled]]
    offsets = seen - markers
    middle = np.array([np.median(offsets[:, 0]), np.median(offsets[:, 1]), np.median(offsets[:, 2])])
    squares = ((offsets - middle) ** 2).sum(axis=1)
    variance = max(spread**2, factor**2 * np.median(squares) / _MEDIAN_SQUARE)
    free = np.ones(len(labeled), dtype=np.bool_)
    while True:
        most, one, other = margin, -1, -1
        for i in range(len(labeled)):
            for j in range(i):
                gain, square = 0.0, 0.0
                for k in range(3):
                    apart = seen[i, k] - seen[j, k]
                    gain -= apart * (markers[i, k] - markers[j, k]) / variance
                    square += apart * apart
                if gain > most and square <= distance**2 and free[i] and free[j]:
                    most, one, other = gain, i, j
        if one < 0:
            return changed[:count]
        free[one] = free[other] = False
        first, second = labeled[one], labeled[other]
        assigned[first], assigned[second] = assigned[second], assigned[first]
        changed[count], changed[count + 1] = first, second
        count += 2


def fit_labels(
    state: HandState,
    points: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    prediction: Prediction,
    config: GatingConfig,
) -> Estimate:
    """Fit the pose to the labeled points.

    Labels that are inconsistent with the others are dropped, the worst first.

    Args:
        state: The hand.
        points: The frame's points [m].
        labels: Their labels, overwritten.
        prediction: The hand's predicted pose.
        config: The gate.
    """
    start, restarted = prediction.qpos, False
    while True:
        labeled = np.flatnonzero(labels >= 0)
        targets = targets_of(points, labels, state.num_markers)
        estimate = state.fit(targets, start, prediction)
        if len(labeled) == 0:
            return estimate
        squares = ((points[labeled] - estimate.positions[labels[labeled]]) ** 2).sum(axis=1)
        squares /= state.variance[labels[labeled]] + config.fit_spread**2
        if squares.max() < config.gate:
            return estimate
        if estimate.rms > config.restart_rms and not restarted:
            restarted = True
            restart = state.solver.solve(targets[None])
            if restart.rms[0] < 0.5 * estimate.rms:
                start = restart.qpos[0]
                continue
        labels[labeled[squares.argmax()]] = -1
