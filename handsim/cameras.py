"""Cameras around the hand: where they stand, where they look, how wide they see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from handsim._checks import check_array
from handsim.errors import ShapeError, choices

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

MAX_CAMERAS: Final = 32
"""A marker's visibility is one bit a camera in 32 bits."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraRig:
    """Calibrated cameras, OpenCV axes: x right, y down, z into the picture."""

    name: str
    T_world_camera: Float[np.ndarray, "C 4 4"]
    """Pose of each camera in the world [m]."""
    field_of_view: float
    """Full opening angle of the round view cone [rad]."""

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "T_world_camera", check_array("T_world_camera", self.T_world_camera, (None, 4, 4))
        )
        count = len(self.T_world_camera)
        if not 2 <= count <= MAX_CAMERAS:
            raise ShapeError(f"rig '{self.name}' has {count} cameras, wanted 2 to {MAX_CAMERAS}")

    @property
    def positions(self) -> Float[np.ndarray, "C 3"]:
        """Optical centres in the world [m]."""
        return self.T_world_camera[:, :3, 3]

    def in_view(self, points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch C"]:
        """Which cameras have each point inside their view cone."""
        rays = points[..., None, :] - self.positions
        ahead = np.einsum("...ci,ci->...c", rays, self.T_world_camera[:, :3, 2])
        inside: NDArray[np.bool_] = ahead >= np.cos(self.field_of_view / 2) * np.linalg.norm(rays, axis=-1)
        return inside


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a camera at `position` that looks at `target` and holds its picture upright (world z)."""
    forward = (target - position) / np.linalg.norm(target - position)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def _frame_rig(name: str, places: list[tuple[float, float, float]]) -> CameraRig:
    centre = np.array([0.0, 0.0, 1.1])
    poses = np.stack([look_at(np.array(place), centre) for place in places])
    return CameraRig(name, poses, field_of_view=np.deg2rad(60.0))


def _figure5() -> CameraRig:
    # Han et al. 2018, Figure 5: sixteen cameras on a rectangular frame around the seated user. Here ten stand
    # along the top of a 2.4 x 1.8 m frame, and six lower ones look in from the corners and the long sides.
    top = [
        (x, y, 2.2)
        for x, y in (
            (-1.2, -0.9), (-0.6, -0.9), (0.6, -0.9), (1.2, -0.9), (-1.2, 0.0),
            (1.2, 0.0), (-1.2, 0.9), (-0.6, 0.9), (0.6, 0.9), (1.2, 0.9),
        )
    ]  # fmt: skip
    low = [
        (x, y, 0.7) for x, y in ((-1.2, -0.9), (1.2, -0.9), (-1.2, 0.9), (1.2, 0.9), (0.0, -0.9), (0.0, 0.9))
    ]
    return _frame_rig("figure5", top + low)


_RIGS: Final = {"figure5": _figure5}


def named_rig(name: str) -> CameraRig:
    """A rig by name: `figure5`, the sixteen cameras of the paper's Figure 5."""
    if name not in _RIGS:
        raise ShapeError(choices(name, _RIGS, noun="camera rig"))
    return _RIGS[name]()
