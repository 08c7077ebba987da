"""Lenses: how a camera's picture departs from a pinhole's.

`brown` is Brown and Conrady's model in OpenCV's order (k1, k2, p1, p2, k3); `fisheye` is Kannala and Brandt's
(2006), OpenCV's `cv2.fisheye`: theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from handsim.errors import ShapeError, choices

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

LensKind = Literal["pinhole", "brown", "fisheye"]
_COEFFICIENTS: Final[dict[str, int]] = {"pinhole": 0, "brown": 5, "fisheye": 4}
_STEPS: Final = 60  # of bisection: more than a double has bits to halve


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens and its coefficients.

    Raises:
        ShapeError: There is no such lens, it has another number of coefficients, or they are not finite.
    """

    kind: LensKind = "pinhole"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in _COEFFICIENTS:
            raise ShapeError(choices(self.kind, _COEFFICIENTS, noun="lens"))
        wanted = _COEFFICIENTS[self.kind]
        if len(self.coefficients) != wanted or not np.isfinite(self.coefficients).all():
            raise ShapeError(
                f"a lens '{self.kind}' with coefficients {self.coefficients}, wanted {wanted} finite numbers"
            )

    def distort(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Where rays meet the picture at a distance of one focal length; x right, y down.

        Args:
            directions: In the camera's axes, z ahead. NaN comes of what the lens does not see: what lies
                behind a pinhole or a Brown lens.
        """
        x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
        if self.kind == "fisheye":
            across = np.hypot(x, y)
            theta = np.arctan2(across, z)
            scale = np.where(across > 1e-12, self._bent(theta) / np.maximum(across, 1e-12), 1.0)
            return np.stack([x * scale, y * scale], axis=-1)
        ahead = np.where(z > 0.0, z, np.nan)
        flat = np.stack([x / ahead, y / ahead], axis=-1)
        return flat if self.kind == "pinhole" else self._brown(flat)

    def undistort(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions of the rays that meet the picture there: the inverse of `distort`.

        NaN for places that no ray meets.
        """
        places = np.asarray(places, dtype=np.float64)
        across = np.linalg.norm(places, axis=-1)
        if self.kind == "fisheye":
            theta = _invert(self._bent, across, np.pi)
            along = places / np.maximum(across, 1e-12)[..., None]
            return np.concatenate([along * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)
        flat = places if self.kind == "pinhole" else self._flatten(places)
        rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def _bent(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the picture's middle of rays at an angle to the axis."""
        square, total = theta**2, np.zeros_like(theta)
        for coefficient in reversed(self.coefficients):
            total = (total + coefficient) * square
        return theta * (1.0 + total)

    def _brown(self, flat: NDArray[np.float64]) -> NDArray[np.float64]:
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = flat[..., 0], flat[..., 1]
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        bent_y = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=-1)

    def _flatten(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undo `_brown` by fixed-point steps; NaN where they do not settle."""
        flat = places.copy()
        for _ in range(_STEPS):
            flat = flat + places - self._brown(flat)
        settled = np.abs(self._brown(flat) - places).max(axis=-1, keepdims=True) < 1e-9
        return np.where(settled, flat, np.nan)


def _invert(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]], values: NDArray[np.float64], most: float
) -> NDArray[np.float64]:
    """Arguments from 0 to `most` at which a growing function has these values; NaN beyond it."""
    low, high = np.zeros_like(values), np.full_like(values, most)
    beyond = values > function(high)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        less = function(middle) < values
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    return np.where(beyond, np.nan, low)
