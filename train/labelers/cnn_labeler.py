"""The paper's network as a labeler without torch: views and images of clouds, and their labels.

A view is an orthogonal matrix from the cloud's frame into the camera's; with determinant -1 it shows a left
hand as a right one. Views are random as in the paper, or aligned with the mean hand
(docs/own_labelers.md), so that the network need not learn all orientations.

Images are 52x52 depth images (Han et al. 2018, section 3.1): an orthographic camera looks along an axis
through the cloud's mean, zoomed so that every point stays clear of a 10 % margin; each point is one pixel
with its depth as brightness. A view frame has x to the right, y down and z away from the camera, all in one
unit: half an image width. Images stretch depth to a fixed range; network outputs do not, so that distances in
them are to scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy.typing import NDArray

from handsim.space.transforms import quaternion_matrix, random_quaternions, rigid_fit
from train.labelers.matching import match_distances
from train.labelers.protocol import Labeling, check_output, label_in_batches, pad_clouds
from train.settings import CNNConfig

SIGNS: Final = np.array(list(product((1.0, -1.0), repeat=3)))
"""Signs (8, 3) of the principal axes: four rotations for each side of the body."""
MIRROR_IMAGE: Final = np.array([-1.0, 1.0, 1.0])
"""Signs of the camera's axes in a mirrored view."""
_NUM_VIEWS: Final = 10  # views of which the best is chosen (Han et al., section 3.1)
_MOMENTS: Final = tuple(
    powers for order in (3, 5) for powers in combinations_with_replacement(range(3), order)
)
NUM_MOMENTS: Final = len(_MOMENTS)
_ALIGNED_SHARE: Final = 0.6  # share of aligned views in training; others are along principal axes
_TURN_SPREAD: Final = np.radians(12.0)  # [rad] standard deviation of an aligned view's angle
_REGULARIZATION: Final = 1e-4  # added to the variances of moments, which have no unit

IMAGE_SIZE = 52
"""Width and height of a depth image [pixel]."""
MARGIN = 0.1
"""Empty border on each side, as share of the image."""
NEAREST, FARTHEST = 0.1, 1.0
"""Brightness of the nearest and farthest point; 0 is background."""
SMALLEST_EXTENT = 0.01
"""Least extent from the mean assumed by the zoom [m]; a single point has no extent."""
FLAT = 1e-6
"""Smaller depth ranges are rounding errors [m]; their points get the middle brightness."""

_SEARCH_REJECT: Final = 0.04  # [m] default cost of a point without a label
_SPREAD: Final = 0.005  # [m] default scale of the confidence
_ACCEPTED_DISTANCE: Final = 0.01  # [m] A view with a smaller mean distance of labeled points is accepted.
_ACCEPTED_GHOSTS: Final = 2  # largest number of unlabeled points in an accepted view
_FIRST_GROUPS: Final = (1, 2)  # numbers of first views tried together, before all others
_ALIGNMENTS: Final = 2  # number of times that each first view is aligned by the predictions
_MOST_IMAGES: Final = 128  # largest number of images in one call of the network


@dataclass(frozen=True, slots=True, eq=False)
class MeanHand:
    """The mean right hand of a layout, and the distribution of its clouds' moments."""

    markers: Float[np.ndarray, "M 3"]
    """Mean positions of the aligned markers [m], with principal axes along x, y and z."""
    moments: Float[np.ndarray, "K"]
    """Mean third and fifth moments of clouds along principal axes with the right signs."""
    precision: Float[np.ndarray, "K K"]
    """Inverse of their covariance."""

    @classmethod
    def of_clouds(
        cls,
        markers: Float[np.ndarray, "B M 3"],
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
    ) -> MeanHand:
        """Mean hand of a training set, from markers of right hands [m] and their clouds."""
        mean = markers[0]
        for _ in range(10):
            rotations, _ = rigid_fit(markers, mean)
            turned = (markers - markers.mean(1, keepdims=True)) @ rotations.swapaxes(1, 2)
            mean = turned.mean(axis=0)
        upright = principal_axes(mean[None], np.ones((1, len(mean)), dtype=bool))[0]
        mean = mean @ (upright * np.linalg.det(upright)).T
        rotations, _ = rigid_fit(markers, mean)
        seen = _moments(points, present, _nearest_axes(points, present, rotations)[:, None])[:, 0]
        covariance = np.cov(seen.T) + _REGULARIZATION * np.eye(NUM_MOMENTS)
        return cls(mean, seen.mean(axis=0), np.linalg.inv(covariance))

    def align(self, markers: Float[np.ndarray, "B M 3"], side: Float[np.ndarray, "B"]) -> NDArray[np.float64]:
        """Views (B, 3, 3) that align markers [m] with the mean hand; mirrored where `side` is -1."""
        mirrors = np.ones((len(markers), 1, 3))
        mirrors[:, 0, 0] = side
        rotations, _ = rigid_fit(markers * mirrors, self.markers)
        return rotations * mirrors

    def first_views(
        self, points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
    ) -> NDArray[np.float64]:
        """Views (B, 8, 3, 3) along the principal axes of clouds [m], the likeliest signs first.

        Odd moments change their sign with the axes; for the right signs they have a normal distribution.
        """
        views = SIGNS[:, :, None] * principal_axes(points, present)[:, None]
        offsets = _moments(points, present, views) - self.moments
        unlikely = np.einsum("bvi,ij,bvj->bv", offsets, self.precision, offsets)
        order = unlikely.argsort(axis=1, kind="stable")
        return np.take_along_axis(views, order[..., None, None], axis=1)

    def training_views(
        self,
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
        markers: Float[np.ndarray, "B M 3"],
        *,
        rng: np.random.Generator,
    ) -> NDArray[np.float64]:
        """Random views (B, 3, 3) of right hands [m], along principal axes or nearly aligned."""
        from scipy.spatial.transform import Rotation  # not needed for labeling

        aligned = self.align(markers, np.ones(len(markers)))
        axes = _nearest_axes(points, present, aligned)
        direction = rng.standard_normal((len(points), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        turns = Rotation.from_rotvec(direction * (_TURN_SPREAD * rng.standard_normal((len(points), 1))))
        chosen = rng.random(len(points)) < _ALIGNED_SHARE
        return np.where(chosen[:, None, None], turns.as_matrix() @ aligned, axes)


def principal_axes(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
) -> NDArray[np.float64]:
    """Orthogonal matrices (B, 3, 3) with the principal axes of clouds as rows, the longest first."""
    offsets, _ = centered(points, present)
    _, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets)
    return axes[:, :, ::-1].swapaxes(1, 2)


def random_views(count: int, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random rotations (count, 3, 3), the paper's views in training (section 3.1)."""
    return quaternion_matrix(random_quaternions(count, rng=rng))


def spread_views(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Rotations (B, 3, 3) to the one of ten views in which each cloud has the largest extent (section 3.1).

    The ten views are equal for all clouds. The extent is the smaller eigenvalue of the projection's
    covariance; the larger one decides between equals.
    """
    candidates = random_views(_NUM_VIEWS, rng=rng)  # (V, 3, 3)
    offsets, _ = centered(points, present)
    covariance = offsets.swapaxes(1, 2) @ offsets / np.maximum(present.sum(1), 1)[:, None, None]  # (B, 3, 3)
    image_axes = candidates[:, :2]  # (V, 2, 3)
    spreads = np.linalg.eigvalsh(image_axes @ covariance[:, None] @ image_axes.swapaxes(1, 2))  # ascending
    rounding = 1e-12 * np.trace(covariance, axis1=1, axis2=2)[:, None]
    smaller = np.where(spreads[..., 0] > rounding, spreads[..., 0], 0.0)
    best = np.lexsort((spreads[..., 1], smaller), axis=-1)[:, -1]
    return candidates[best]


def centered(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offsets (B, N, 3) of points from the mean of their cloud, 0 in padding, and the means (B, 3)."""
    known = np.where(present[..., None], points, 0.0)
    means = known.sum(axis=1) / np.maximum(present.sum(axis=1), 1)[:, None]
    return np.where(present[..., None], known - means[:, None], 0.0), means


def _moments(
    points: NDArray[np.float64], present: NDArray[np.bool_], views: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Third and fifth moments (B, V, K) of clouds (B, N, 3) in views (B, V, 3, 3), for unit variance."""
    seen = centered(points, present)[0][:, None] @ views.swapaxes(2, 3)  # (B, V, N, 3)
    count = np.maximum(present.sum(axis=1), 1)[:, None]
    spread = np.sqrt((seen * seen).sum(axis=(2, 3)) / count)
    seen = seen / np.where(spread > 0.0, spread, 1.0)[..., None, None]
    columns = [seen[..., list(powers)].prod(axis=-1).sum(axis=-1) / count for powers in _MOMENTS]
    return np.stack(columns, axis=-1)


def _nearest_axes(
    points: NDArray[np.float64], present: NDArray[np.bool_], aligned: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotations (B, 3, 3) to the principal axes, with the signs closest to the aligned views."""
    axes = principal_axes(points, present)
    axes = axes * np.linalg.det(axes)[:, None, None]
    rotations = SIGNS[SIGNS.prod(axis=1) > 0]
    nearest = np.einsum("bij,si,bij->bs", aligned, rotations, axes).argmax(axis=1)
    return np.asarray(rotations[nearest][:, :, None] * axes)


@dataclass(frozen=True, slots=True)
class ViewFrames:
    """The cameras of a batch of depth images."""

    rotations: Float[np.ndarray, "B 3 3"]
    """From the input's frame into the camera's; with determinant -1 the image is mirrored."""
    centers: Float[np.ndarray, "B 3"]
    """Mean of each cloud in the input's frame [m]."""
    scales: Float[np.ndarray, "B"]
    """View units per meter [1/m], the same for x, y and z."""
    nearest: Float[np.ndarray, "B"]
    """Depth of each cloud's nearest point, of brightness 0.1, relative to the mean [m]."""
    depth_ranges: Float[np.ndarray, "B"]
    """Depth between brightness 0.1 and 1.0 [m]; 0 if all points have the same depth."""

    def normalize(self, positions: Float[np.ndarray, "B N 3"]) -> NDArray[np.float64]:
        """Positions (B, N, 3) in the input's frame [m] as view units; NaN stays NaN."""
        rotated = (positions - self.centers[:, None]) @ self.rotations.swapaxes(1, 2)
        return np.asarray(rotated * self.scales[:, None, None])

    def restore(self, normalized: Float[np.ndarray, "B N 3"]) -> NDArray[np.float64]:
        """View units (B, N, 3), such as the network's output, as positions in the input's frame [m]."""
        return np.asarray((normalized / self.scales[:, None, None]) @ self.rotations + self.centers[:, None])


def depth_images(
    points: Float[np.ndarray, "B N 3"],
    present: Bool[np.ndarray, "B N"],
    rotations: Float[np.ndarray, "B 3 3"],
) -> tuple[Float32[np.ndarray, "B 52 52"], ViewFrames]:
    """Images of clouds [m], 0 for background and 0.1 (near) to 1.0 (far) for points, and their cameras.

    The farther of two points in one pixel is lost. A rotation with determinant -1 mirrors the image.
    """
    frames = _view_frames(points, present, rotations)
    safe = np.where(present[..., None], points, frames.centers[:, None])
    view = frames.normalize(safe)  # (B, N, 3)
    pixels = np.floor((view[..., :2] + 1.0) * (IMAGE_SIZE / 2)).astype(np.int64)
    depth = view[..., 2] / frames.scales[:, None] - frames.nearest[:, None]
    ranges = frames.depth_ranges[:, None]
    share = np.where(ranges > 0, depth / np.where(ranges > 0, ranges, 1.0), 0.5).clip(0.0, 1.0)
    brightness = NEAREST + (FARTHEST - NEAREST) * share
    images = np.full((len(points), IMAGE_SIZE, IMAGE_SIZE), np.inf)
    cloud, point = np.nonzero(present)
    columns, rows = pixels[cloud, point].T
    np.minimum.at(images, (cloud, rows, columns), brightness[cloud, point])
    return np.where(np.isfinite(images), images, 0.0).astype(np.float32), frames


def _view_frames(
    points: NDArray[np.float64], present: NDArray[np.bool_], rotations: NDArray[np.float64]
) -> ViewFrames:
    """Choose a camera for each of B clouds that has all points in its image."""
    offsets, centers = centered(points, present)
    rotated = offsets @ rotations.swapaxes(1, 2)
    extent = np.abs(rotated[..., :2]).max(axis=(1, 2), initial=SMALLEST_EXTENT)
    nearest = np.where(present, rotated[..., 2], np.inf).min(axis=1, initial=np.inf)
    farthest = np.where(present, rotated[..., 2], -np.inf).max(axis=1, initial=-np.inf)
    seen = present.any(axis=1)
    nearest, farthest = np.where(seen, nearest, 0.0), np.where(seen, farthest, 0.0)
    ranges = farthest - nearest
    return ViewFrames(
        rotations=rotations,
        centers=centers,
        scales=(1.0 - 2.0 * MARGIN) / extent,
        nearest=nearest,
        depth_ranges=np.where(ranges > FLAT, ranges, 0.0),
    )


class _ViewFit(NamedTuple):
    """Fit of the markers predicted from one view to a cloud."""

    distances: Float[np.ndarray, "N M"]
    """Distances of the points from the predicted markers [m]."""
    cost: float
    """Mean cost of a point in equation 1 [m]."""
    accepted: bool
    """Whether the fit is so good that no other view is tried."""


class CNNLabeler:
    """The paper's network, which maps images (B, 1, 52, 52) to positions (B, M, 3) in view units.

    Equation 1 then matches points, and its cost selects the view. The network knows only right hands;
    mirrored views show left hands as right ones.
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
        self._reject = config.reject or _SEARCH_REJECT
        self._spread = config.spread or _SPREAD

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self.label_batch)

    def label_batch(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        """Label the points [m] of several frames together."""
        return [label_by_distance(one, self._reject, self._spread) for one in self.distances(clouds)]

    def distances(self, clouds: list[NDArray[np.float64]]) -> list[Float[np.ndarray, "N M"]]:
        """Distances of the points of each cloud from its predicted markers in the best view [m]."""
        padded, present = pad_clouds(clouds)
        points = padded.astype(np.float64)
        if self._aligned:
            views = self._hand.first_views(points, present)
        else:  # A fixed seed gives equal clouds equal labels.
            shown = spread_views(points, present, rng=np.random.default_rng(0))
            views = np.stack([shown, MIRROR_IMAGE[:, None] * shown], axis=1)
        best = [_ViewFit(np.zeros((0, 0)), np.inf, False)] * len(clouds)  # worse than any view
        pending = np.arange(len(clouds))
        for tried in np.split(np.arange(views.shape[1]), np.cumsum(_FIRST_GROUPS)):
            rows = np.repeat(pending, len(tried))
            predicted = self.predict(points[rows], present[rows], views[pending][:, tried].reshape(-1, 3, 3))
            for row, markers in zip(rows, predicted, strict=True):
                view = _fit_view(points[row, present[row]], markers)
                best[row] = min(best[row], view, key=lambda each: each.cost)
            pending = pending[[not best[row].accepted for row in pending]]
            if not len(pending):
                break
        return [view.distances for view in best]

    def predict(
        self,
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
        views: Float[np.ndarray, "B 3 3"],
    ) -> NDArray[np.float64]:
        """Predicted markers (B, M, 3) [m] in the frame of the points, starting from these views."""
        predicted = self._predict_once(points, present, views)
        if self._aligned:
            sides = np.sign(np.linalg.det(views))
            for _ in range(_ALIGNMENTS):
                views = self._hand.align(predicted, sides)
                predicted = self._predict_once(points, present, views)
        return predicted

    def _predict_once(
        self, points: NDArray[np.float64], present: NDArray[np.bool_], views: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Markers (B, M, 3) [m] predicted from these views."""
        parts = [np.zeros((0, len(self.marker_names), 3))]
        for first in range(0, len(points), _MOST_IMAGES):
            part = slice(first, first + _MOST_IMAGES)
            images, frames = depth_images(points[part], present[part], views[part])
            normalized = self._positions(images[:, None]).astype(np.float64)
            check_output(normalized)
            parts.append(frames.restore(normalized))
        return np.concatenate(parts)


def _fit_view(points: NDArray[np.float64], markers: NDArray[np.float64]) -> _ViewFit:
    """Compare predicted markers (M, 3) [m] with points (N, 3) [m]."""
    distances = np.linalg.norm(points[:, None] - markers, axis=-1)
    labels = match_distances(distances, _SEARCH_REJECT)
    labeled = labels >= 0
    costs = np.where(labeled, distances[np.arange(len(points)), labels], _SEARCH_REJECT)
    near = len(points) == 0 or (labeled.any() and float(costs[labeled].mean()) <= _ACCEPTED_DISTANCE)
    accepted = bool(near and (~labeled).sum() <= _ACCEPTED_GHOSTS)
    return _ViewFit(distances, float(costs.mean()) if len(costs) else 0.0, accepted)


def label_by_distance(distances: Float[np.ndarray, "N M"], reject: float, spread: float) -> Labeling:
    """Labels of equation 1 from distances to predicted markers [m]; a ghost costs `reject` [m].

    The confidence is the label's share of all weights, which fall by a factor of e over `spread` [m].
    """
    labels = match_distances(distances, reject)
    rejects = np.full((len(distances), 1), reject)
    costs = np.concatenate([distances, rejects], axis=1)
    weights = np.exp(-(costs - costs.min(axis=1, keepdims=True)) / spread)
    taken = weights[np.arange(len(weights)), labels]  # GHOST, -1, is the last column
    return Labeling(labels, taken / weights.sum(axis=1))
