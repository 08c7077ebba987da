"""Camera rigs: poses, field of view and resolution of the cameras around the hand, by name or from a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_array, check_type
from handsim.errors import ArgumentError, RigError, choices
from handsim.files.atomic import atomic_write
from handsim.space.rig_file import read_rig_file, rig_lines

FEWEST_CAMERAS: Final = 2
MAX_CAMERAS: Final = 32
"""A marker's visibility is one bit per camera in 32 bits."""
ROOM_CENTER: Final = (0.0, 0.0, 1.1)
"""Middle of the space that hands move in, in front of a seated user [m]."""
HAND_REACH: Final = 0.25
"""No hand reaches further from its wrist [m]; cameras stand at least this far from the wrists' volume."""
_WIDEST: Final = 170.0  # [deg]
_FARTHEST: Final = 50.0  # [m]
_APART: Final = 1e-3  # [m]
_SHIPPED: Final = Path(__file__).parents[1] / "rigs"


@dataclass(frozen=True, slots=True, eq=False)
class CameraRig:
    """Calibrated cameras, OpenCV axes: x right, y down, z into the picture.

    Messages count cameras from 1, in the order given.

    Raises:
        ArgumentError: `T_world_camera` is not (C, 4, 4) or not finite.
        RigError: Too few or too many cameras, two at one position, a pose that is not rigid or lies beyond
            50 m, or a field of view or resolution that no camera has.
    """

    name: str
    T_world_camera: Float[np.ndarray, "C 4 4"]
    """Pose of each camera in the world [m]."""
    field_of_view: float
    """Full opening angle of the round view cone [rad]."""
    resolution: int = 1280
    """Pixels across the field of view."""

    def __post_init__(self) -> None:
        poses = check_array("T_world_camera", self.T_world_camera, (None, 4, 4))
        object.__setattr__(self, "T_world_camera", poses)
        if not FEWEST_CAMERAS <= len(poses) <= MAX_CAMERAS:
            raise RigError(
                f"rig '{self.name}' has {len(poses)} cameras, expected {FEWEST_CAMERAS} to {MAX_CAMERAS}"
            )
        degrees = np.rad2deg(self.field_of_view)
        if not 1.0 <= degrees <= _WIDEST:
            raise RigError(
                f"rig '{self.name}': field_of_view is {degrees:g} degrees, expected 1 to {_WIDEST:g}"
            )
        if not 16 <= self.resolution <= 65536:
            raise RigError(f"rig '{self.name}': resolution is {self.resolution} pixels, expected 16 to 65536")
        for number, pose in enumerate(poses, 1):
            _check_pose(f"camera {number} of rig '{self.name}'", pose)
        _check_apart(self.name, self.positions)

    @property
    def positions(self) -> Float[np.ndarray, "C 3"]:
        """Optical centers in the world [m]."""
        return self.T_world_camera[:, :3, 3]

    @property
    def focal_length(self) -> float:
        """Focal length of every camera [px]."""
        return float(self.resolution / 2 / np.tan(self.field_of_view / 2))

    def in_view(self, points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch C"]:
        """Which cameras have each point [m], in the world, inside their view cone."""
        rays = points[..., None, :] - self.positions
        ahead = np.einsum("...ci,ci->...c", rays, self.T_world_camera[:, :3, 2])
        inside: NDArray[np.bool_] = ahead >= np.cos(self.field_of_view / 2) * np.linalg.norm(rays, axis=-1)
        return inside

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch C 2"]:
        """Pixel of each point [m] in each camera [px], right and down from the picture's center.

        NaN for points that are not in front of the camera. Points outside the view cone are projected too;
        `in_view` tells them apart.
        """
        rays = points[..., None, :] - self.positions
        x, y, depth = np.moveaxis(np.einsum("...ci,cij->...cj", rays, self.T_world_camera[:, :3, :3]), -1, 0)
        scale = self.focal_length / np.where(depth > 0.0, depth, np.nan)
        pixels: NDArray[np.float64] = np.stack([x * scale, y * scale], axis=-1)
        return pixels


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """`T_world_camera` of a camera at `position` [m] that looks at `target` [m], upright (world z)."""
    forward = (target - position) / np.linalg.norm(target - position)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def list_rigs() -> tuple[str, ...]:
    """Names of the rigs that come with the package."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def named_rig(name: str) -> CameraRig:
    """A rig that comes with the package: `figure5` (sixteen cameras, as in the paper), `eight` or `six`.

    Raises:
        ArgumentError: There is no rig of that name.
    """
    if name not in list_rigs():
        raise ArgumentError(choices(name, list_rigs(), noun="camera rig"))
    return _read(_SHIPPED / f"{name}.toml")


def rig_description(name: str) -> str:
    """What a rig that comes with the package is, in one sentence.

    Raises:
        ArgumentError: There is no rig of that name.
    """
    if name not in list_rigs():
        raise ArgumentError(choices(name, list_rigs(), noun="camera rig"))
    return read_rig_file(_SHIPPED / f"{name}.toml").description


def load_rig(rig: CameraRig | str | Path) -> CameraRig:
    """A shipped rig by its name, or your own by the path of its `.toml` file; a rig as it is.

    The format of the file is in docs/rigs.md.

    Args:
        rig: A rig; `figure5` (sixteen cameras, as in the paper), `eight`, `six`; or a path.

    Returns:
        The rig with its camera poses (C, 4, 4) [m], field of view [rad] and resolution [px].

    Raises:
        ArgumentError: It is none of these.
        RigError: No such rig or file, or the file does not describe one; the sentence names the file.
    """
    if isinstance(rig, CameraRig):
        return rig
    check_type("rig", rig, (str, Path), "a CameraRig, or the name or path of one", list_rigs())
    if str(rig) in list_rigs():
        return named_rig(str(rig))
    path = Path(rig)
    if path.suffix.lower() != ".toml":
        unknown = choices(str(rig), list_rigs(), noun="camera rig")
        raise RigError(f"{unknown}, or the path of a .toml file")
    return _read(path)


def save_rig(path: Path, rig: CameraRig) -> None:
    """Write a rig's `.toml` file, numbers to nine decimals; `load_rig` gives the same cameras again.

    Raises:
        OSError: The file cannot be written.
    """
    degrees = float(np.rad2deg(rig.field_of_view))
    lines = rig_lines(rig.name, degrees, rig.resolution, rig.T_world_camera)
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _read(path: Path) -> CameraRig:
    table = read_rig_file(path)
    try:
        poses = [
            aimed(f"camera {number}", *camera) if isinstance(camera, tuple) else camera
            for number, camera in enumerate(table.cameras, 1)
        ]
        if not poses:
            raise RigError(f"rig '{table.name}' has 0 cameras, expected {FEWEST_CAMERAS} to {MAX_CAMERAS}")
        return CameraRig(table.name, np.stack(poses), np.deg2rad(table.field_of_view), table.resolution)
    except RigError as error:
        raise RigError(f"{path}: {error}") from error


def aimed(
    owner: str, position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> NDArray[np.float64]:
    """`look_at` [m] for a camera of a file.

    Raises:
        RigError: The target is the position.
    """
    if np.linalg.norm(target - position) < _APART:
        raise RigError(f"{owner} looks at its own position; expected a target in front of it")
    return look_at(position, target)


def check_outside(
    rig: CameraRig, points: Float[np.ndarray, "*batch 3"], *, clearance: float = 0.05, what: str = "hand"
) -> None:
    """Refuse a rig with a camera inside or near an object or a hand.

    Args:
        rig: The cameras.
        points: The object's vertices, or other points of it, in all frames [m]; NaN points are left out.
        clearance: Smallest distance of a camera from any of them [m].
        what: Name of the object, for the message.

    Raises:
        ArgumentError: A camera is nearer.
    """
    flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    flat = flat[~np.isnan(flat).any(axis=1)]
    for number, position in enumerate(rig.positions, 1):
        nearest = np.sqrt(((flat - position) ** 2).sum(axis=1).min(initial=np.inf))
        if nearest < clearance:
            raise ArgumentError(
                f"camera {number} of rig '{rig.name}' is {nearest:.2g} m from the {what}, "
                f"expected at least {clearance:g} m"
            )


def check_outside_volume(
    rig: CameraRig, center: Float[np.ndarray, "3"], half_side: float, *, clearance: float = HAND_REACH
) -> None:
    """Refuse a rig with a camera inside or near the cube that wrists move in, before anything is simulated.

    Args:
        rig: The cameras.
        center: Middle of the cube in the world [m].
        half_side: Half its side [m].
        clearance: Smallest distance of a camera from the cube [m].

    Raises:
        ArgumentError: A camera is nearer.
    """
    middle = np.asarray(center, dtype=np.float64)
    nearest = np.clip(rig.positions, middle - half_side, middle + half_side)
    distances = np.linalg.norm(nearest - rig.positions, axis=1)
    if distances.min() < clearance:
        raise ArgumentError(
            f"camera {distances.argmin() + 1} of rig '{rig.name}' is {distances.min():.2g} m from the space "
            f"that wrists move in, expected at least {clearance:g} m"
        )


def _check_pose(owner: str, pose: NDArray[np.float64]) -> None:
    rotation = pose[:3, :3]
    if (
        not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-6)
        or np.linalg.det(rotation) < 0.0
        or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise RigError(f"{owner}: T_world_camera is not a rotation and a position, expected a rigid pose")
    distance = np.linalg.norm(pose[:3, 3])
    if distance > _FARTHEST:
        raise RigError(
            f"{owner} stands {distance:.4g} m from the origin, expected at most {_FARTHEST:g} m; "
            "are these millimeters? Positions are in meters"
        )


def _check_apart(name: str, positions: NDArray[np.float64]) -> None:
    gaps = np.linalg.norm(positions[:, None] - positions, axis=-1)
    gaps[np.tril_indices(len(gaps))] = np.inf
    first, second = np.unravel_index(gaps.argmin(), gaps.shape)
    if gaps[first, second] < _APART:
        raise RigError(
            f"cameras {first + 1} and {second + 1} of rig '{name}' stand at one position, "
            "expected different ones"
        )
