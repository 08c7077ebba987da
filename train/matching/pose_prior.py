"""How likely labeled points are as the markers of a hand: a mixture of poses, wherever the hand is.

Each component is a mean hand with the directions in which markers move together around it (probabilistic
principal components, Tipping and Bishop 1999). Missing markers are left out of mean and covariance, which is
exact for a normal distribution. Points are turned and moved onto each mean hand first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray

from handsim.errors import WeightsError
from handsim.kernels.kernel import kernel

_NEAREST: Final = 4  # components that count, of all those whose mean hand is compared with the points
_LEAST_POINTS: Final = 4  # fewer fit any hand
_NEWTON_STEPS: Final = 12  # of a polynomial of fourth degree, from above its largest root
_MIRROR: Final = np.array([-1.0, 1.0, 1.0])
_MOST_COMPONENTS, _MOST_DIRECTIONS = 10_000, 100


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """Density of the markers of right hands, up to a rigid motion.

    Raises:
        WeightsError: The shapes do not agree, or something is not finite.
    """

    means: Float32[np.ndarray, "K M 3"]
    """Mean hand of each component [m]."""
    directions: Float32[np.ndarray, "K M 3 R"]
    """Directions in which it varies, with their standard deviations as lengths [m]."""
    spreads: Float32[np.ndarray, "K"]
    """Standard deviation of each coordinate around them [m]."""
    log_weights: Float32[np.ndarray, "K"]
    """Logarithm of each component's share."""

    def __post_init__(self) -> None:
        count, markers = self.means.shape[:2] if self.means.ndim == 3 else (0, 0)
        rank = self.directions.shape[-1] if self.directions.ndim == 4 else 0
        shapes = ((count, markers, 3), (count, markers, 3, rank), (count,), (count,))
        found = tuple(getattr(self, field.name) for field in fields(self))
        if (
            tuple(one.shape for one in found) != shapes
            or not 0 < count <= _MOST_COMPONENTS
            or not 0 < rank <= _MOST_DIRECTIONS
            or not all(np.isfinite(one).all() for one in found)
            or not (self.spreads > 0.0).all()
        ):
            raise WeightsError("the pose prior is damaged: its tables do not agree or are not finite")

    @property
    def num_markers(self) -> int:
        """Markers of the layout."""
        return int(self.means.shape[1])

    def log_density(
        self,
        points: Float[np.ndarray, "N 3"],
        labels: Int[np.ndarray, "N"],
        *,
        mirrored: bool,
        among: Int[np.ndarray, "C"] | None = None,
    ) -> float:
        """Logarithm of the density of labeled points; -inf for fewer than four.

        Args:
            points: Points [m].
            labels: Marker of each point, no marker twice.
            mirrored: Whether the hand is a left one.
            among: The components that count, see `nearest`; all when not given.
        """
        if len(points) < _LEAST_POINTS:
            return -np.inf
        nearest = self.nearest(points, labels, mirrored=mirrored, count=_NEAREST, among=among)
        tables = self.means, self.directions, self.spreads, self.log_weights
        return float(_log_density(_seen(points, mirrored), labels, nearest, *tables))

    def nearest(
        self,
        points: Float[np.ndarray, "N 3"],
        labels: Int[np.ndarray, "N"],
        *,
        mirrored: bool,
        count: int,
        among: Int[np.ndarray, "C"] | None = None,
    ) -> Int[np.ndarray, "K"]:
        """The components whose mean hands are nearest to labeled points, the nearest first.

        Args:
            points: Points [m].
            labels: Marker of each point, no marker twice.
            mirrored: Whether the hand is a left one.
            count: How many, at most.
            among: The components to choose from; all when not given.
        """
        chosen = np.arange(len(self.means)) if among is None else among
        errors = _misses(_seen(points, mirrored), labels, chosen, self.means)
        return chosen[np.argsort(errors)[:count]]

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """The tables by name, for a file; directions in half precision, which is enough for them."""
        tables = {field.name: getattr(self, field.name) for field in fields(self)}
        return tables | {"directions": self.directions.astype(np.float16)}

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, NDArray[np.generic]]) -> PosePrior:
        """The prior out of a file's tables.

        Raises:
            WeightsError: Tables are missing, or not those of a prior.
        """
        if set(tensors) != {field.name for field in fields(cls)}:
            raise WeightsError(f"the pose prior has the tables {', '.join(sorted(tensors)) or 'none'}")
        return cls(**{name: np.asarray(table, dtype=np.float32) for name, table in tensors.items()})


def _seen(points: NDArray[np.float64], mirrored: bool) -> NDArray[np.float64]:
    """Centered points (N, 3) of what is a right hand then."""
    centered: NDArray[np.float64] = points - points.mean(axis=0)
    return centered * _MIRROR if mirrored else centered


@kernel
def _misses(
    cloud: NDArray[np.float64],
    labels: NDArray[np.int64],
    chosen: NDArray[np.int64],
    means: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Squared distances (C,) of centered points (N, 3) to mean hands (K, M, 3) turned onto them [m^2]."""
    errors = np.empty(len(chosen))
    for number in range(len(chosen)):
        product, size = _product(cloud, labels, means[chosen[number]])
        errors[number] = size - 2.0 * _largest_root(_quaternion_matrix(product), 0.5 * size)
    return errors


@kernel
def _log_density(
    cloud: NDArray[np.float64],
    labels: NDArray[np.int64],
    chosen: NDArray[np.int64],
    means: NDArray[np.float32],
    directions: NDArray[np.float32],
    spreads: NDArray[np.float32],
    log_weights: NDArray[np.float32],
) -> float:
    """Of centered points (N, 3) by some components (C,); tables as in `PosePrior`."""
    total = -np.inf
    for component in chosen:
        residual = _residual(cloud, labels, means[component])
        log = log_weights[component] + _log_normal(
            residual, labels, directions[component], float(spreads[component])
        )
        high = max(total, log)
        total = high + np.log(np.exp(total - high) + np.exp(log - high))
    return total


@kernel
def _center(labels: NDArray[np.int64], mean: NDArray[np.float32]) -> NDArray[np.float64]:
    """Center (3,) of some markers of a mean hand (M, 3)."""
    center = np.zeros(3)
    for label in labels:
        for axis in range(3):
            center[axis] += mean[label, axis]
    return center / len(labels)


@kernel
def _product(
    cloud: NDArray[np.float64], labels: NDArray[np.int64], mean: NDArray[np.float32]
) -> tuple[NDArray[np.float64], float]:
    """Sum of the outer products (3, 3) of centered points (N, 3) and markers, and of both's squares."""
    center, product, size = _center(labels, mean), np.zeros((3, 3)), 0.0
    for number in range(len(cloud)):
        for second in range(3):
            there = mean[labels[number], second] - center[second]
            size += there * there + cloud[number, second] * cloud[number, second]
            for first in range(3):
                product[first, second] += cloud[number, first] * there
    return product, size


@kernel
def _quaternion_matrix(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Horn's matrix (4, 4) of a sum of outer products (3, 3): its first eigenvector is the best rotation."""
    k = np.empty((4, 4))
    k[0, 0] = p[0, 0] + p[1, 1] + p[2, 2]
    k[1, 1] = p[0, 0] - p[1, 1] - p[2, 2]
    k[2, 2] = p[1, 1] - p[0, 0] - p[2, 2]
    k[3, 3] = p[2, 2] - p[0, 0] - p[1, 1]
    k[0, 1] = k[1, 0] = p[1, 2] - p[2, 1]
    k[0, 2] = k[2, 0] = p[2, 0] - p[0, 2]
    k[0, 3] = k[3, 0] = p[0, 1] - p[1, 0]
    k[1, 2] = k[2, 1] = p[0, 1] + p[1, 0]
    k[1, 3] = k[3, 1] = p[0, 2] + p[2, 0]
    k[2, 3] = k[3, 2] = p[1, 2] + p[2, 1]
    return k


@kernel
def _largest_root(k: NDArray[np.float64], above: float) -> float:
    """Largest eigenvalue of Horn's matrix, from a bound above it (Theobald 2005).

    Its trace is zero, so the characteristic polynomial is x^4 + c2 x^2 + c1 x + c0.
    """
    square = k @ k
    c2 = -0.5 * np.trace(square)
    c1 = -np.trace(square @ k) / 3.0
    c0 = np.linalg.det(k)
    root = above
    for _ in range(_NEWTON_STEPS):
        value = ((root * root + c2) * root + c1) * root + c0
        slope = (4.0 * root * root + 2.0 * c2) * root + c1
        if slope <= 0.0:
            break
        step = value / slope
        root -= step
        if abs(step) <= 1e-9 * above:
            break
    return root


@kernel
def _residual(
    cloud: NDArray[np.float64], labels: NDArray[np.int64], mean: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Centered points (N, 3), turned onto a mean hand, minus its markers."""
    w, x, y, z = np.linalg.eigh(_quaternion_matrix(_product(cloud, labels, mean)[0]))[1][:, 3]
    rotation = np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
    center = _center(labels, mean)
    residual: NDArray[np.float64] = cloud @ rotation.T
    for number in range(len(cloud)):
        for axis in range(3):
            residual[number, axis] -= mean[labels[number], axis] - center[axis]
    return residual


@kernel
def _log_normal(
    residual: NDArray[np.float64], labels: NDArray[np.int64], directions: NDArray[np.float32], spread: float
) -> float:
    """Log-density of residuals (N, 3) whose covariance is D D^T + spread^2 I, D being rows of directions.

    The matrix of the directions (R, R) stands for that of the residuals (Woodbury's identity).
    """
    count, rank = 3 * len(residual), directions.shape[2]
    rows = np.empty((count, rank))
    for number in range(len(residual)):
        for axis in range(3):
            for direction in range(rank):
                rows[3 * number + axis, direction] = directions[labels[number], axis, direction]
    flat = residual.ravel()
    inner = rows.T @ rows
    for direction in range(rank):
        inner[direction, direction] += spread * spread
    lower = np.linalg.cholesky(inner)
    along = np.linalg.solve(lower, rows.T @ flat)
    distance = (flat @ flat - along @ along) / (spread * spread)
    log_determinant = 2.0 * (count - rank) * np.log(spread)
    for direction in range(rank):
        log_determinant += 2.0 * np.log(lower[direction, direction])
    log: float = -0.5 * (distance + log_determinant + count * np.log(2.0 * np.pi))
    return log
