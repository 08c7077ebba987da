"""Lens models: how a camera's picture differs from a pinhole camera's.

`brown` is Brown and Conrady's model in OpenCV's order (k1, k2, p1, p2, k3); `fisheye` is Kannala and Brandt's
(2006), OpenCV's `cv2.fisheye`: theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import ArgumentError
from handsim.kernels import kernel

LensKind = Literal["pinhole", "brown", "fisheye"]
_COEFFICIENTS: Final[dict[str, int]] = {"pinhole": 0, "brown": 5, "fisheye": 4}
PINHOLE: Final = 0
"""The kind of a pinhole in `Lens.row`; a Brown lens is 1."""
_FISHEYE: Final = 2
_STEP: Final = 1e-5  # [focal lengths] of the central differences of a Jacobian
_NODES: Final = 1024  # of the table that starts the search
_STEPS: Final = 12  # of Newton's method; three are enough away from a fold
_SETTLED: Final = 1e-12
_WIDEST: Final = 1e3  # [focal lengths] that a picture without a fold may extend to: 89.94 degrees


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens and its coefficients.

    Where a lens's formula folds back, as with strong barrel distortion, it is not valid: rays beyond the fold
    have no image point.

    Raises:
        ArgumentError: The kind is unknown, or the number of coefficients is wrong, or one is not finite.
    """

    kind: LensKind = "pinhole"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_choice(self.kind, _COEFFICIENTS, noun="lens")
        expected = _COEFFICIENTS[self.kind]
        if len(self.coefficients) != expected or not np.isfinite(self.coefficients).all():
            raise ArgumentError(
                f"a lens '{self.kind}' with coefficients {self.coefficients}, "
                f"expected {expected} finite numbers"
            )

    def distort(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Image points of rays, in focal lengths from the principal point; x right, y down.

        Args:
            directions: In the camera's axes, z ahead; of any length.

        Returns:
            NaN for directions that the lens does not see: behind a pinhole or Brown lens, and beyond a fold.
        """
        return self._image_points(directions, self.row)

    def jacobian(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 2"]:
        """How far image points move per tangent of their rays: derivatives of `distort` by x/z and y/z.

        The identity for a pinhole; NaN where the lens does not see.
        """
        rays = np.ascontiguousarray(directions, dtype=np.float64)
        jacobians = np.empty((*rays.shape[:-1], 2, 2))
        _distort_jacobians(self.row, rays.reshape(-1, 3), jacobians.reshape(-1, 4))
        return jacobians

    @property
    def row(self) -> Float[np.ndarray, "7"]:
        """The lens as compiled functions take it: its kind, five coefficients and the radius of its fold."""
        row = np.zeros(7)
        row[0], row[6] = list(_COEFFICIENTS).index(self.kind), self._fold_radius()
        row[1 : 1 + len(self.coefficients)] = self.coefficients
        return row

    def _image_points(self, directions: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = np.ascontiguousarray(directions, dtype=np.float64)
        points = np.empty((*rays.shape[:-1], 2))
        _distort_rays(row, rays.reshape(-1, 3), points.reshape(-1, 2))
        return points

    def undistort(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions of the rays of image points, inverse of `distort`; NaN where there is no ray."""
        points = np.asarray(points, dtype=np.float64)
        if self.kind == "fisheye":
            across = np.hypot(points[..., 0], points[..., 1])
            theta = self._undistorted(across)
            along = points / np.maximum(across, 1e-12)[..., None]
            return np.concatenate([along * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)
        flat = points if self.kind == "pinhole" else self._undistort_brown(points)
        rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    @property
    def _radial(self) -> tuple[float, ...]:
        """Coefficients of r^2, r^4, ... in the factor on a ray's r: angle (fisheye) or tangent (Brown)."""
        if self.kind == "brown":
            k1, k2, _, _, k3 = self.coefficients
            return k1, k2, k3
        return self.coefficients

    def _fold_radius(self) -> float:
        """Largest r before the lens folds back: angle [rad] of a fisheye, tangent of a Brown lens."""
        return _fold_radius(self._radial, np.pi if self.kind == "fisheye" else _WIDEST)

    def _distorted(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the principal point of rays at r."""
        return r * _polynomial(self._radial, r * r)

    def _undistorted(self, across: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `_distorted` up to the fold: from a table, then by Newton's method; NaN beyond."""
        most = self._fold_radius()
        finite = across[np.isfinite(across)]
        longest = min(most, 1.0)
        while longest < most and self._distorted(np.array(longest)) < finite.max(initial=0.0):
            longest = min(2.0 * longest, most)
        nodes = np.linspace(0.0, longest, _NODES)
        r = np.interp(across, self._distorted(nodes), nodes)
        derivative = tuple((2 * n + 3) * k for n, k in enumerate(self._radial))
        for _ in range(_STEPS):
            rate = np.maximum(_polynomial(derivative, r * r), 1e-9)
            step = (self._distorted(r) - across) / rate
            r = np.clip(r - step, 0.0, longest)
            if np.nanmax(np.abs(step), initial=0.0) < _SETTLED:
                break
        return np.where(across <= self._distorted(np.array(longest)), r, np.nan)

    def _brown(self, flat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image points (*batch, 2) of tangents, beyond the fold too."""
        row = self.row
        row[6] = np.inf
        return self._image_points(np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1), row)

    def _undistort_brown(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `_brown`: its radial part, then Newton's method in the plane; NaN where it fails."""
        across = np.hypot(points[..., 0], points[..., 1])
        _, _, p1, p2, _ = self.coefficients
        if p1 == 0.0 and p2 == 0.0:
            scale = self._undistorted(across) / np.maximum(across, 1e-12)
            return points * np.where(across > 1e-12, scale, 1.0)[..., None]
        most = self._fold_radius()
        edge = self._distorted(np.array(most))
        start = np.minimum(across, edge * (1.0 - 1e-6))  # tangential terms extend a little farther
        flat = points * (self._undistorted(start) / np.maximum(across, 1e-12))[..., None]
        for _ in range(_STEPS):
            step = self._newton_step(flat, points)
            flat = flat - step
            if np.nanmax(np.abs(step), initial=0.0) < _SETTLED:
                break
        square = (flat**2).sum(axis=-1)
        residual = np.abs(self._brown(flat) - points).max(axis=-1)
        good = (square <= most**2) & (residual < 1e-9 * np.maximum(1.0, across))
        return np.where(good[..., None], flat, np.nan)

    def _newton_step(self, flat: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Newton steps (*batch, 2) towards the points that `_brown` maps to `points`, clipped to 0.5."""
        x, y = flat[..., 0], flat[..., 1]
        k1, k2, p1, p2, k3 = self.coefficients
        square = x * x + y * y
        radial = _polynomial(self._radial, square)
        growth = 2.0 * (k1 + square * (2.0 * k2 + 3.0 * k3 * square))
        xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        xy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        determinant = np.maximum(xx * yy - xy * xy, 1e-6)
        residual = self._brown(flat) - points
        step_x = (yy * residual[..., 0] - xy * residual[..., 1]) / determinant
        step_y = (xx * residual[..., 1] - xy * residual[..., 0]) / determinant
        return np.clip(np.stack([step_x, step_y], axis=-1), -0.5, 0.5)


@kernel
def distort_ray(lens: Any, x: float, y: float, z: float) -> tuple[float, float]:
    """The image point of a ray in the axes of the camera [focal lengths]; NaN if the lens sees it not."""
    if lens[0] == _FISHEYE:
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        if not theta <= lens[6]:
            return np.nan, np.nan
        square = theta * theta
        radial = 1.0 + (((lens[4] * square + lens[3]) * square + lens[2]) * square + lens[1]) * square
        scale = theta * radial / across if across > 1e-12 else 1.0
        return x * scale, y * scale
    if not z > 0.0:
        return np.nan, np.nan
    u, v = x / z, y / z
    if lens[0] == PINHOLE:
        return u, v
    square = u * u + v * v
    if not square <= lens[6] * lens[6]:
        return np.nan, np.nan
    radial = 1.0 + ((lens[5] * square + lens[2]) * square + lens[1]) * square
    p1, p2 = lens[3], lens[4]
    return (
        u * radial + 2.0 * p1 * u * v + p2 * (square + 2.0 * u * u),
        v * radial + p1 * (square + 2.0 * v * v) + 2.0 * p2 * u * v,
    )


@kernel
def distort_jacobian(lens: Any, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Derivatives of one ray's image point by x/z and y/z, row by row; see `distort_ray`."""
    if lens[0] == PINHOLE:
        return 1.0, 0.0, 0.0, 1.0
    if not z > 0.0:
        return np.nan, np.nan, np.nan, np.nan
    u, v = x / z, y / z
    right, left = distort_ray(lens, u + _STEP, v, 1.0), distort_ray(lens, u - _STEP, v, 1.0)
    below, above = distort_ray(lens, u, v + _STEP, 1.0), distort_ray(lens, u, v - _STEP, 1.0)
    width = 2.0 * _STEP
    return (
        (right[0] - left[0]) / width,
        (below[0] - above[0]) / width,
        (right[1] - left[1]) / width,
        (below[1] - above[1]) / width,
    )


@kernel
def _distort_rays(lens: Any, rays: Any, points: Any) -> None:
    for n in range(len(rays)):
        points[n, 0], points[n, 1] = distort_ray(lens, rays[n, 0], rays[n, 1], rays[n, 2])


@kernel
def _distort_jacobians(lens: Any, rays: Any, jacobians: Any) -> None:
    for n in range(len(rays)):
        jacobians[n] = distort_jacobian(lens, rays[n, 0], rays[n, 1], rays[n, 2])


def _polynomial(coefficients: tuple[float, ...], square: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 + c0 s + c1 s^2 + ..."""
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return 1.0 + total


@functools.lru_cache(maxsize=64)
def _fold_radius(radial: tuple[float, ...], most: float) -> float:
    """First r at which r (1 + c0 r^2 + c1 r^4 + ...) stops growing, at most `most`."""
    derivative = [(2 * n + 3) * k for n, k in enumerate(radial)]
    while derivative and abs(derivative[-1]) * most ** (2 * len(derivative)) < 1e-9:
        derivative.pop()  # they change nothing, and roots of tiny leading terms overflow
    roots = np.roots([*reversed(derivative), 1.0])
    folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)) & (roots.real > 0.0)]
    return min(float(np.sqrt(folds.min())), most) if len(folds) else most
