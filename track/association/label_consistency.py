"""Tests of labels that go along with IDs: exchanged ones, gating by the predicted pose, then by the fit."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.kernels.segments import squared_distance
from track.association.frame_state import FrameState, targets_of
from track.association.hand_state import HandEstimate, HandState, HandTrack, Prediction

_GATE: Final = 16.0  # squared Mahalanobis distance of a point that is fitted: four standard deviations
_PREDICTION_SPREAD: Final = 0.004  # [m] least standard deviation of a predicted marker beside its own spread
_PREDICTION_FACTOR: Final = 2.0  # the same over what the other markers show in this frame
_MOST_GATED: Final = 0.3  # share of a hand's labels dropped at once; with more the prediction is wrong
EXCHANGE_DISTANCE: Final = 0.04
"""Distance of two points within which their IDs may be exchanged [m]."""
_EXCHANGE_MARGIN: Final = 8.0  # log-odds from which on two labels are exchanged; systems rarely exchange IDs
_EXCHANGE_SPREAD: Final = 0.002  # [m] least standard deviation of the offset of two predicted markers
_EXCHANGE_CONFIDENCE: Final = 0.5
_FIT_SPREAD: Final = 0.0015  # [m] standard deviation of a fitted marker beside its own spread
_RESTART_RMS: Final = 0.004  # [m] beyond which a fit is tried again from shapes instead of the prediction
_RESTART_STEPS: Final = 8  # from each starting pose; the fit goes on from there
_MEDIAN_SQUARE: Final = 2.366  # median of the squared length of a standard normal vector


def exchange_labels(frame: FrameState, positions: Float[np.ndarray, "K 3"]) -> FrameState:
    """Exchange the labels of two points where that explains both much better: the system exchanged their IDs.

    A motion that the prediction misses moves both points alike and cancels in the comparison. A hand without
    a prediction has no labels.
    """
    labels = frame.labels.copy()
    points = _exchange(frame.points, labels, positions)
    if len(points) == 0:
        return frame
    changed = np.zeros(len(labels), dtype=bool)
    changed[points] = True
    confidence = np.full(len(points), _EXCHANGE_CONFIDENCE)
    return frame._replace(labels=labels).with_confidence(changed, confidence)


@kernel
def _exchange(
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    positions: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Kernel of `exchange_labels`: overwrites the labels (P,), returns the points whose label has changed.

    What an exchange of i and j gains, (|p_i-m_i|^2 + |p_j-m_j|^2 - |p_i-m_j|^2 - |p_j-m_i|^2) / (2 s^2), is
    -(p_i-p_j).(m_i-m_j) / s^2. The pair that gains most comes first; a point is exchanged once.
    """
    labeled = np.flatnonzero(labels >= 0)
    changed = np.empty(len(labeled), dtype=np.int64)
    count = 0
    if len(labeled) < 2:
        return changed[:0]
    seen, markers = points[labeled], positions[labels[labeled]]
    offsets = seen - markers
    middle = np.array([np.median(offsets[:, 0]), np.median(offsets[:, 1]), np.median(offsets[:, 2])])
    squares = ((offsets - middle) ** 2).sum(axis=1)
    variance = max(_EXCHANGE_SPREAD**2, _PREDICTION_FACTOR**2 * np.median(squares) / _MEDIAN_SQUARE)
    free = np.ones(len(labeled), dtype=np.bool_)
    while True:
        most, one, other = _EXCHANGE_MARGIN, -1, -1
        for i in range(len(labeled)):
            for j in range(i):
                gain, square = 0.0, 0.0
                for k in range(3):
                    apart = seen[i, k] - seen[j, k]
                    gain -= apart * (markers[i, k] - markers[j, k]) / variance
                    square += apart * apart
                if gain > most and square <= EXCHANGE_DISTANCE**2 and free[i] and free[j]:
                    most, one, other = gain, i, j
        if one < 0:
            return changed[:count]
        free[one] = free[other] = False
        first, second = labeled[one], labeled[other]
        labels[first], labels[second] = labels[second], labels[first]
        changed[count], changed[count + 1] = first, second
        count += 2


def gate_labels(frame: FrameState, hand: int, state: HandState, prediction: Prediction) -> FrameState:
    """Drop labels whose points are outside the gate around their markers at the predicted pose.

    The gate is as wide as the innovations of the hand's other markers in this frame are large. Where too many
    labels are outside, the prediction is wrong, and all labels stay.
    """
    markers = frame.markers(hand)
    _gate(frame.points, markers, prediction.positions, state.variance)
    return frame.with_markers(hand, markers)


@kernel
def _gate(
    points: NDArray[np.float64],
    markers: NDArray[np.int64],
    positions: NDArray[np.float64],
    variance: NDArray[np.float64],
) -> None:
    """Kernel of `gate_labels` for one hand; its markers (P,) are overwritten."""
    labeled = np.flatnonzero(markers >= 0)
    if len(labeled) == 0:
        return
    squares = np.empty(len(labeled))
    for row, point in enumerate(labeled):
        squares[row] = ((points[point] - positions[markers[point]]) ** 2).sum()
    shown = max(_PREDICTION_SPREAD**2, _PREDICTION_FACTOR**2 * np.median(squares) / _MEDIAN_SQUARE)
    outside = squares > _GATE * (variance[markers[labeled]] + shown)
    if outside.sum() <= _MOST_GATED * len(labeled):
        markers[labeled[outside]] = -1


def fit_labels(
    frame: FrameState, hand: int, state: HandState, prediction: Prediction
) -> tuple[FrameState, HandEstimate]:
    """Fit the pose to the labeled points.

    Labels that are inconsistent with the others are dropped, the worst first.
    """
    points, markers = frame.points, frame.markers(hand)
    start, restarted, dropped = prediction.qpos, False, False
    while True:
        targets = targets_of(points, markers, state.num_markers)
        estimate = state.fit(targets, start, prediction)
        worst = _worst_label(points, markers, estimate.positions, state.variance)
        if worst < 0:
            break
        if estimate.rms > _RESTART_RMS and not restarted:
            restarted = True
            restart = state.solver.solve(targets[None], iterations=_RESTART_STEPS)
            if restart.rms[0] < 0.5 * estimate.rms:
                start = restart.qpos[0]
                continue
        markers[worst] = -1
        dropped = True
    return frame.with_markers(hand, markers) if dropped else frame, estimate


@kernel
def _worst_label(
    points: Float[np.ndarray, "P 3"],
    markers: Int[np.ndarray, "P"],
    positions: Float[np.ndarray, "M 3"],
    variance: Float[np.ndarray, "M"],
) -> int:
    """The labeled point that is farthest from its fitted marker, if it is outside the gate; else -1."""
    worst, most = -1, -1.0
    for point in range(len(markers)):
        marker = markers[point]
        if marker < 0:
            continue
        square = squared_distance(points[point], positions[marker])
        square /= variance[marker] + _FIT_SPREAD**2
        if square > most:
            worst, most = point, square
    return worst if most >= _GATE else -1


def refit_labels(before: FrameState, frame: FrameState, track: HandTrack) -> tuple[FrameState, HandTrack]:
    """Fit the pose of a hand again if its labels have changed.

    Args:
        before: The frame with the labels that `track` was fitted to.
        frame: The frame now.
    """
    if (before.markers(track.hand) == frame.markers(track.hand)).all():
        return frame, track
    frame, estimate = fit_labels(frame, track.hand, track.state, track.prediction)
    return frame, track._replace(estimate=estimate)
