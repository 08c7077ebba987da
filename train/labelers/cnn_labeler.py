"""The paper's network as a labeler, whatever runs the network; no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from train.config import CNNConfig
from train.labelers.depth_image import depth_images
from train.labelers.protocol import Labeling, check_output, label_in_batches, pad_clouds
from train.labelers.views import MIRROR_IMAGE, MeanHand, spread_views
from train.matching.assignment import match_distances

_SEARCH_REJECT: Final = 0.04  # cost of a point without a label while views are compared [m]
_REJECT: Final = _SEARCH_REJECT  # in the labels, before one is chosen [m]
_SPREAD: Final = 0.005  # of the confidence before one is chosen [m]
_ACCEPTED: Final = 0.01  # mean distance of labeled points from which no further view is tried [m]
_GHOSTS: Final = 2  # most points without a label then
_TOGETHER: Final = (1, 2)  # first views of a cloud that are tried at once, then all others
_TURNS: Final = 2  # of each first view toward the mean hand
_IMAGES: Final = 128  # that go through the network at once


class _View(NamedTuple):
    """How well the markers predicted from one view fit a cloud."""

    distances: Float[np.ndarray, "N M"]
    """Of the points from the predicted markers [m]."""
    cost: float
    """Mean cost of a point [m], that of equation 1."""
    accepted: bool
    """Whether it fits so well that no further view is tried."""


_NONE: Final = _View(np.zeros((0, 0)), np.inf, False)


class CNNLabeler:
    """The paper's network with weights, then equation 1, whose least cost also decides between views.

    The network is trained on right hands; a mirrored view shows it a left hand as one.

    Args:
        positions: The trained network: from images (B, 1, 52, 52) to positions (B, M, 3) in view units.
        hand: The mean hand of its training set.
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
        return [
            label_by_distance(distances, self._reject, self._spread) for distances in self.distances(clouds)
        ]

    def distances(self, clouds: list[NDArray[np.float64]]) -> list[Float[np.ndarray, "N M"]]:
        """Distances of the points of each cloud from its predicted markers in the best view [m]."""
        padded, present = pad_clouds(clouds)
        points = padded.astype(np.float64)
        views = self._first_views(points, present)
        best = [_NONE] * len(clouds)
        pending = np.arange(len(clouds))
        for tried in np.split(np.arange(views.shape[1]), np.cumsum(_TOGETHER)):
            rows = np.repeat(pending, len(tried))
            predicted = self.predict(points[rows], present[rows], views[pending][:, tried].reshape(-1, 3, 3))
            for row, markers in zip(rows, predicted, strict=True):
                view = _compare(points[row, present[row]], markers)
                best[row] = min(best[row], view, key=lambda each: each.cost)
            pending = pending[[not best[row].accepted for row in pending]]
            if not len(pending):
                break
        return [view.distances for view in best]

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


def _compare(points: NDArray[np.float64], markers: NDArray[np.float64]) -> _View:
    """How well predicted markers (M, 3) [m] fit points (N, 3) [m]."""
    distances = np.linalg.norm(points[:, None] - markers, axis=-1)
    labels = match_distances(distances, _SEARCH_REJECT)
    labeled = labels >= 0
    costs = np.where(labeled, distances[np.arange(len(points)), labels], _SEARCH_REJECT)
    near = len(points) == 0 or (labeled.any() and float(costs[labeled].mean()) <= _ACCEPTED)
    accepted = bool(near and (~labeled).sum() <= _GHOSTS)
    return _View(distances, float(costs.mean()) if len(costs) else 0.0, accepted)


def label_by_distance(distances: Float[np.ndarray, "N M"], reject: float, spread: float) -> Labeling:
    """Labels of equation 1, and the weight of each as a share of the weights of all labels of its point.

    Args:
        distances: Of points from predicted markers [m].
        reject: Cost of a point without a label [m].
        spread: Difference of costs at which a weight falls to 1/e [m].
    """
    labels = match_distances(distances, reject)
    rejects = np.full((len(distances), 1), reject)
    costs = np.concatenate([distances, rejects], axis=1)
    weights = np.exp(-(costs - costs.min(axis=1, keepdims=True)) / spread)
    taken = weights[np.arange(len(weights)), labels]  # GHOST, -1, is the last column
    return Labeling(labels, taken / weights.sum(axis=1))
