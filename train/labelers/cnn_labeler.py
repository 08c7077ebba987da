"""The paper's network as a labeler, whatever runs the network; no torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from train.config import CNNConfig
from train.labelers.depth_image import depth_images
from train.labelers.matching import match_distances
from train.labelers.protocol import Labeling, check_output, label_in_batches, pad_clouds
from train.labelers.views import MIRROR_IMAGE, MeanHand, spread_views

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

_REJECT: Final = 0.04  # cost of a point without a label before one is chosen [m]
_SPREAD: Final = 0.005  # of the confidence before one is chosen [m]
_ACCEPTED: Final = 0.01  # mean distance of labeled points from which no further view is tried [m]
_GHOSTS: Final = 2  # most points without a label then
_TOGETHER: Final = (1, 2, 5)  # first views of a cloud that are tried at once
_TURNS: Final = 2  # of each first view toward the mean hand
_IMAGES: Final = 128  # that go through the network at once


class _Match(NamedTuple):
    """One way to label a cloud."""

    labels: Int[np.ndarray, "N"]
    distances: Float[np.ndarray, "N M"]
    """Of the points from the predicted markers [m]."""
    cost: float
    """Mean cost of a point [m], that of equation 1."""
    accepted: bool
    """Whether it fits so well that no further view is tried."""


_NONE: Final = _Match(np.zeros(0, dtype=np.int64), np.zeros((0, 0)), np.inf, False)


class CNNLabeler:
    """The paper's network with weights, then equation 1, whose least cost also decides between views.

    The network is trained on right hands; a mirrored view shows it a left hand as one.

    Args:
        positions: The trained network: from images (B, 1, 52, 52) to positions (B, M, 3) in view units.
        hand: The mean hand of its training set.
        config: How the network is used.
        marker_names: Markers in label order.
    """

    def __init__(
        self,
        positions: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        hand: MeanHand,
        config: CNNConfig,
        marker_names: tuple[str, ...],
    ) -> None:
        self.marker_names = marker_names
        self._positions = positions
        self._hand = hand
        self._aligned = config.views == "aligned"
        self._reject = config.reject or _REJECT
        self._spread = config.spread or _SPREAD

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self.label_batch)

    def label_batch(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        """Label the points [m] of frames that are small enough to go through the network together."""
        padded, present = pad_clouds(clouds)
        points = padded.astype(np.float64)
        views = self._first_views(points, present)
        best = [_NONE] * len(clouds)
        pending = np.arange(len(clouds))
        for tried in np.split(np.arange(views.shape[1]), np.cumsum(_TOGETHER)):
            rows = np.repeat(pending, len(tried))
            predicted = self.predict(points[rows], present[rows], views[pending][:, tried].reshape(-1, 3, 3))
            for row, markers in zip(rows, predicted, strict=True):
                best[row] = self._better(best[row], markers, points[row, present[row]])
            pending = pending[[not best[row].accepted for row in pending]]
            if not len(pending):
                break
        return [self._labeling(match) for match in best]

    def _first_views(
        self, points: NDArray[np.float64], present: NDArray[np.bool_]
    ) -> Float[np.ndarray, "B V 3 3"]:
        """The views to try, in this order."""
        if self._aligned:
            return self._hand.first_views(points, present)
        # The same clouds get the same labels every time.
        views = spread_views(points, present, rng=np.random.default_rng(0))
        return np.stack([views, MIRROR_IMAGE[:, None] * views], axis=1)

    def predict(
        self,
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
        views: Float[np.ndarray, "B 3 3"],
    ) -> NDArray[np.float64]:
        """Predicted markers (B, M, 3) [m] in the frame of the points, seen from these views at first."""
        predicted = self._predict_once(points, present, views)
        if self._aligned:
            sides = np.sign(np.linalg.det(views))
            for _ in range(_TURNS):
                views = self._hand.align(predicted, sides)
                predicted = self._predict_once(points, present, views)
        return predicted

    def _predict_once(
        self, points: NDArray[np.float64], present: NDArray[np.bool_], views: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        parts = [np.zeros((0, len(self.marker_names), 3))]
        for first in range(0, len(points), _IMAGES):
            part = slice(first, first + _IMAGES)
            images, frames = depth_images(points[part], present[part], views[part])
            normalized = self._positions(images[:, None]).astype(np.float64)
            check_output(normalized)
            parts.append(frames.restore(normalized))
        return np.concatenate(parts)

    def _better(self, best: _Match, markers: NDArray[np.float64], points: NDArray[np.float64]) -> _Match:
        """The cheaper of a match and the best one with these predicted markers (M, 3) [m]."""
        distances = np.linalg.norm(points[:, None] - markers, axis=-1)
        labels = match_distances(distances, self._reject)
        costs = np.where(labels >= 0, distances[np.arange(len(points)), labels], self._reject)
        labeled = labels >= 0
        near = len(points) == 0 or (labeled.any() and float(costs[labeled].mean()) <= _ACCEPTED)
        accepted = bool(near and (~labeled).sum() <= _GHOSTS)
        match = _Match(labels, distances, float(costs.mean()) if len(costs) else 0.0, accepted)
        return match if match.cost < best.cost else best

    def _labeling(self, match: _Match) -> Labeling:
        """Labels, and the weight of each as a share of the weights of all labels of its point."""
        rejects = np.full((len(match.distances), 1), self._reject)
        costs = np.concatenate([match.distances, rejects], axis=1)
        weights = np.exp(-(costs - costs.min(axis=1, keepdims=True)) / self._spread)
        taken = weights[np.arange(len(weights)), match.labels]  # GHOST, -1, is the last column
        return Labeling(match.labels, taken / weights.sum(axis=1))
