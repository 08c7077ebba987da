"""Camera rigs: the cameras around the hands, by name, from a file, or as objects."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_choice, check_type
from handsim.errors import ArgumentError, HandSimError, RigError, choices
from handsim.files.atomic import atomic_write
from handsim.space.camera import Camera, CameraArrays, camera_arrays, camera_from_record, points_in_view
from handsim.space.rig_file import check_names, check_near, read_rig_file, rig_lines

FEWEST_CAMERAS: Final = 2
MAX_CAMERAS: Final = 32
"""A marker's visibility is one bit per camera in 32 bits."""
ROOM_CENTER: Final = (0.0, 0.0, 1.1)
"""Middle of the space that hands move in, in front of a seated user [m]."""
HAND_REACH: Final = 0.25
"""No hand reaches further from its wrist [m]; cameras stand at least this far from the wrists' volume."""
_APART: Final = 1e-3  # [m]
_SHIPPED: Final = Path(__file__).parents[1] / "rigs"


@dataclass(frozen=True)
class CameraRig:
    """Calibrated cameras around the hands, each with its own picture and lens.

    Messages count cameras from 1, in the order given. Rigs are equal where their names and cameras are.

    Raises:
        ArgumentError: What is given are no cameras.
        RigError: Too few or too many cameras, two of one name or at one position, or one beyond 50 m.
    """

    name: str
    cameras: Sequence[Camera]
    """2 to 32, kept as a tuple."""

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Sequence) or not all(isinstance(one, Camera) for one in self.cameras):
            raise ArgumentError(
                f"rig '{self.name}' has {type(self.cameras).__name__} as cameras, "
                "expected a sequence of Camera"
            )
        object.__setattr__(self, "cameras", tuple(self.cameras))
        if not FEWEST_CAMERAS <= len(self.cameras) <= MAX_CAMERAS:
            raise RigError(
                f"rig '{self.name}' has {len(self.cameras)} cameras, "
                f"expected {FEWEST_CAMERAS} to {MAX_CAMERAS}"
            )
        check_names(f"rig '{self.name}'", self.cameras)
        for number, camera in enumerate(self.cameras, 1):
            check_near(f"camera {number} of rig '{self.name}'", camera)
        _check_apart(self.name, self.positions)

    @functools.cached_property
    def arrays(self) -> CameraArrays:
        """All cameras' numbers, for compiled functions."""
        return camera_arrays(self.cameras)

    @property
    def T_world_camera(self) -> Float[np.ndarray, "C 4 4"]:
        """Pose of each camera in the world [m]."""
        return self.arrays.T_world_camera

    @property
    def positions(self) -> Float[np.ndarray, "C 3"]:
        """Optical centers in the world [m]."""
        return self.T_world_camera[:, :3, 3]

    def in_view(self, points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch C"]:
        """Which cameras have each point [m], in the world, in front of them and inside their pictures."""
        return points_in_view(self.arrays, points)

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch C 2"]:
        """Pixel of each point [m] in each camera [px], as `Camera` counts: from the picture's corner.

        NaN for points that a camera's lens does not see. Points outside the picture are projected too;
        `in_view` tells them apart.
        """
        return np.stack([one.project(points) for one in self.cameras], axis=-2)

    def without(self, number: int) -> CameraRig:
        """The rig without the camera of this index."""
        return CameraRig(self.name, (*self.cameras[:number], *self.cameras[number + 1 :]))

    def pictures(self) -> str:
        """The cameras' pictures in words: their sizes, and the angles that they show without lenses."""
        sizes = dict.fromkeys(f"{width} x {height}" for width, height in (one.size for one in self.cameras))
        angles = np.rad2deg([one.angles for one in self.cameras]).T
        degrees = " x ".join(
            f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"
            for low, high in zip(angles.min(axis=1), angles.max(axis=1), strict=True)
        )
        return f"{' and '.join(sizes)} pixels, {degrees} degrees"

    def record(self) -> dict[str, Any]:
        """The rig as a JSON record, which `as_rig` reads."""
        return {"name": self.name, "cameras": [one.record() for one in self.cameras]}

    def save(self, path: str | Path) -> None:
        """Write the rig's `.toml` file; `load_rig` gives an equal rig again.

        Raises:
            OSError: The file cannot be written.
        """
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(rig_lines(self.name, self.cameras)) + "\n", encoding="utf-8")

    def digest(self) -> str:
        """Beginning of the SHA-256 of its record to nine decimals: whether a name still means this rig."""
        rounded = json.loads(json.dumps(self.record()), parse_float=lambda text: round(float(text), 9) + 0.0)
        return hashlib.sha256(json.dumps(rounded, sort_keys=True).encode()).hexdigest()[:16]


def list_rigs() -> tuple[str, ...]:
    """Names of the rigs that come with the package."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def named_rig(name: str) -> CameraRig:
    """A rig that comes with the package: `figure5` (sixteen cameras, as in the paper), `eight` or `six`.

    Raises:
        ArgumentError: There is no rig of that name.
    """
    return _read(_shipped(name))


def rig_description(name: str) -> str:
    """What a rig that comes with the package is, in one sentence.

    Raises:
        ArgumentError: There is no rig of that name.
    """
    return read_rig_file(_shipped(name)).description


def load_rig(rig: CameraRig | str | Path) -> CameraRig:
    """A shipped rig by its name, or your own by the path of its `.toml` file (format: docs/rigs.md).

    Args:
        rig: `figure5` (sixteen cameras, as in the paper), `eight`, `six`, or a path; a rig is given back.

    Returns:
        The rig, each camera with its pose [m], its intrinsics [px] and its lens.

    Raises:
        ArgumentError: It is nothing of these.
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


def as_rig(rig: CameraRig | str | Path | Mapping[str, Any]) -> CameraRig:
    """The rig of whatever stands for one: as `load_rig`, and the record of one (`CameraRig.record`).

    Raises:
        ArgumentError: It is nothing of these.
        RigError: There is no such rig, or it cannot be one.
    """
    if not isinstance(rig, Mapping):
        return load_rig(rig)
    try:
        return CameraRig(rig["name"], [camera_from_record(one) for one in rig["cameras"]])
    except (KeyError, TypeError) as error:
        raise RigError(
            f"a damaged record of a rig ({error!r}), expected what CameraRig.record() gives"
        ) from error


def rig_setting(rig: CameraRig | str | Path | Mapping[str, Any]) -> str | dict[str, Any]:
    """What stands for a rig in settings: its name if it comes with the package, else its cameras.

    Raises:
        RigError: As `as_rig`.
    """
    found = as_rig(rig)
    return found.name if found.name in list_rigs() and found == named_rig(found.name) else found.record()


def _shipped(name: str) -> Path:
    check_choice(name, list_rigs(), noun="camera rig")
    return _SHIPPED / f"{name}.toml"


def _read(path: Path) -> CameraRig:
    read = read_rig_file(path)
    try:
        return CameraRig(read.name, read.cameras)
    except HandSimError as error:
        raise RigError(f"{path}: {error}") from error


def check_outside(
    rig: CameraRig, points: Float[np.ndarray, "*batch 3"], *, clearance: float = 0.05, what: str = "hand"
) -> None:
    """Refuse a rig with a camera inside or near an object or a hand (`what`, in messages)."""
    flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    flat = flat[~np.isnan(flat).any(axis=1)]
    for number, position in enumerate(rig.positions, 1):
        nearest = np.sqrt(((flat - position) ** 2).sum(axis=1).min(initial=np.inf))
        if nearest < clearance:
            raise ArgumentError(
                f"camera {number} of rig '{rig.name}' is {nearest:.2g} m from the {what}, "
                f"expected at least {clearance:g} m"
            )


def distances_to_volume(
    rig: CameraRig, center: Float[np.ndarray, "3"], half_side: float
) -> Float[np.ndarray, "C"]:
    """How far each camera is from a cube [m]."""
    middle = np.asarray(center, dtype=np.float64)
    nearest = np.clip(rig.positions, middle - half_side, middle + half_side)
    return np.asarray(np.linalg.norm(nearest - rig.positions, axis=1))


def check_outside_volume(rig: CameraRig, center: Float[np.ndarray, "3"], half_side: float) -> None:
    """Refuse a rig with a camera inside or near the cube that wrists move in, before anything is simulated.

    Raises:
        ArgumentError: A camera is nearer to the cube than hands reach.
    """
    distances = distances_to_volume(rig, center, half_side)
    if distances.min() < HAND_REACH:
        raise ArgumentError(
            f"camera {distances.argmin() + 1} of rig '{rig.name}' is {distances.min():.2g} m from the space "
            f"that wrists move in, expected at least {HAND_REACH:g} m"
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
