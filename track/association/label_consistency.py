"""Tests of the labels that go along with IDs: gating by the predicted pose, then by the fitted one.

Labels are indices into the hand's layout; -1 is a point that is none of its markers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from track.association.hand_state import Estimate, HandState, Prediction
from track.config import GatingConfig

if TYPE_CHECKING:
    from jaxtyping import Float, Int


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

    Where that concerns too many labels, the prediction is wrong, and all labels stay.

    Args:
        state: The hand.
        points: The frame's points [m].
        labels: Their labels, overwritten.
        prediction: The hand's predicted pose.
        config: The gate.
    """
    labeled = np.flatnonzero(labels >= 0)
    positions = state.solver.marker_positions(prediction.qpos)
    innovation = ((points[labeled] - positions[labels[labeled]]) ** 2).sum(axis=1)
    variance = state.variance[labels[labeled]] + config.prediction_spread**2
    gated = labeled[innovation > config.gate * variance]
    if len(gated) <= config.most_gated * len(labeled):
        labels[gated] = -1


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
