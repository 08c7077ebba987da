"""Tests of the labels that go along with IDs: exchanged ones, gating by the predicted pose, then by the fit.

Labels are indices into the hand's layout; -1 is a point that is none of its markers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from track.association.hand_state import Estimate, HandState, Prediction
from track.config import GatingConfig

if TYPE_CHECKING:
    from jaxtyping import Float, Int


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
    labeled = np.flatnonzero(labels >= 0)
    if len(labeled) == 0:
        return
    squares = ((points[labeled] - prediction.positions[labels[labeled]]) ** 2).sum(axis=1)
    shown = config.prediction_factor**2 * np.median(squares) / _MEDIAN_SQUARE
    variance = state.variance[labels[labeled]] + max(config.prediction_spread**2, shown)
    gated = labeled[squares > config.gate * variance]
    if len(gated) <= config.most_gated * len(labeled):
        labels[gated] = -1


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
    changed: list[int] = []
    labeled = np.flatnonzero(assigned >= 0)
    if len(labeled) < 2:
        return np.array(changed, dtype=np.int64)
    seen, markers = points[labeled], positions[assigned[labeled]]
    offsets = seen - markers
    offsets -= np.median(offsets, axis=0)
    shown = config.prediction_factor**2 * np.median((offsets**2).sum(axis=1)) / _MEDIAN_SQUARE
    variance = max(config.exchange_spread**2, shown)
    # What an exchange of i and j gains: (|p_i-m_i|^2 + |p_j-m_j|^2 - |p_i-m_j|^2 - |p_j-m_i|^2) / (2 s^2).
    cross = seen @ markers.T
    own = np.diag(cross)
    gains = (cross + cross.T - own[:, None] - own) / variance
    apart = ((seen[:, None] - seen) ** 2).sum(axis=-1) > config.exchange_distance**2
    gains[apart] = 0.0
    while gains.max() > config.exchange_margin:
        one, other = np.unravel_index(gains.argmax(), gains.shape)
        pair = labeled[[one, other]]
        assigned[pair] = assigned[pair[::-1]]
        changed += pair.tolist()
        gains[[one, other]], gains[:, [one, other]] = 0.0, 0.0
    return np.array(changed, dtype=np.int64)


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
