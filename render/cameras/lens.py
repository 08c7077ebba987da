"""Lenses: how a camera's picture departs from a pinhole's.

`brown` is Brown and Conrady's model in OpenCV's order (k1, k2, p1, p2, k3); `fisheye` is Kannala and Brandt's
(2006), OpenCV's `cv2.fisheye`: theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from handsim.errors import ArgumentError, choices

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

LensKind = Literal["pinhole", "brown", "fisheye"]
_COEFFICIENTS: Final[dict[str, int]] = {"pinhole": 0, "brown": 5, "fisheye": 4}
_NODES: Final = 1024  # of the table that a search begins in
_STEPS: Final = 12  # of Newton's method; three are enough away from a fold
_SETTLED: Final = 1e-12
_WIDEST: Final = 1e3  # [focal lengths] that a picture without a fold may reach: 89.94 degrees


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens and its coefficients.

    Where a lens's formula folds back (strong barrel distortion does), it means nothing: rays beyond are
    not seen, and no place in the picture is theirs.

    Raises:
        ArgumentError: There is no such lens, it has another number of coefficients, or they are not finite.
    """

    kind: LensKind = "pinhole"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in _COEFFICIENTS:
            raise ArgumentError(choices(self.kind, _COEFFICIENTS, noun="lens"))
        wanted = _COEFFICIENTS[self.kind]
        if len(self.coefficients) != wanted or not np.isfinite(self.coefficients).all():
            raise ArgumentError(
                f"a lens '{self.kind}' with coefficients {self.coefficients}, "
                f"expected {wanted} finite numbers"
            )

    def distort(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Where rays meet the picture at a distance of one focal length; x right, y down.

        Args:
            directions: In the camera's axes, z ahead. NaN comes of what the lens does not see: what lies
                behind a pinhole or a Brown lens, and what is beyond a fold.
        """
        x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
        if self.kind == "fisheye":
            across = np.hypot(x, y)
            theta = np.arctan2(across, z)
            theta = np.where(theta <= self._reach(), theta, np.nan)
            scale = np.where(across > 1e-12, self._bent(theta) / np.maximum(across, 1e-12), 1.0)
            return np.stack([x * scale, y * scale], axis=-1)
        ahead = np.where(z > 0.0, z, np.nan)
        flat = np.stack([x / ahead, y / ahead], axis=-1)
        if self.kind == "pinhole":
            return flat
        seen = (flat**2).sum(axis=-1, keepdims=True) <= self._reach() ** 2
        return self._brown(np.where(seen, flat, np.nan))

    def undistort(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions of the rays that meet the picture there: the inverse of `distort`.

        NaN for places that no ray meets.
        """
        places = np.asarray(places, dtype=np.float64)
        if self.kind == "fisheye":
            across = np.hypot(places[..., 0], places[..., 1])
            theta = self._straightened(across)
            along = places / np.maximum(across, 1e-12)[..., None]
            return np.concatenate([along * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)
        flat = places if self.kind == "pinhole" else self._flatten(places)
        rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    @property
    def _radial(self) -> tuple[float, ...]:
        """Coefficients of r^2, r^4.. in the factor on a ray's r: its angle or slope."""
        if self.kind == "brown":
            k1, k2, _, _, k3 = self.coefficients
            return k1, k2, k3
        return self.coefficients

    def _reach(self) -> float:
        """Largest r before the lens folds back: angle [rad] of a fisheye, slope of a Brown lens."""
        return _reach(self._radial, np.pi if self.kind == "fisheye" else _WIDEST)

    def _bent(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the picture's middle of rays at r."""
        return r * _polynomial(self._radial, r * r)

    def _straightened(self, across: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `_bent` up to the reach: from a table, then by Newton's method; NaN beyond."""
        most = self._reach()
        finite = across[np.isfinite(across)]
        longest = min(most, 1.0)
        while longest < most and self._bent(np.array(longest)) < finite.max(initial=0.0):
            longest = min(2.0 * longest, most)
        nodes = np.linspace(0.0, longest, _NODES)
        r = np.interp(across, self._bent(nodes), nodes)
        slopes = tuple((2 * n + 3) * k for n, k in enumerate(self._radial))
        for _ in range(_STEPS):
            slope = np.maximum(_polynomial(slopes, r * r), 1e-9)
            step = (self._bent(r) - across) / slope
            r = np.clip(r - step, 0.0, longest)
            if np.nanmax(np.abs(step), initial=0.0) < _SETTLED:
                break
        return np.where(across <= self._bent(np.array(longest)), r, np.nan)

    def _brown(self, flat: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = flat[..., 0], flat[..., 1]
        _, _, p1, p2, _ = self.coefficients
        square = x * x + y * y
        radial = _polynomial(self._radial, square)
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        bent_y = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=-1)

    def _flatten(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undo `_brown`: the radial part alone, then Newton's method in the plane; NaN where it fails."""
        across = np.hypot(places[..., 0], places[..., 1])
        _, _, p1, p2, _ = self.coefficients
        if p1 == 0.0 and p2 == 0.0:
            scale = self._straightened(across) / np.maximum(across, 1e-12)
            return places * np.where(across > 1e-12, scale, 1.0)[..., None]
        most = self._reach()
        edge = self._bent(np.array(most))
        start = np.minimum(across, edge * (1.0 - 1e-6))  # tangential terms reach a little farther
        flat = places * (self._straightened(start) / np.maximum(across, 1e-12))[..., None]
        for _ in range(_STEPS):
            step = self._newton(flat, places)
            flat = flat - step
            if np.nanmax(np.abs(step), initial=0.0) < _SETTLED:
                break
        square = (flat**2).sum(axis=-1)
        missed = np.abs(self._brown(flat) - places).max(axis=-1)
        good = (square <= most**2) & (missed < 1e-9 * np.maximum(1.0, across))
        return np.where(good[..., None], flat, np.nan)

    def _newton(self, flat: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far each place is from where `_brown` would meet its target, to first order."""
        x, y = flat[..., 0], flat[..., 1]
        k1, k2, p1, p2, k3 = self.coefficients
        square = x * x + y * y
        radial = _polynomial(self._radial, square)
        growth = 2.0 * (k1 + square * (2.0 * k2 + 3.0 * k3 * square))
        xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        xy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        determinant = np.maximum(xx * yy - xy * xy, 1e-6)
        miss = self._brown(flat) - places
        step_x = (yy * miss[..., 0] - xy * miss[..., 1]) / determinant
        step_y = (xx * miss[..., 1] - xy * miss[..., 0]) / determinant
        return np.clip(np.stack([step_x, step_y], axis=-1), -0.5, 0.5)


def _polynomial(coefficients: tuple[float, ...], square: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 + c0 s + c1 s^2.."""
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return 1.0 + total


@functools.lru_cache(maxsize=64)
def _reach(radial: tuple[float, ...], most: float) -> float:
    """First r at which r (1 + c0 r^2 + c1 r^4..) stops growing, at most `most`."""
    slopes = [(2 * n + 3) * k for n, k in enumerate(radial)]
    while slopes and abs(slopes[-1]) * most ** (2 * len(slopes)) < 1e-9:
        slopes.pop()  # they change nothing, and roots of tiny leading terms overflow
    roots = np.roots([*reversed(slopes), 1.0])
    folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)) & (roots.real > 0.0)]
    return min(float(np.sqrt(folds.min())), most) if len(folds) else most
