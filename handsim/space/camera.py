"""`Camera`, a calibrated camera with its pose and its lens, and the cameras that come with the package."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array
from handsim.errors import ArgumentError, choices
from handsim.space.lens import Lens

_LARGEST: Final = 8192  # [px]


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera, OpenCV axes: x right, y down, z into the picture.

    Pixel coordinates go right and down from the picture's corner, so that the first pixel's center is at
    (0.5, 0.5); OpenCV's and MuJoCo's own counts begin half a pixel later.

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", check_array("K", self.K, (3, 3)))
        object.__setattr__(self, "T_world_camera", check_array("T_world_camera", self.T_world_camera, (4, 4)))
        if not all(1 <= length <= _LARGEST for length in self.size):
            raise ArgumentError(
                f"camera '{self.name}' has pictures of {self.size[0]} x {self.size[1]} pixels, "
                f"expected 1 to {_LARGEST} each way"
            )
        rest = self.K.copy()
        rest[0, 0] = rest[1, 1] = rest[0, 2] = rest[1, 2] = 0.0
        if not (self.K[0, 0] > 0.0 and self.K[1, 1] > 0.0) or np.abs(rest - np.diag([0, 0, 1])).max() > 0.0:
            raise ArgumentError(
                f"camera '{self.name}': K is not a matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        rotation = self.T_world_camera[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-5 or np.linalg.det(rotation) < 0.0:
            raise ArgumentError(f"camera '{self.name}': T_world_camera is not a rigid transform")

    def at(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Camera:
        """The same camera with another pose [m]."""
        return dataclasses.replace(self, T_world_camera=T_world_camera)

    def local(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points in the camera's axes [m]."""
        local: NDArray[np.float64] = (points - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3]
        return local

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of world points [m], inside the picture or not [px]; NaN for what the lens cannot see."""
        normalized = self.lens.distort(self.local(points))
        pixels: NDArray[np.float64] = normalized * self.K[[0, 1], [0, 1]] + self.K[:2, 2]
        return pixels

    def rays(self) -> Float[np.ndarray, "H W 3"]:
        """Unit directions in the camera's axes through the centers of all pixels."""
        width, height = self.size
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        normalized = (np.stack([columns, rows], axis=-1) - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        return self.lens.undistort(normalized)

    def record(self) -> dict[str, Any]:
        """The camera as a JSON record."""
        return {
            "name": self.name,
            "size": list(self.size),
            "K": self.K.tolist(),
            "T_world_camera": self.T_world_camera.tolist(),
            "lens": {"kind": self.lens.kind, "coefficients": list(self.lens.coefficients)},
        }


def pinhole(
    name: str, size: tuple[int, int], focal: float, center: tuple[float, float] | None = None
) -> Camera:
    """A camera without distortion.

    Args:
        name: Its name.
        size: Width and height [px].
        focal: Focal length [px].
        center: Principal point [px]; the picture's center when not given.
    """
    x, y = (size[0] / 2, size[1] / 2) if center is None else center
    return Camera(name, size, np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]]))


def camera_from_record(record: dict[str, Any]) -> Camera:
    """The camera of a record of `Camera.record`."""
    lens = Lens(record["lens"]["kind"], tuple(record["lens"]["coefficients"]))
    size = int(record["size"][0]), int(record["size"][1])
    return Camera(record["name"], size, np.array(record["K"]), np.array(record["T_world_camera"]), lens)


def _presets() -> dict[str, Camera]:
    return {
        "vga": pinhole("vga", (640, 480), 600.0),
        "vga_wide": pinhole("vga_wide", (640, 480), 380.0),
        # Intel RealSense SR300 as in BigHand2.2M and HANDS17, Microsoft Kinect v2's and Azure Kinect's (NFOV)
        # depth and Intel RealSense D435 as their makers state them: fields of view, rounded.
        "sr300": pinhole("sr300", (640, 480), 475.07, (315.94, 245.29)),
        "kinect2": pinhole("kinect2", (512, 424), 365.0),
        "azure_kinect": pinhole("azure_kinect", (640, 576), 504.0),
        "d435": pinhole("d435", (848, 480), 425.0),
        "headset_fisheye": Camera(
            "headset_fisheye",
            (640, 480),
            np.array([[240.0, 0.0, 320.0], [0.0, 240.0, 240.0], [0.0, 0.0, 1.0]]),
            lens=Lens("fisheye", (0.02, -0.006, 0.0, 0.0)),
        ),
    }


PRESETS: Final = tuple(_presets())


def preset(name: str) -> Camera:
    """One of the cameras that come with the package, at the world's origin.

    Raises:
        ArgumentError: There is no camera of that name.
    """
    cameras = _presets()
    if name not in cameras:
        raise ArgumentError(choices(name, cameras, noun="camera"))
    return cameras[name]
