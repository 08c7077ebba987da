"""Camera rigs, by name, from a file or as objects, and the TOML file of cameras.

A file lists the cameras of a rig that sees markers, or cameras that pictures are drawn for. Keys at its top
hold for every camera whose own table does not replace them (docs/rigs.md).
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_type
from handsim.cards import card, map_drawing
from handsim.errors import ArgumentError, RigError, choices, errors_of, shortened
from handsim.files.inputs import (
    check_keys,
    number_list,
    number_of,
    numbers,
    read_toml,
    shown,
    tables_of,
    text_of,
    toml_string,
)
from handsim.files.outputs import as_text, write_text
from handsim.settings import Expected, Limits
from handsim.space.camera import (
    Camera,
    CameraArrays,
    Lens,
    LensKind,
    camera_arrays,
    camera_matrix,
    focal_of_angle,
    look_at,
    points_in_view,
)

_SIZE_KEYS: Final = ("size", "resolution")
_FOCAL_KEYS: Final = ("focal", "K", "field_of_view", "horizontal_field_of_view")
_LENS_KEYS: Final = ("lens", "coefficients")
_PICTURE_KEYS: Final = (*_SIZE_KEYS, *_FOCAL_KEYS, "center", *_LENS_KEYS)
"""Keys of a camera's picture: at the top for all cameras, or in a camera's own table."""
_POSE_KEYS: Final = ("position", "target", "T_world_camera")
_FILE_KEYS: Final = ("name", "description", *_PICTURE_KEYS, "camera")
_CAMERA_KEYS: Final = ("name", *_PICTURE_KEYS, *_POSE_KEYS)
_MAX_FIELD_OF_VIEW: Final = 170.0  # [deg]
_MAX_FILE_CAMERAS: Final = 256
_MAX_DISTANCE: Final = 50.0  # largest distance of a camera from the origin [m]
_MIN_DISTANCE: Final = 1e-3  # least distance of a camera from its target or another camera [m]
_VALID_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_-]+")
"""Characters that a camera's name cannot have."""
TOML_MATRIX: Final = "matrix"
"""The key of a camera's K in the TOML files of Pose2Sim and anipose."""
MIN_CAMERAS: Final = 2
MAX_CAMERAS: Final = 32
"""A marker's visibility is one bit per camera in 32 bits."""
ROOM_CENTER: Final = (0.0, 0.0, 1.1)
"""Middle of the space that hands move in, in front of a seated user [m]."""
MAX_SIDE: Final = 50.0
"""Largest side of a volume or room, and largest coordinate of its middle [m]."""
HAND_REACH: Final = 0.25
"""Longest reach of a hand from its wrist [m], and the least distance of a camera from the wrists' volume."""
_CLEARANCE: Final = 0.05  # [m] least distance of a camera from a hand
_RIGS_FOLDER: Final = Path(__file__).parents[1] / "rigs"


class RigFile(NamedTuple):
    """The content of a file, before `CameraRig` checks whether its cameras can be a rig."""

    name: str
    description: str
    cameras: tuple[Camera, ...]


def read_rig_file(path: Path) -> RigFile:
    """Read a file of cameras."""
    table = read_toml(path, error=RigError)
    with errors_of(path, RigError):
        return _parse_rig(table, as_text(path.stem))


def checked_cameras(path: Path, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras of a file, after a check of their number, their names and their distances."""
    if not 1 <= len(cameras) <= _MAX_FILE_CAMERAS:
        raise RigError(f"{path}: {len(cameras)} cameras, expected 1 to {_MAX_FILE_CAMERAS}")
    check_names(str(path), cameras)
    for camera in cameras:
        with errors_of(path, RigError):
            check_near(f"camera '{camera.name}'", camera)
    return tuple(cameras)


def check_names(owner: str, cameras: Sequence[Camera]) -> None:
    """Refuse two cameras of one name, and names that cannot be part of a file name."""
    names = [camera.name for camera in cameras]
    for name in names:
        if not _VALID_NAME.fullmatch(name):
            raise RigError(
                f"{owner}: a camera is called {shown(name)}, expected up to 64 letters, digits, - and _"
            )
        if names.count(name) > 1:
            raise RigError(f"{owner}: two cameras are called '{name}', expected different names")


def camera_names(given: Sequence[str]) -> list[str]:
    """Unique names of cameras, with letters, digits, - and _ only."""
    names: list[str] = []
    for number, text in enumerate(given, 1):
        # A number may follow the name.
        plain = NOT_IN_NAMES.sub("_", text).strip("_")[:56] or f"camera{number}"
        names.append(plain if plain not in names else f"{plain}_{number}")
    return names


def nearest_rotation(owner: str, matrix: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """The rotation (3, 3) nearest to a rounded one."""
    left, stretch, right = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    rotation: NDArray[np.float64] = left @ right
    if np.abs(stretch - 1.0).max() > 1e-3 or np.linalg.det(rotation) < 0.0:
        raise RigError(f"{owner} is not a rotation matrix")
    return rotation


def check_near(owner: str, camera: Camera) -> None:
    """Refuse a camera more than 50 m from the origin."""
    distance = float(np.linalg.norm(camera.T_world_camera[:3, 3]))
    if distance > _MAX_DISTANCE:
        raise RigError(
            f"{owner} stands {distance:.4g} m from the origin, expected at most {_MAX_DISTANCE:g} m; "
            "are these millimeters? Positions and translations are in meters: divide them by 1,000"
        )


def rig_lines(name: str, cameras: Sequence[Camera]) -> list[str]:
    """The lines of a rig's file, with exact numbers; picture keys that all cameras share are at the top."""
    pictures = [list(_picture_lines(one)) for one in cameras]
    shared = all(one == pictures[0] for one in pictures)
    lines = [f"name = {toml_string(name)}", *(pictures[0] if shared else ())]
    for camera, picture in zip(cameras, pictures, strict=True):
        rows = [f"    {_toml_list(row)}," for row in camera.T_world_camera.tolist()]
        lines += ["", "[[camera]]", f"name = {toml_string(camera.name)}", *(() if shared else picture)]
        lines += ["T_world_camera = [", *rows, "]"]
    return lines


def _picture_lines(camera: Camera) -> Iterator[str]:
    yield f"size = {list(camera.size)}"
    yield f"focal = {_toml_list(camera.focal_lengths)}"
    center = camera.K[:2, 2].tolist()
    if center != [length / 2 for length in camera.size]:
        yield f"center = {_toml_list(center)}"
    if camera.lens.kind != "pinhole":
        yield f"lens = {toml_string(camera.lens.kind)}"
        yield f"coefficients = {_toml_list(camera.lens.coefficients)}"


def _toml_list(values: Sequence[float]) -> str:
    """A list of TOML floats, to the last digit."""
    return f"[{', '.join(repr(float(value) + 0.0) for value in values)}]"


def foreign_cameras(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The cameras by name in a TOML file of Pose2Sim, anipose or Caliscope; none in other files."""
    inner = table.get("cameras")
    named = {**table, **(inner if isinstance(inner, dict) else {})}
    return {key: one for key, one in named.items() if isinstance(one, dict) and TOML_MATRIX in one}


def _parse_rig(table: Mapping[str, Any], stem: str) -> RigFile:
    for foreign in foreign_cameras(table):
        raise RigError(
            f"[{shortened(foreign)}] with a {TOML_MATRIX} is a camera of Pose2Sim or anipose, expected "
            "[[camera]]; handsim rig import makes a rig of such a file"
        )
    check_keys(table, "the file", _FILE_KEYS, optional=_FILE_KEYS)
    name = table.get("name", stem)
    if not isinstance(name, str) or not name or not name.isprintable():
        raise RigError(f"name is {shown(name)}, expected printable text in quotes")
    top = {key: value for key, value in table.items() if key in _PICTURE_KEYS}
    cameras = [_read_camera(top, entry, number) for number, entry in enumerate(tables_of(table, "camera"), 1)]
    return RigFile(name, text_of(table, "description", default=""), tuple(cameras))


def _read_camera(top: Mapping[str, Any], own: Mapping[str, Any], number: int) -> Camera:
    """Read a camera of a rig's file; keys that it lacks are taken from the top of the file."""
    owner = f"camera {number}"
    check_keys(own, owner, _CAMERA_KEYS, optional=_CAMERA_KEYS)
    pose = _pose(own, owner)
    given = {key: value for key, value in top.items() if not _is_replaced(key, own)} | dict(own)
    size = _size(given, f"{owner}: ")
    K = _camera_matrix(given, size, owner)
    kind = text_of(given, "lens", f"{owner}: ", default="pinhole")
    coefficients = number_list(f"{owner}: coefficients", given.get("coefficients", []))
    lens = Lens(cast("LensKind", kind), coefficients)  # `Lens` refuses unknown kinds
    return Camera(text_of(own, "name", f"{owner}: ", default=f"camera{number}"), size, K, pose, lens)


def _is_replaced(key: str, own: Mapping[str, Any]) -> bool:
    """Whether a camera's own keys replace a key at the top."""
    if key == "center":
        return any(name in own for name in (*_SIZE_KEYS, "K", "center"))
    groups = (_SIZE_KEYS, _FOCAL_KEYS, _LENS_KEYS)
    return any(key in group and any(name in own for name in group) for group in groups)


def _size(given: Mapping[str, Any], prefix: str) -> tuple[int, int]:
    """Width and height [px]."""
    if "size" in given and "resolution" in given:
        raise RigError(f"{prefix}size and resolution are given, expected one of them")
    if "size" not in given:
        resolution = given.get("resolution", 1280)
        if isinstance(resolution, bool) or not isinstance(resolution, int):
            raise RigError(f"{prefix}resolution is {shown(resolution)}, expected a whole number of pixels")
        return resolution, resolution
    sides = numbers(f"{prefix}size", given["size"], (2,), "width and height in pixels")
    if (sides % 1 != 0).any():
        raise RigError(f"{prefix}size is {shown(given['size'])}, expected whole numbers of pixels")
    return int(sides[0]), int(sides[1])


def _camera_matrix(given: Mapping[str, Any], size: tuple[int, int], owner: str) -> NDArray[np.float64]:
    """K of the one key among `_FOCAL_KEYS` that is given."""
    named = [key for key in _FOCAL_KEYS if key in given]
    if len(named) != 1:
        found = " and ".join(named) or "no focal length"
        raise RigError(f"{owner} has {found}, expected one of {', '.join(_FOCAL_KEYS)}")
    key, prefix = named[0], f"{owner}: "
    if key == "K":
        if "center" in given:
            raise RigError(f"{owner} has K and center, expected one of them")
        return numbers(f"{prefix}K", given["K"], (3, 3), "three rows of three numbers")
    if key == "focal":
        shape = (2,) if isinstance(given["focal"], list) else ()
        focal = numbers(f"{prefix}focal", given["focal"], shape, "one or two focal lengths in pixels")
        focal = np.broadcast_to(focal, 2)
    else:
        degrees = number_of(given, key, prefix)
        if not 1.0 <= degrees <= _MAX_FIELD_OF_VIEW:
            raise RigError(f"{prefix}{key} is {degrees:g} degrees, expected 1 to {_MAX_FIELD_OF_VIEW:g}")
        length = min(size) if key == "field_of_view" else size[0]
        focal = np.full(2, focal_of_angle(length, np.deg2rad(degrees)))
    expected = "the principal point [cx, cy] in pixels"
    middle = [size[0] / 2, size[1] / 2]
    center = numbers(f"{prefix}center", given.get("center", middle), (2,), expected)
    return camera_matrix(*focal, *center)


def _pose(table: Mapping[str, Any], owner: str) -> NDArray[np.float64]:
    """T_world_camera of a camera's table."""
    place = {key: table[key] for key in _POSE_KEYS if key in table}
    if set(place) == {"T_world_camera"}:
        return numbers(
            f"{owner}: T_world_camera", place["T_world_camera"], (4, 4), "four rows of four numbers"
        )
    if set(place) != {"position", "target"}:
        given = " and ".join(place) or "no place"
        raise RigError(f"{owner} has {given}, expected position and target, or T_world_camera alone")
    position, target = (
        numbers(f"{owner}: {key}", place[key], (3,), "three numbers [x, y, z] in meters")
        for key in ("position", "target")
    )
    if np.linalg.norm(target - position) < _MIN_DISTANCE:
        raise RigError(f"{owner} looks at its own position; expected a target in front of it")
    return look_at(position, target)


Center = Annotated[tuple[float, float, float], Limits(-MAX_SIDE, MAX_SIDE)]
"""The middle of a volume or room [m]."""


@dataclass(frozen=True)
class CameraRig:
    """Calibrated cameras around the hands, each with its own picture and lens.

    Messages count cameras from 1, in the order given. Rigs are equal where their names and cameras are.

    Raises:
        ArgumentError: `cameras` is not a sequence of cameras.
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
        if not MIN_CAMERAS <= len(self.cameras) <= MAX_CAMERAS:
            raise RigError(
                f"rig '{self.name}' has {len(self.cameras)} cameras, expected {MIN_CAMERAS} to {MAX_CAMERAS}"
            )
        check_names(f"rig '{self.name}'", self.cameras)
        for number, camera in enumerate(self.cameras, 1):
            check_near(f"camera {number} of rig '{self.name}'", camera)
        gaps = np.linalg.norm(self.positions[:, None] - self.positions, axis=-1)
        gaps[np.tril_indices(len(gaps))] = np.inf
        first, second = np.unravel_index(gaps.argmin(), gaps.shape)
        if gaps[first, second] < _MIN_DISTANCE:
            raise RigError(
                f"cameras {first + 1} and {second + 1} of rig '{self.name}' stand at one position, "
                "expected different ones"
            )

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

    def _repr_html_(self) -> str:
        """The card that notebooks show: the cameras from above, each with its viewing direction."""
        ground, ways = self.positions[:, :2], self.T_world_camera[:, :2, 2]
        lines = [np.array([one, one + 0.5 * way]) for one, way in zip(ground, ways, strict=True)]
        heights = f"{self.positions[:, 2].min():.2f} to {self.positions[:, 2].max():.2f} m"
        facts = {"cameras": str(len(self.cameras)), "pictures": self.pictures(), "heights": heights}
        names = [camera.name for camera in self.cameras]
        return card(f"Rig {self.name}", facts, map_drawing(ground, names, lines))

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
        """The sizes and fields of view (without lenses) of the cameras' pictures, in words."""
        sizes = dict.fromkeys(f"{width} x {height}" for width, height in (one.size for one in self.cameras))
        angles = np.rad2deg([one.angles for one in self.cameras]).T
        degrees = " x ".join(
            f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"
            for low, high in zip(angles.min(axis=1), angles.max(axis=1), strict=True)
        )
        return f"{' and '.join(sizes)} pixels, {degrees} degrees"

    def record(self) -> dict[str, Any]:
        """The rig as a JSON record, which `load_rig` reads."""
        return {"name": self.name, "cameras": [one.record() for one in self.cameras]}

    def save(self, path: str | Path) -> None:
        """Write the rig's `.toml` file; `load_rig` gives an equal rig again.

        Raises:
            OSError: The file cannot be written.
        """
        write_text(path, "\n".join(rig_lines(self.name, self.cameras)) + "\n")

    def digest(self) -> str:
        """The first digits of the SHA-256 of its rounded record: whether a name still means this rig."""
        rounded = json.loads(json.dumps(self.record()), parse_float=lambda text: round(float(text), 9) + 0.0)
        return hashlib.sha256(json.dumps(rounded, sort_keys=True).encode()).hexdigest()[:16]


def list_rigs() -> tuple[str, ...]:
    """Names of the rigs that come with the package."""
    return tuple(sorted(path.stem for path in _RIGS_FOLDER.glob("*.toml")))


AnyRig = Annotated[CameraRig | str | Path, Expected("a CameraRig, or the name or path of one", list_rigs)]
"""Type of a setting that is a camera rig, or the name or path of one."""


def rig_description(name: str) -> str:
    """One sentence on a rig that comes with the package."""
    return read_rig_file(_RIGS_FOLDER / f"{name}.toml").description


def load_rig(rig: CameraRig | str | Path | Mapping[str, Any]) -> CameraRig:
    """A shipped rig by its name, or your own by the path of its `.toml` file (format: docs/rigs.md).

    Args:
        rig: `figure5` (sixteen cameras, as in the paper), `eight`, `six`, a path, or the record of a rig
            (`CameraRig.record`); a rig is returned as it is.

    Returns:
        The rig, each camera with its pose [m], its intrinsics [px] and its lens.

    Raises:
        ArgumentError: `rig` has another type.
        RigError: No such rig or file, or the file or record does not describe one; the sentence names the
            file.
    """
    if isinstance(rig, CameraRig):
        return rig
    expected = "a CameraRig, or the name or path of one"
    check_type("rig", rig, (str, Path, Mapping), expected, list_rigs())
    if isinstance(rig, Mapping):
        try:
            fields = ("name", "size", "K", "T_world_camera", "lens")
            return CameraRig(rig["name"], [Camera(*(one[name] for name in fields)) for one in rig["cameras"]])
        except (KeyError, TypeError) as error:
            raise RigError(
                f"a damaged record of a rig ({error!r}), expected what CameraRig.record() gives"
            ) from error
    path = _RIGS_FOLDER / f"{rig}.toml" if str(rig) in list_rigs() else Path(rig)
    if path.suffix.lower() != ".toml":
        unknown = choices(str(rig), list_rigs(), noun="camera rig")
        raise RigError(f"{unknown}, or the path of a .toml file")
    read = read_rig_file(path)
    with errors_of(path, RigError):
        return CameraRig(read.name, read.cameras)


def rig_setting(rig: CameraRig) -> str | dict[str, Any]:
    """The rig in saved settings: its name if it comes with the package, else its record."""
    return rig.name if rig.name in list_rigs() and rig == load_rig(rig.name) else rig.record()


def check_outside(rig: CameraRig, points: Float[np.ndarray, "*batch 3"]) -> None:
    """Refuse a rig with a camera inside or near a hand with these points [m]."""
    flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    flat = flat[~np.isnan(flat).any(axis=1)]
    for number, position in enumerate(rig.positions, 1):
        nearest = np.sqrt(((flat - position) ** 2).sum(axis=1).min(initial=np.inf))
        if nearest < _CLEARANCE:
            raise ArgumentError(
                f"camera {number} of rig '{rig.name}' is {nearest:.2g} m from the hand, "
                f"expected at least {_CLEARANCE:g} m"
            )


def distances_to_volume(
    rig: CameraRig, center: Float[np.ndarray, "3"], half_side: float
) -> Float[np.ndarray, "C"]:
    """How far each camera is from a cube [m]."""
    middle = np.asarray(center, dtype=np.float64)
    nearest = np.clip(rig.positions, middle - half_side, middle + half_side)
    return np.asarray(np.linalg.norm(nearest - rig.positions, axis=1))


def check_outside_volume(rig: CameraRig, center: Float[np.ndarray, "3"], half_side: float) -> None:
    """Refuse a rig with a camera inside or near the cube that wrists move in."""
    distances = distances_to_volume(rig, center, half_side)
    if distances.min() < HAND_REACH:
        raise ArgumentError(
            f"camera {distances.argmin() + 1} of rig '{rig.name}' is {distances.min():.2g} m from the space "
            f"that wrists move in, expected at least {HAND_REACH:g} m"
        )
