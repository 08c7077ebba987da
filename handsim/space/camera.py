"""`Camera`, a calibrated camera with its pose and its lens, and the cameras that come with the package.

A lens of kind `brown` is Brown and Conrady's model in OpenCV's order (k1, k2, p1, p2, k3); `fisheye` is
Kannala and Brandt's (2006), OpenCV's `cv2.fisheye`: theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4
theta^8).
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray

from handsim._checks import check_array, check_choice, check_type
from handsim.errors import ArgumentError, choices
from handsim.kernels import kernel
from handsim.space.transforms import are_rigid, rigid, unit

LensKind = Literal["pinhole", "brown", "fisheye"]
_COEFFICIENTS: Final[dict[str, int]] = {"pinhole": 0, "brown": 5, "fisheye": 4}
PINHOLE: Final = 0
"""The kind of a pinhole in `Lens.row`; a Brown lens is 1."""
_FISHEYE: Final = 2
_STEP: Final = 1e-5  # step of a Jacobian's central differences [focal lengths]
_STEPS: Final = 12  # most steps of Newton's method; three are enough away from a fold
_CONVERGED: Final = 1e-12  # [focal lengths] largest change of the last step
_MAX_TANGENT: Final = 1e3  # largest tangent of rays that a Brown lens without a fold sees: 89.94 degrees
_MAX_SIZE: Final = 8192  # largest width or height of a picture [px]
_NEAREST: Final = 1e-6  # [m] least depth of visible points


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens and its coefficients.

    Strong barrel distortion folds the picture back at some angle; rays beyond this fold have no image point.

    Raises:
        ArgumentError: The kind is unknown, or the number of coefficients is wrong, or one is not finite.
    """

    kind: LensKind = "pinhole"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_choice(self.kind, _COEFFICIENTS, noun="lens")
        check_type("coefficients", self.coefficients, (Sequence, np.ndarray), "a sequence of numbers")
        object.__setattr__(self, "coefficients", tuple(self.coefficients))
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
        return _distorted_points(self.row, directions)

    def jacobian(self, directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 2"]:
        """Derivatives of `distort` by x/z and y/z; NaN where the lens does not see."""
        rays = np.ascontiguousarray(directions, dtype=np.float64)
        jacobians = np.empty((*rays.shape[:-1], 2, 2))
        _distort_jacobians(self.row, rays.reshape(-1, 3), jacobians.reshape(-1, 4))
        return jacobians

    @property
    def row(self) -> Float[np.ndarray, "7"]:
        """The lens for compiled functions: its kind, five coefficients and the radius of its fold."""
        row = np.zeros(7)
        row[0], row[6] = list(_COEFFICIENTS).index(self.kind), self._fold_radius()
        row[1 : 1 + len(self.coefficients)] = self.coefficients
        return row

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
        return unit(rays)

    @property
    def _radial(self) -> tuple[float, ...]:
        """Coefficients of r^2, r^4, ... in the factor on a ray's r: angle (fisheye) or tangent (Brown)."""
        if self.kind == "brown":
            k1, k2, _, _, k3 = self.coefficients
            return k1, k2, k3
        return self.coefficients

    def _fold_radius(self) -> float:
        """Largest r before the lens folds back: angle [rad] of a fisheye, tangent of a Brown lens."""
        return _fold_radius(self._radial, np.pi if self.kind == "fisheye" else _MAX_TANGENT)

    def _distorted(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the principal point of rays at r."""
        return r * _polynomial(self._radial, r * r)

    def _undistorted(self, across: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `_distorted` by Newton's method, starting from a table; NaN beyond the fold."""
        most = self._fold_radius()
        finite = across[np.isfinite(across)]
        longest = min(most, 1.0)
        while longest < most and self._distorted(np.array(longest)) < finite.max(initial=0.0):
            longest = min(2.0 * longest, most)
        # Newton's method starts from a table of these nodes.
        nodes = np.linspace(0.0, longest, 1024)
        r = np.interp(across, self._distorted(nodes), nodes)
        derivative = tuple((2 * n + 3) * k for n, k in enumerate(self._radial))
        for _ in range(_STEPS):
            rate = np.maximum(_polynomial(derivative, r * r), 1e-9)
            step = (self._distorted(r) - across) / rate
            r = np.clip(r - step, 0.0, longest)
            if np.nanmax(np.abs(step), initial=0.0) < _CONVERGED:
                break
        return np.where(across <= self._distorted(np.array(longest)), r, np.nan)

    def _brown(self, flat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image points (*batch, 2) of tangents, beyond the fold too."""
        row = self.row
        row[6] = np.inf
        return _distorted_points(row, np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1))

    def _undistort_brown(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `_brown` by Newton's method, starting from its radial part; NaN where it fails."""
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
            if np.nanmax(np.abs(step), initial=0.0) < _CONVERGED:
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
    """The image point of a ray in the axes of the camera [focal lengths]; NaN if the lens does not see it."""
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


def _distorted_points(row: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image points of rays by a row of `Lens.row` [focal lengths]."""
    rays = np.ascontiguousarray(directions, dtype=np.float64)
    points = np.empty((*rays.shape[:-1], 2))
    _distort_rays(row, rays.reshape(-1, 3), points.reshape(-1, 2))
    return points


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
        derivative.pop()  # roots of tiny leading terms overflow
    roots = np.roots([*reversed(derivative), 1.0])
    folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)) & (roots.real > 0.0)]
    return min(float(np.sqrt(folds.min())), most) if len(folds) else most


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera, OpenCV axes: x right, y down, z into the picture.

    Pixel coordinates start at the picture's corner, so the center of the first pixel is at (0.5, 0.5); those
    of OpenCV and MuJoCo start at this center. Cameras are equal if all their numbers are equal.

    Raises:
        ArgumentError: The size is out of range, `K` is not a camera matrix, or the pose is not rigid.
    """

    name: str
    size: tuple[int, int]
    """Width and height [px]."""
    K: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point [px]."""
    T_world_camera: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Pose in the world [m]."""
    lens: Lens = field(default_factory=Lens)
    """A lens, or its fields as `record` has them."""

    def __post_init__(self) -> None:
        if isinstance(self.lens, Mapping):
            if set(self.lens) != {"kind", "coefficients"}:
                given = ", ".join(map(str, self.lens)) or "none"
                raise ArgumentError(f"a lens with the fields {given}, expected kind, coefficients")
            object.__setattr__(self, "lens", Lens(**self.lens))
        check_type("lens", self.lens, Lens, "a Lens, or its fields")
        object.__setattr__(self, "K", check_array("K", self.K, (3, 3)))
        object.__setattr__(self, "T_world_camera", check_array("T_world_camera", self.T_world_camera, (4, 4)))
        sides = np.asarray(self.size)
        whole = sides.shape == (2,) and sides.dtype.kind in "iuf" and (sides == np.floor(sides)).all()
        if not whole or sides.min() < 1 or sides.max() > _MAX_SIZE:
            raise ArgumentError(
                f"camera '{self.name}': size is {self.size}, expected width and height, 1 to {_MAX_SIZE} "
                "whole pixels each"
            )
        object.__setattr__(self, "size", (int(sides[0]), int(sides[1])))
        fx, fy, cx, cy = self.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        if not min(fx, fy) > 0.0 or not np.array_equal(self.K, camera_matrix(fx, fy, cx, cy)):
            raise ArgumentError(
                f"camera '{self.name}': K is not a matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] "
                f"with positive fx and fy: {self.K.tolist()}"
            )
        if not are_rigid(self.T_world_camera):
            raise ArgumentError(f"camera '{self.name}': T_world_camera is not a rigid transform")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and self.record() == other.record()

    def __hash__(self) -> int:
        numbers = (*self.K.ravel().tolist(), *self.T_world_camera.ravel().tolist())
        return hash((self.name, self.size, self.lens, numbers))

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths along x and y [px]."""
        return float(self.K[0, 0]), float(self.K[1, 1])

    @property
    def focal_length(self) -> float:
        """Geometric mean of the focal lengths [px]."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def angles(self) -> tuple[float, float]:
        """Fields of view across the picture's width and height, without the lens [rad]."""
        (width, height), (fx, fy), (cx, cy) = self.size, self.focal_lengths, self.K[:2, 2]
        across = np.arctan2(cx, fx) + np.arctan2(width - cx, fx)
        return float(across), float(np.arctan2(cy, fy) + np.arctan2(height - cy, fy))

    def at(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Camera:
        """The same camera with another pose [m]."""
        return dataclasses.replace(self, T_world_camera=T_world_camera)

    def part(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a part of the picture [px]."""
        K = self.K.copy()
        K[:2, 2] -= left, top
        return dataclasses.replace(self, size=(width, height), K=K)

    def local(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points in the camera's axes [m]."""
        return np.asarray((points - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3])

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of world points [m], inside the picture or not [px]; NaN where the lens does not see."""
        normalized = self.lens.distort(self.local(points))
        return np.asarray(normalized * self.K[[0, 1], [0, 1]] + self.K[:2, 2])

    def unproject(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions of pixels [px] in the camera's axes; NaN for pixels without a ray."""
        return self.lens.undistort((pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]])

    def in_view(self, points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        """Whether world points [m] are in front of the camera and, through its lens, inside its picture."""
        return points_in_view(camera_arrays((self,)), points)[..., 0]

    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """Unit directions in the camera's axes through the centers of all pixels."""
        width, height = self.size
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return self.unproject(np.stack([columns, rows], axis=-1))

    def record(self) -> dict[str, Any]:
        """The camera as a JSON record, of which `Camera(**record)` is the camera again."""
        return {
            "name": self.name,
            "size": list(self.size),
            "K": self.K.tolist(),
            "T_world_camera": self.T_world_camera.tolist(),
            "lens": {"kind": self.lens.kind, "coefficients": list(self.lens.coefficients)},
        }


def brown_lens(*coefficients: float) -> Lens:
    """OpenCV's lens of k1, k2, p1, p2 and k3; a pinhole where all are zero."""
    return Lens("brown", coefficients) if any(coefficients) else Lens()


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """K of focal lengths and a principal point [px]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pinhole(
    name: str, size: tuple[int, int], focal: float, center: tuple[float, float] | None = None
) -> Camera:
    """A camera without distortion."""
    x, y = (size[0] / 2, size[1] / 2) if center is None else center
    return Camera(name, size, camera_matrix(focal, focal, x, y))


def look_at(position: ArrayLike, target: ArrayLike) -> Float[np.ndarray, "4 4"]:
    """`T_world_camera` of a camera at a position (3,) [m] that looks at a target (3,) [m], upright (world z).

    Raises:
        ArgumentError: One of them is not a point, or they are equal.
    """
    position, target = check_array("position", position, (3,)), check_array("target", target, (3,))
    distance = np.linalg.norm(target - position)
    if distance == 0.0:
        raise ArgumentError(f"target is the position, {position}, expected another point to look at")
    forward = (target - position) / distance
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return rigid(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def focal_of_angle(length: float, angle: float) -> float:
    """The focal length [px] at which `length` pixels span an angle [rad]."""
    return float(length / 2 / np.tan(angle / 2))


class CameraArrays(NamedTuple):
    """C cameras for compiled functions."""

    T_world_camera: Float[np.ndarray, "C 4 4"]
    intrinsics: Float[np.ndarray, "C 4"]
    """Focal lengths along x and y and the principal point [px]."""
    sizes: Float[np.ndarray, "C 2"]
    """Width and height [px]."""
    lenses: Float[np.ndarray, "C 7"]
    """`Lens.row` of each camera."""


def camera_arrays(cameras: Sequence[Camera]) -> CameraArrays:
    """The arrays of some cameras."""
    return CameraArrays(
        np.stack([one.T_world_camera for one in cameras]),
        np.stack([one.K[[0, 1, 0, 1], [0, 1, 2, 2]] for one in cameras]),
        np.array([one.size for one in cameras], dtype=np.float64),
        np.stack([one.lens.row for one in cameras]),
    )


def points_in_view(
    cameras: CameraArrays, points: Float[np.ndarray, "*batch 3"]
) -> Bool[np.ndarray, "*batch C"]:
    """Whether each world point [m] is in front of each camera and inside its picture."""
    flat = np.ascontiguousarray(points, dtype=np.float64)
    seen = np.empty((*flat.shape[:-1], len(cameras.sizes)), dtype=np.bool_)
    _points_in_view(cameras, flat.reshape(-1, 3), seen.reshape(-1, len(cameras.sizes)))
    return seen


@kernel(inline=True)
def in_picture(inner: Any, size: Any, lens: Any, x: float, y: float, z: float) -> bool:
    """Whether a point (x, y, z) [m] in a camera's axes is inside its picture."""
    u, v = x / z, y / z
    if lens[0] != PINHOLE:  # a pinhole avoids this slow call
        u, v = distort_ray(lens, x, y, z)
    u, v = u * inner[0] + inner[2], v * inner[1] + inner[3]
    inside = (u >= 0.0) & (u < size[0]) & (v >= 0.0) & (v < size[1])  # never so for NaN
    return bool((z > _NEAREST) & inside)


@kernel
def _points_in_view(cameras: Any, points: Any, seen: Any) -> None:
    for c in range(len(cameras.sizes)):
        pose, inner = cameras.T_world_camera[c], cameras.intrinsics[c]
        size, lens = cameras.sizes[c], cameras.lenses[c]
        for n in range(len(points)):
            x, y, z = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
            seen[n, c] = in_picture(
                inner, size, lens,
                pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
                pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
                pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
            )  # fmt: skip


_PRESETS: Final = (
    pinhole("vga", (640, 480), 600.0),
    pinhole("vga_wide", (640, 480), 380.0),
    # Intel RealSense SR300 as in BigHand2.2M and HANDS17, Microsoft Kinect v2's and Azure Kinect's (NFOV)
    # depth and Intel RealSense D435 as their makers state them: fields of view, rounded.
    pinhole("sr300", (640, 480), 475.07, (315.94, 245.29)),
    pinhole("kinect2", (512, 424), 365.0),
    pinhole("azure_kinect", (640, 576), 504.0),
    pinhole("d435", (848, 480), 425.0),
    dataclasses.replace(
        pinhole("headset_fisheye", (640, 480), 240.0), lens=Lens("fisheye", (0.02, -0.006, 0.0, 0.0))
    ),
)
PRESETS: Final = {camera.name: camera for camera in _PRESETS}
"""Cameras that come with the package, by name. Each stands at the origin of the world."""


def preset(name: str) -> Camera:
    """A copy of one of `PRESETS`."""
    if name not in PRESETS:
        own = "or cameras of your own: --cameras FILE, in Python a Camera"
        raise ArgumentError(f"{choices(name, PRESETS, noun='camera')}, {own}")
    return copy.deepcopy(PRESETS[name])
