"""Density of labeled points as a hand, in any position and orientation, and recognition of its side.

The prior is a mixture. Each component is a mean hand with the directions in which its markers move together
(probabilistic principal components, Tipping and Bishop 1999), learned from a cluster of frames. Missing
markers are left out of mean and covariance, which is exact for a normal distribution. Points are first
aligned with each mean hand.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray

from gloves.layout import MarkerLayout
from handsim.errors import WeightsError
from handsim.hand.shape import SIZES, Side
from handsim.kernels import horn_matrix, kernel, write_quaternion_matrix

NEAREST: Final = 4
"""Number of components in a density: those with the mean hands nearest to the points."""
_ROUGH, _EXACT = 1e-9, 1e-14  # tolerances of the largest root, relative to its upper bound
_MAX_COMPONENTS, _MAX_DIRECTIONS = 10_000, 100
FloatArray = NDArray[np.float64]

_MAX_LEARNED_COMPONENTS: Final = 400
_FRAMES_PER_COMPONENT: Final = 400
_MIN_COMPONENTS: Final = 12  # With fewer components a prior knows less than the network.
_MIN_MEMBERS: Final = 20  # least number of frames of a component
_DIRECTIONS: Final = 24  # about the degrees of freedom of a hand
_NOISE: Final = 0.0012  # [m] noise of a marker's coordinate in a capture, from optics and skin
_NEIGHBOR_FRAMES: Final = 100.0  # weight of the neighbors' covariance, in frames
_NEIGHBORS: Final = 8
_ITERATIONS: Final = 4  # iterations of each clustering and alignment
_RIGID: Final = 6  # degrees of freedom that the alignment removes
_CHUNK: Final = 8192  # number of frames compared with the centers at once
_MAX_FRAMES: Final = 200_000

_MAX_FOURS: Final = 3000
_POSES: Final = 100  # number of poses of a hand of each size
_RECOGNIZED: Final = 0.98  # Layouts with fewer recognized complete hands resemble their mirror image.


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """Density of the markers of right hands, up to a rigid motion."""

    means: Float32[np.ndarray, "K M 3"]
    """Mean hand of each component [m]."""
    directions: Float32[np.ndarray, "K M 3 R"]
    """Principal directions of each component; their lengths are standard deviations [m]."""
    spreads: Float32[np.ndarray, "K"]
    """Standard deviation of each coordinate apart from these directions [m]."""
    log_weights: Float32[np.ndarray, "K"]
    """Logarithm of each component's share."""

    def __post_init__(self) -> None:
        count, markers = self.means.shape[:2] if self.means.ndim == 3 else (0, 0)
        rank = self.directions.shape[-1] if self.directions.ndim == 4 else 0
        shapes = ((count, markers, 3), (count, markers, 3, rank), (count,), (count,))
        found = tuple(getattr(self, field.name) for field in fields(self))
        if (
            tuple(one.shape for one in found) != shapes
            or not 0 < count <= _MAX_COMPONENTS
            or not 0 < rank <= _MAX_DIRECTIONS
            or not all(np.isfinite(one).all() for one in found)
            or not (self.spreads > 0.0).all()
        ):
            raise WeightsError("the pose prior is damaged: its tables do not agree or are not finite")

    @property
    def num_markers(self) -> int:
        """Number of markers of the layout."""
        return int(self.means.shape[1])

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """The tables by name, for a file, with directions in half precision."""
        tables = {field.name: getattr(self, field.name) for field in fields(self)}
        return tables | {"directions": self.directions.astype(np.float16)}

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, NDArray[np.generic]], num_labels: int) -> PosePrior:
        """The prior from the tables of a file, for a labeler of so many markers."""
        if set(tensors) != {field.name for field in fields(cls)}:
            raise WeightsError(f"the pose prior has the tables {', '.join(sorted(tensors)) or 'none'}")
        if any(table.dtype not in (np.float16, np.float32) for table in tensors.values()):
            raise WeightsError("the pose prior has tables of other types, expected float16 or float32")
        prior = cls(**{name: np.asarray(table, dtype=np.float32) for name, table in tensors.items()})
        if prior.num_markers != num_labels:
            raise WeightsError(f"the pose prior has {prior.num_markers} markers for {num_labels} labels")
        return prior


class PriorTables(NamedTuple):
    """The tables of a `PosePrior` for kernels."""

    by_marker: Float[np.ndarray, "M 3 K"]
    """See `means_by_marker`, of all components."""
    means: Float32[np.ndarray, "K M 3"]
    directions: Float32[np.ndarray, "K M 3 R"]
    spreads: Float32[np.ndarray, "K"]
    log_weights: Float32[np.ndarray, "K"]


@functools.lru_cache(maxsize=8)
def tables_of(prior: PosePrior) -> PriorTables:
    """The tables of a prior, cached for all clouds."""
    by_marker = means_by_marker(prior.means, np.arange(len(prior.means)))
    return PriorTables(by_marker, prior.means, prior.directions, prior.spreads, prior.log_weights)


@kernel
def seen_as_right(points: Float[np.ndarray, "N 3"], mirrored: bool) -> FloatArray:
    """Center points (N, 3) [m], and mirror those of a left hand."""
    centered = points.copy()
    for axis in range(3):
        centered[:, axis] -= points[:, axis].mean()
    if mirrored:
        centered[:, 0] *= -1.0
    return centered


@kernel
def means_by_marker(means: Float32[np.ndarray, "K M 3"], chosen: Int[np.ndarray, "C"]) -> FloatArray:
    """Mean hands (M, 3, C) of some components [m], contiguous along components."""
    table = np.empty((means.shape[1], 3, len(chosen)))
    for number in range(len(chosen)):
        for marker in range(means.shape[1]):
            for axis in range(3):
                table[marker, axis, number] = means[chosen[number], marker, axis]
    return table


@kernel
def procrustes_errors(
    cloud: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], table: Float[np.ndarray, "M 3 C"]
) -> FloatArray:
    """Squared distances (C,) of centered points from mean hands aligned with them [m^2]."""
    return errors_of_products(*products_with_means(cloud, labels, table), False)


@kernel
def products_with_means(
    cloud: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], table: Float[np.ndarray, "M 3 C"]
) -> tuple[FloatArray, FloatArray]:
    """Sums of outer products (9, C) of points and mean hands' markers, and of squares (C,) [m^2]."""
    count, size = table.shape[2], 0.0
    product, center, squares = np.zeros((9, count)), np.zeros((3, count)), np.zeros(count)
    for number in range(len(cloud)):
        x, y, z = cloud[number, 0], cloud[number, 1], cloud[number, 2]
        size += x * x + y * y + z * z
        for axis in range(3):
            mean = table[labels[number], axis]
            for one in range(count):
                product[axis, one] += x * mean[one]
                product[3 + axis, one] += y * mean[one]
                product[6 + axis, one] += z * mean[one]
                center[axis, one] += mean[one]
                squares[one] += mean[one] * mean[one]
    for one in range(count):
        off = center[0, one] ** 2 + center[1, one] ** 2 + center[2, one] ** 2
        squares[one] = size + squares[one] - off / len(cloud)
    return product, squares


@kernel
def errors_of_products(
    product: Float[np.ndarray, "9 C"], squares: Float[np.ndarray, "C"], mirrored: bool
) -> FloatArray:
    """Procrustes errors (C,) [m^2] of points, or of their mirror image, from `products_with_means`."""
    errors = np.empty(len(squares))
    for one in range(len(squares)):
        largest = _largest_root(product[:, one], mirrored, 0.5 * squares[one], _ROUGH)
        errors[one] = squares[one] - 2.0 * largest
    return errors


@kernel
def _largest_root(product: Float[np.ndarray, "9"], mirrored: bool, above: float, tolerance: float) -> float:
    """Largest eigenvalue of Horn's matrix of a sum of outer products, from an upper bound (Theobald 2005).

    Its characteristic polynomial is x^4 + c2 x^2 + c1 x + c0. For a mirrored cloud, with the first
    coordinates negated, only the sign of c1 changes.
    """
    a, b, c, d, e, f, g, h, i = product
    xx, yy, zz = a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i
    xy, xz, yz = a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i
    total = xx + yy + zz
    c2 = -2.0 * total
    c1 = -8.0 * (a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
    if mirrored:
        c1 = -c1
    c0 = 2.0 * (xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) - total * total
    root = above
    for _ in range(60):
        value = ((root * root + c2) * root + c1) * root + c0
        slope = (4.0 * root * root + 2.0 * c2) * root + c1
        if slope <= 0.0:
            break
        step = value / slope
        root -= step
        if abs(step) <= tolerance * above:
            break
    return root


@kernel
def log_density(
    cloud: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    chosen: Int[np.ndarray, "C"],
    prior: PriorTables,
) -> float:
    """Log-density of centered, labeled points [m] under some components."""
    total = -np.inf
    for component in chosen:
        spread, directions = float(prior.spreads[component]), prior.directions[component]
        lower = factor_of(labels, directions, spread)
        residual = residual_of(cloud, labels, prior.means[component])
        log = prior.log_weights[component] + log_normal(residual, labels, directions, lower, spread)
        high = max(total, log)
        total = high + np.log(np.exp(total - high) + np.exp(log - high))
    return total


@kernel
def factor_of(
    labels: Int[np.ndarray, "N"], directions: Float32[np.ndarray, "M 3 R"], spread: float
) -> FloatArray:
    """Lower Cholesky factor (R, R) of D^T D + spread^2 I, where D holds some markers' directions [m]."""
    rank = directions.shape[2]
    rows = np.empty((3 * len(labels), rank))
    for number in range(len(labels)):
        for axis in range(3):
            for direction in range(rank):
                rows[3 * number + axis, direction] = directions[labels[number], axis, direction]
    inner = rows.T @ rows
    for direction in range(rank):
        inner[direction, direction] += spread * spread
    return np.linalg.cholesky(inner).astype(np.float64)


@kernel
def residual_of(
    cloud: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], mean: Float32[np.ndarray, "M 3"]
) -> FloatArray:
    """Residuals (N, 3) [m] of centered points after alignment with a mean hand."""
    center, product, bound = np.zeros(3), np.zeros((3, 3)), 0.0
    for number in range(len(cloud)):
        for axis in range(3):
            there = mean[labels[number], axis]
            center[axis] += there / len(cloud)
            bound += 0.5 * (there * there + cloud[number, axis] * cloud[number, axis])
            for first in range(3):
                product[first, axis] += cloud[number, first] * there
    root = _largest_root(product.ravel(), False, bound, _EXACT)
    w, x, y, z = _largest_eigenvector(horn_matrix(product), root)
    rotation = np.empty((3, 3))
    write_quaternion_matrix(rotation, w, x, y, z)
    residual = np.empty_like(cloud)
    for number in range(len(cloud)):
        for axis in range(3):
            turned = 0.0
            for first in range(3):
                turned += rotation[axis, first] * cloud[number, first]
            residual[number, axis] = turned - mean[labels[number], axis] + center[axis]
    return residual


@kernel
def _largest_eigenvector(k: Float[np.ndarray, "4 4"], root: float) -> FloatArray:
    """Unit eigenvector (4,) of the largest eigenvalue of Horn's matrix.

    The adjugate of k - root is a multiple of the outer product of the eigenvector with itself; its row with
    the largest diagonal element is the most accurate.
    """
    shifted = k.copy()
    for axis in range(4):
        shifted[axis, axis] -= root
    best, most = 0, -1.0
    for axis in range(4):
        size = abs(_cofactor(shifted, axis, axis))
        if size > most:
            best, most = axis, size
    vector = np.empty(4)
    for axis in range(4):
        vector[axis] = _cofactor(shifted, best, axis)
    length = np.sqrt((vector * vector).sum())
    if not length > 0.0:  # two equal eigenvalues: any combination of their eigenvectors
        vector, length = np.linalg.eigh(k)[1][:, 3], 1.0
    unit: FloatArray = vector / length
    return unit


@kernel
def _cofactor(m: Float[np.ndarray, "4 4"], row: int, column: int) -> float:
    """Cofactor of an element of a matrix."""
    a, b, c = (row + 1) % 4, (row + 2) % 4, (row + 3) % 4
    d, e, f = (column + 1) % 4, (column + 2) % 4, (column + 3) % 4
    minor: float = (
        m[a, d] * (m[b, e] * m[c, f] - m[b, f] * m[c, e])
        - m[a, e] * (m[b, d] * m[c, f] - m[b, f] * m[c, d])
        + m[a, f] * (m[b, d] * m[c, e] - m[b, e] * m[c, d])
    )
    return minor if (row + column) % 2 == 0 else -minor


@kernel
def log_normal(
    residual: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, "N"],
    directions: Float32[np.ndarray, "M 3 R"],
    lower: Float[np.ndarray, "R R"],
    spread: float,
) -> float:
    """Log-density of residuals [m] with covariance D D^T + spread^2 I, where D holds rows of directions.

    By Woodbury's identity the matrix of directions (R, R), with Cholesky factor `lower`, replaces that of the
    residuals.
    """
    count, rank = 3 * len(labels), directions.shape[2]
    along, distance = np.zeros(rank), 0.0
    for number in range(len(labels)):
        for axis in range(3):
            value = residual[number, axis]
            distance += value * value
            for direction in range(rank):
                along[direction] += directions[labels[number], axis, direction] * value
    log_determinant = 2.0 * (count - rank) * np.log(spread)
    for direction in range(rank):
        for earlier in range(direction):
            along[direction] -= lower[direction, earlier] * along[earlier]
        along[direction] /= lower[direction, direction]
        distance -= along[direction] * along[direction]
        log_determinant += 2.0 * np.log(lower[direction, direction])
    distance /= spread * spread
    log: float = -0.5 * (distance + log_determinant + count * np.log(2.0 * np.pi))
    return log


def learn_pose_prior(markers: Float[np.ndarray, "T M 3"], *, rng: np.random.Generator) -> PosePrior | None:
    """Learn the prior of right hands from complete frames [m]; None for too few frames or markers."""
    markers = markers[np.isfinite(markers).all(axis=(1, 2))].astype(np.float64, copy=False)
    if len(markers) > _MAX_FRAMES:
        markers = markers[np.sort(rng.permutation(len(markers))[:_MAX_FRAMES])]
    count = min(_MAX_LEARNED_COMPONENTS, len(markers) // _FRAMES_PER_COMPONENT)
    rank = min(_DIRECTIONS, 3 * markers.shape[1] - _RIGID - 1)
    if count < _MIN_COMPONENTS or rank < 1:
        return None
    members = _clusters(markers, count, rng)
    means, scatters, sizes = _moments(markers, members, count)
    covariances = _shrunk_covariances(means, scatters, sizes)
    values, vectors = np.linalg.eigh(covariances)  # in ascending order
    spreads = np.sqrt(values[:, _RIGID:-rank].mean(axis=1) + _NOISE**2)
    deviations = np.sqrt(np.maximum(values[:, -rank:] + _NOISE**2 - spreads[:, None] ** 2, 0.0))
    directions = vectors[:, :, -rank:] * deviations[:, None]
    return PosePrior(
        means.astype(np.float32),
        directions.reshape(*means.shape, rank).astype(np.float32),
        spreads.astype(np.float32),
        np.log(sizes / sizes.sum()).astype(np.float32),
    )


def align_all(
    hands: Float[np.ndarray, "T M 3"], target: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "T M 3"]:
    """Align hands with a target by least squares (Kabsch 1976) [m]."""
    centered = hands - hands.mean(axis=1, keepdims=True)
    center = target.mean(axis=0)
    left, _, right = np.linalg.svd(centered.swapaxes(1, 2) @ (target - center))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    return np.asarray(centered @ (left @ right) + center)


def _clusters(
    markers: Float[np.ndarray, "T M 3"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, "T"]:
    """Cluster of each frame, by k-means of the hands aligned with their mean."""
    mean = markers[0]
    for _ in range(_ITERATIONS):
        mean = align_all(markers, mean).mean(axis=0)
    flat = align_all(markers, mean).reshape(len(markers), -1)
    centers = flat[rng.permutation(len(flat))[:count]]
    members = _nearest(flat, centers)
    for _ in range(_ITERATIONS):
        sums = np.zeros_like(centers)
        np.add.at(sums, members, flat)
        sizes = np.bincount(members, minlength=count)
        centers = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centers)
        members = _nearest(flat, centers)
    return members


def _nearest(flat: Float[np.ndarray, "T D"], centers: Float[np.ndarray, "K D"]) -> Int[np.ndarray, "T"]:
    """Index of the nearest center of each row."""
    offsets = (centers**2).sum(axis=1)
    parts = [
        (offsets - 2.0 * flat[first : first + _CHUNK] @ centers.T).argmin(axis=1)
        for first in range(0, len(flat), _CHUNK)
    ]
    return np.concatenate(parts)


def _moments(
    markers: Float[np.ndarray, "T M 3"], members: Int[np.ndarray, "T"], count: int
) -> tuple[Float[np.ndarray, "K M 3"], Float[np.ndarray, "K D D"], Int[np.ndarray, "K"]]:
    """Mean hand, scatter matrix around it and size of each cluster with enough members."""
    means, scatters, sizes = [], [], []
    for cluster in range(count):
        hands = markers[members == cluster]
        if len(hands) < _MIN_MEMBERS:
            continue
        mean = hands[0]
        for _ in range(_ITERATIONS):
            aligned = align_all(hands, mean)
            mean = aligned.mean(axis=0)
        off = (aligned - mean).reshape(len(hands), -1)
        means.append(mean)
        scatters.append(off.T @ off)
        sizes.append(len(hands))
    return np.array(means), np.array(scatters), np.array(sizes)


def _shrunk_covariances(
    means: Float[np.ndarray, "K M 3"], scatters: Float[np.ndarray, "K D D"], sizes: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K D D"]:
    """Covariances of the clusters, each shrunk toward its neighbors', because it has few frames."""
    flat = means.reshape(len(means), -1)
    covariances = np.empty_like(scatters)
    for cluster, mean in enumerate(flat):
        near = np.argsort(((flat - mean) ** 2).sum(axis=1))[1 : _NEIGHBORS + 1]
        around = scatters[near].sum(axis=0) / sizes[near].sum()
        covariances[cluster] = (scatters[cluster] + _NEIGHBOR_FRAMES * around) / (
            sizes[cluster] + _NEIGHBOR_FRAMES
        )
    return covariances


class SideClassifier:
    """Classifies the labeled hands of a layout as left or right, one frame at a time.

    Four labeled points span a tetrahedron, whose orientation a mirror inverts. Some groups of four have the
    same orientation in almost every pose (thumb, knuckles and wrist), others do not. Poses of simulated right
    hands measure this; each group votes with the log-odds of its orientation.
    """

    def __init__(self, layout: MarkerLayout, *, rng: np.random.Generator) -> None:
        fours = np.array(list(combinations(range(layout.num_markers), 4)))
        if len(fours) > _MAX_FOURS:
            fours = fours[rng.choice(len(fours), size=_MAX_FOURS, replace=False)]
        markers = np.concatenate([_right_hands(layout, size, rng) for size in SIZES])
        mean = _mean_orientation(markers, fours)
        self._fours: NDArray[np.int64] = fours
        self._votes: NDArray[np.float64] = np.arctanh(mean.clip(-0.999, 0.999))
        self._num_markers = layout.num_markers

    def classify(self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]) -> tuple[Side, float]:
        """Side of one hand [m], and clarity of the vote from 0 to 1; 0 for fewer than four markers."""
        markers = np.full((self._num_markers, 3), np.nan)
        markers[labels[labels >= 0]] = points[labels >= 0]
        vote, most = _vote(markers, self._fours, self._votes)
        return ("left" if vote < 0.0 else "right"), abs(vote) / most if most else 0.0


def is_mirror_like(layout: MarkerLayout) -> bool:
    """Whether a layout is nearly its own mirror image, so that true labels do not always show the side."""
    if any(one.bone.startswith("thumb") for one in layout.markers):
        return False  # A thumb always shows the side.
    rng = np.random.default_rng(0)
    classifier, labels = SideClassifier(layout, rng=rng), np.arange(layout.num_markers)
    sides = [classifier.classify(hand, labels)[0] for hand in _right_hands(layout, "M", rng)]
    return sides.count("right") < _RECOGNIZED * len(sides)


def _right_hands(layout: MarkerLayout, size: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Markers (T, M, 3) [m] of a right hand of a size in random poses."""
    from gloves.fit import attach_markers
    from handsim.hand.model import HandModel, join_qpos
    from poses.shapes import sample_valid_angles

    hand = HandModel.named(size)
    qpos = join_qpos(sample_valid_angles(hand, _POSES, rng=rng))
    markers, _ = attach_markers(layout, hand).markers(hand, hand.forward_kinematics(qpos))
    return markers


@kernel
def _mean_orientation(
    hands: Float[np.ndarray, "T M 3"], fours: Int[np.ndarray, "F 4"]
) -> NDArray[np.float64]:
    """Mean over hands of the sign of each group's volume (F,); markers in [m]."""
    mean = np.zeros(len(fours))
    for hand in range(len(hands)):
        for number in range(len(fours)):
            volume = _volume(hands[hand], fours[number])
            mean[number] += 1.0 if volume > 0.0 else -1.0 if volume < 0.0 else 0.0
    return mean / len(hands)


@kernel
def _vote(
    markers: Float[np.ndarray, "M 3"], fours: Int[np.ndarray, "F 4"], votes: Float[np.ndarray, "F"]
) -> tuple[float, float]:
    """Sum of the votes of all groups of four, and its largest possible value."""
    vote, most = 0.0, 0.0
    for number in range(len(fours)):
        volume = _volume(markers, fours[number])
        if volume > 0.0:
            vote += votes[number]
            most += abs(votes[number])
        elif volume < 0.0:
            vote -= votes[number]
            most += abs(votes[number])
    return vote, most


@kernel
def _volume(markers: Float[np.ndarray, "M 3"], four: Int[np.ndarray, "4"]) -> float:
    """Six times the signed volume [m^3] of the tetrahedron of four markers."""
    x, y, z = markers[four[0], 0], markers[four[0], 1], markers[four[0], 2]
    ax, ay, az = markers[four[1], 0] - x, markers[four[1], 1] - y, markers[four[1], 2] - z
    bx, by, bz = markers[four[2], 0] - x, markers[four[2], 1] - y, markers[four[2], 2] - z
    cx, cy, cz = markers[four[3], 0] - x, markers[four[3], 1] - y, markers[four[3], 2] - z
    return float((ay * bz - az * by) * cx + (az * bx - ax * bz) * cy + (ax * by - ay * bx) * cz)
