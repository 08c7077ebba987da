"""Reader of OpenCV's calibrations: a YAML or JSON file of one camera, a stereo pair, or several cameras.

It also reads ROS' CameraInfo, and the TOML of Pose2Sim and anipose with a table for each camera. YAML is
parsed by PyYAML's Python parser, because OpenCV's may hang on a damaged file, and PyYAML's C parser crashes
on deeply nested lists.
"""

from __future__ import annotations

import itertools
import json
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimError, HandSimWarning, RigError, choices, errors_of, shortened
from handsim.files.inputs import read_bytes, read_toml, text_encoding, words_numbers
from handsim.space.camera import Camera, Lens, LensKind, brown_lens
from handsim.space.rig import TOML_MATRIX, camera_names, checked_cameras, foreign_cameras, nearest_rotation
from handsim.space.transforms import quaternion_matrix, rigid, vector_quaternions

_MAX_NUMBERS: Final = 16  # Longer lists of numbers, such as corners of a board, are ignored.
_PIXEL_CENTER: Final = 0.5
"""Center of the first pixel [px], from which OpenCV counts; ours count from the picture's corner."""
_MIN_FOCAL: Final = 0.02  # least focal length in pictures' widths; a smaller one is not in pixels
_MAX_TURN: Final = 6.4  # longest rotation vector [rad]; longer ones are in degrees
_MAX_BASELINE: Final = 5.0  # largest distance of the cameras of a pair [m]
_LONG_LIST: Final = re.compile(r"\[[^\[\]]{2000,}\]")
"""A list of numbers that is too long for a camera, and takes long to parse."""
_YAML_VERSION: Final = re.compile(r"^%YAML.*$", re.M)  # OpenCV writes it in a form that parsers refuse
_K_KEYS: Final = ("camera_matrix", "cameraMatrix", "K", "mtx", "M")
_D_KEYS: Final = ("distortion_coefficients", "dist_coeffs", "distCoef", "D", "dist", "distortions")
_WIDTH_KEYS: Final = ("image_width", "img_width", "width")
_HEIGHT_KEYS: Final = ("image_height", "img_height", "height")
_SIZE_KEYS: Final = ("image_size", "img_size", "size", "resolution")
_BROWN_KEYS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_KEY: Final = re.compile(r"(is|use)?fisheye(model|lens)?")
_MODEL_KEY: Final = re.compile(
    r"(distortion|lens|projection|calibration)(model|type|name)|distortion|projection|cameramodel|modeltype"
)
"""Keys of the name of a lens, without signs and capital letters."""
_LOOSE_MODEL_KEY: Final = re.compile(r"model|modelname|cameratype|lens|type")
"""Keys of the name of a lens or of the maker of a camera."""
_BOOLEANS: Final = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_EMPTY_TEXTS: Final = ("[]", "", "~", "null", "None")
_LENS_KINDS: Final[dict[str, LensKind]] = {
    **dict.fromkeys(("none", "pinhole", "perspective"), "pinhole"),
    **dict.fromkeys(("plumbbob", "radtan", "radialtangential", "brown", "brownconrady"), "brown"),
    **dict.fromkeys(("opencv", "standard", "rational", "rationalpolynomial"), "brown"),
    **dict.fromkeys(
        ("equidistant", "equi", "fisheye", "opencvfisheye", "cvfisheye", "kannalabrandt", "kb"), "fisheye"
    ),
}
"""Names of lenses in small letters. A pinhole camera may have coefficients of Brown's lens."""
_SHOWN_LENSES: Final = (
    "pinhole", "plumb_bob", "radtan", "rational_polynomial", "equidistant", "fisheye", "kannala_brandt",
)  # fmt: skip
_OTHER_LENSES: Final = {
    "mei", "omni", "omnidirectional", "ucm", "eucm", "ds", "doublesphere", "fov", "ftheta", "unified", "ocam",
    "scaramuzza", "equisolid", "stereographic", "orthographic",
}  # fmt: skip
_R_KEYS: Final = ("R", "Rot", "rvec", "rotation", "rotation_matrix", "rotation_vector")
_T_KEYS: Final = ("T", "t", "tvec", "translation", "translation_vector")
_POSE_KEY: Final = "T_world_camera"
_VALID_POSES: Final = (
    f"{_POSE_KEY}, or R (rotation_matrix, rotation_vector, rvec) and T (translation_vector, tvec), which "
    "take the world to the camera"
)
_VALID_LENSES: Final = "distortion_coefficients, dist_coeffs or D, or k1, k2, p1, p2, k3"
_PICTURE_KEYS: Final = (*_K_KEYS, *_D_KEYS, *_WIDTH_KEYS, *_HEIGHT_KEYS, *_SIZE_KEYS, *_BROWN_KEYS)
_KNOWN_KEYS: Final = (*_PICTURE_KEYS, *_R_KEYS, *_T_KEYS, _POSE_KEY, TOML_MATRIX)
"""Keys with a meaning; single letters are case-sensitive, other names match in any spelling."""
_HARMLESS_KEY: Final = re.compile(
    "error|std|deviation|covariance|count|points|rectif|projection|new|optimal|essential|fundamental|homography"
    "|^[pqefh]$"
)
"""Keys, without signs and capital letters, that mean neither a pose nor a lens."""
_BOARD_KEYS: Final = ("rvecs", "tvecs", "extrinsic_parameters")
"""Keys of the poses of OpenCV's calibration board, one for each picture."""
_MAYBE_POSE: Final = re.compile(
    "extr|pose|rot|transl|transf|[rt]vec|^rt$|world|[cw]2[cw]|position|location|orient|quat|euler"
    "|^t(cw|wc)$|^(yaw|pitch|roll)$"
)
"""Keys, without signs and capital letters, that may mean a pose; so may any key with 9, 12 or 16 numbers."""
_POSE_COUNTS: Final = (9, 12, 16)
_SHOWN_KEYS: Final = 8  # keys that a sentence names
_MAYBE_LENS: Final = re.compile("distor|radial|tangential|coef|fisheye|^kc?[1-6]?$")
"""Keys, without signs and capital letters, that may mean a lens."""
_PAIRS: Final = {"intrinsics": "extrinsics", "intri": "extri"}
"""Files that belong together: of OpenCV's stereo sample, and of EasyMocap."""
_PARTNER_STEMS: Final = _PAIRS | {second: first for first, second in _PAIRS.items()}
_UNITS_HINT: Final = "in units of their own; give the COLMAP reconstruction in meters that they were made of"
_REWRITE_HINT: Final = "write its numbers as OpenCV's camera_matrix and distortion_coefficients"
_FOREIGN_FILES: Final = {
    "transform_matrix": f"the JSON of NeRF and nerfstudio, with poses {_UNITS_HINT}",
    "img_name": f"the JSON of Gaussian Splatting, with poses {_UNITS_HINT}",
    "cam0": f"a chain of Kalibr; {_REWRITE_HINT}, with R and T of each camera",
    "ppx": f"a RealSense's intrinsics; {_REWRITE_HINT}",
    "projection_parameters": f"a camera of VINS; {_REWRITE_HINT}",
    "Camera.fx": f"a settings file of ORB-SLAM; {_REWRITE_HINT}",
    "Camera1.fx": f"a settings file of ORB-SLAM; {_REWRITE_HINT}",
}
"""Descriptions of other programs' files, by a key that these contain."""
_KEY_PATTERN: Final = r"(?:^|[{{,])[ \t\n]{{0,99}}[\"']?{}[\"']?[ \t]*:"
_MAX_CAMERAS: Final = 256
_MAX_BYTES: Final = 1 << 22
_MAX_DEPTH: Final = 64
_MAX_PARTS: Final = 1000  # largest number of lists and numbers that are read of a value

Values = dict[str, tuple[float, ...] | str]
Sections = dict[str, Values]
"""Tables of one camera each, by the cameras' names."""


def read_opencv_cameras(path: Path) -> tuple[Camera, ...]:
    """All cameras of a `.yml`, `.yaml`, `.json` or `.toml`, or of a pair of files (docs/rendering.md)."""
    values, sections = _read_file(path)
    values = _without_rectification(path, values)
    other = path.with_stem(_PARTNER_STEMS.get(path.stem, path.stem))
    if other != path and other.is_file():
        more, others = _read_file(other)
        values, sections = more | values, others | sections
    try:
        sections = sections or _numbered_sections(values)
        if sections:
            cameras = _several_cameras(values, sections)
        elif _find_key(values, _numbered(_K_KEYS, 1)) is not None:
            cameras = _stereo_pair(values)
        elif _find_key(values, ("P1",)) is not None:
            cameras = _rectified_pair(values)
        else:
            cameras = [_camera(values, "camera", _K_KEYS, _D_KEYS, _pose(values))]
    except HandSimError as error:
        alone = other != path and not other.is_file()
        hint = f"; {other.name}, which belongs to it, is not beside it" if alone else ""
        raise RigError(f"{path}: {error}{hint}") from error
    for own in [values, *sections.values()]:
        _warn_of_unread(path, own)
    return checked_cameras(path, cameras)


def _several_cameras(values: Values, sections: Sections) -> list[Camera]:
    """Cameras in one world; a size or name of a lens outside their sections holds for all."""
    if len(sections) > _MAX_CAMERAS:
        raise RigError(f"{len(sections)} cameras, expected at most {_MAX_CAMERAS}")
    cameras = []
    single = [_find_key(values, names) for names in (_K_KEYS, _D_KEYS, _R_KEYS, _T_KEYS)]
    common = {key: value for key, value in values.items() if key not in single}
    for name, (given, own) in zip(camera_names(list(sections)), sections.items(), strict=True):
        with errors_of(f"camera '{shortened(given)}'", RigError):
            if _POSE_KEY not in own and (_find_key(own, _R_KEYS) is None or _find_key(own, _T_KEYS) is None):
                raise _no_pose(_unread_poses(common | own))
            cameras.append(_camera(common | own, name, _K_KEYS, _D_KEYS, _pose(own)))
    return cameras


def _without_rectification(path: Path, values: Values) -> Values:
    """Convert the values of ROS' CameraInfo to OpenCV's; ROS 2 writes K, D, R and P in lower case."""
    if {"k", "p", "distortion_model"} <= values.keys():
        values = {key.upper() if key in ("k", "d", "r", "p") else key: value for key, value in values.items()}
    if not {"K", "P", "R"} <= values.keys() or _find_key(values, (*_T_KEYS, _POSE_KEY)) is not None:
        return values
    message = f"{path}: R beside P is ROS' rectification and no pose; the camera's axes are the world"
    warnings.warn(message, HandSimWarning, stacklevel=3)
    return {key: value for key, value in values.items() if key != "R"}


def _numbered_sections(values: Values) -> Sections:
    """A table for each camera of keys such as K_1, dist_1, R_1, T_1, K_2, if it has a translation."""
    found: Sections = {}
    for key, separator in itertools.product(list(values), ("_", "")):
        starts = (one for one in _K_KEYS if key.startswith(one + separator) and key != one + separator)
        base = next(starts, None)
        if base is None:
            continue
        ending = key[len(base) :]
        own = {one.removesuffix(ending): value for one, value in values.items() if one.endswith(ending)}
        for short, name in (("W", _WIDTH_KEYS[0]), ("H", _HEIGHT_KEYS[0])):
            if short in own:
                own[name] = own.pop(short)
        if _find_key(own, _T_KEYS) is not None:
            found[ending.removeprefix("_")] = own
    return found


def _camera(
    values: Values, name: str, K: tuple[str, ...], D: tuple[str, ...], pose: NDArray[np.float64]
) -> Camera:
    matrix, size = _matrix(values, K, (3, 3)), _size(values)
    off, other = (np.abs(2.0 * matrix[:2, 2] / sides - 1.0).max() for sides in (size, size[::-1]))
    if matrix[0, 0] < _MIN_FOCAL * size[0] or (off > 0.3 and other < 0.1):
        raise RigError(
            f"K has the focal length {matrix[0, 0]:.4g} and center {matrix[0, 2]:.4g}, {matrix[1, 2]:.4g} "
            f"for pictures of {size[0]} x {size[1]}; expected pixels, and the width before the height"
        )
    return Camera(name, size, _from_corner(matrix), pose, _lens(values, D))


def _stereo_pair(values: Values) -> list[Camera]:
    """A stereo pair, whose R and T map coordinates of the first camera to the second."""
    first, outer = _own_pose(values), _extrinsics(values)
    _check_baseline(outer[:3, 3])
    second = first @ np.linalg.inv(outer)
    return [
        _camera(values, name, _numbered(_K_KEYS, number), _numbered(_D_KEYS, number), pose)
        for name, number, pose in (("left", 1, first), ("right", 2, second))
    ]


def _rectified_pair(values: Values) -> list[Camera]:
    """A rectified pair: P2 is K2 (I | t), with the baseline in t."""
    first, cameras = _own_pose(values), []
    for name, key in (("left", "P1"), ("right", "P2")):
        P = _matrix(values, (key,), (3, 4))
        if not np.linalg.det(P[:, :3]):
            raise RigError(f"{key} is not a projection matrix of a camera")
        shift = np.linalg.solve(P[:, :3], P[:, 3]).astype(np.float64)
        _check_baseline(shift)
        pose = first @ np.linalg.inv(rigid(np.eye(3), shift))
        cameras.append(Camera(name, _size(values), _from_corner(P[:, :3]), pose))
    return cameras


def _from_corner(K: NDArray[np.float64]) -> NDArray[np.float64]:
    moved: NDArray[np.float64] = K.astype(np.float64)
    moved[:2, 2] += _PIXEL_CENTER
    return moved


def _lens(values: Values, names: tuple[str, ...]) -> Lens:
    found, plain = _find_key(values, names), {key: _bare_key(key) for key in values}
    if found is None and names is _D_KEYS:
        lists = (key for key, value in values.items() if isinstance(value, tuple) and len(value) > 3)
        found = next((key for key in lists if plain[key].startswith("dist")), None)
    given = () if found is None else _value_numbers(values, found, None)
    single = {
        re.sub(r"^dist[a-z]*?(?=[kp]\d)", "", plain[key]): key
        for key, value in values.items()
        if found is None and names is _D_KEYS and len(value) == 1 and not isinstance(value, str)
    }
    kinds = _named_lenses(values, any(given) or not single.keys().isdisjoint(_BROWN_KEYS))
    if not single.keys().isdisjoint(_BROWN_KEYS):
        found, order = "k1", ("k1", "k2", "k3", "k4") if "fisheye" in kinds else _BROWN_KEYS
        given = tuple(_value_numbers(values, single[key], (1,))[0] if key in single else 0.0 for key in order)
    unread = [] if found else [key for key, value in values.items() if _may_be_lens(key, value)]
    if unread:
        raise RigError(f"unknown keys of a lens: {_listed(unread)}; valid names: {_VALID_LENSES}")
    if "fisheye" in kinds:
        if len(given) < 4 or any(given[4:]):
            raise RigError(f"a fisheye lens with {len(given)} coefficients, expected 4")
        return Lens("fisheye", given[:4])
    if any(given[5:]):
        raise RigError(
            f"{found} has {len(given)} coefficients, of which those after the fifth are not 0, expected the "
            "lens k1, k2, p1, p2, k3; calibrate without CALIB_RATIONAL_MODEL and the like, or undistort the "
            "pictures (cv2.undistort) and set the coefficients to 0"
        )
    if any(given) and len(given) < 4:
        raise RigError(f"{found} has {len(given)} coefficients, expected 4 or 5: k1, k2, p1, p2, k3")
    return brown_lens(*(*given, *[0.0] * 5)[:5])


def _bare_key(key: str) -> str:
    """A key without signs and capital letters."""
    return re.sub("[^a-z0-9]", "", key.lower())


def _named_lenses(values: Values, bent: bool) -> set[LensKind]:
    """The kinds of lenses that the values name; unknown names are refused."""
    kinds: set[LensKind] = set()
    for key, value in values.items():
        plain = _bare_key(key)
        is_flag, is_list = _FISHEYE_KEY.fullmatch(plain), len(value) > 1 and not isinstance(value, str)
        is_model = is_flag or _MODEL_KEY.fullmatch(plain)
        if is_list or not (is_model or _LOOSE_MODEL_KEY.fullmatch(plain)):
            continue
        text = value if isinstance(value, str) else f"{value[0]:g}"
        text = text.partition("\n")[0].partition("#")[0].strip("\"' \t")
        is_on = _BOOLEANS.get(text.lower(), bool(value[0]) if value and not isinstance(value, str) else None)
        words = re.findall("[a-z]+", text.lower())
        name = "".join(words).removeprefix("distortion")
        if is_flag and is_on is not None:
            kinds |= {"fisheye"} if is_on else set()
        elif name in _LENS_KINDS:
            kinds.add(_LENS_KINDS[name])
        elif words and all(word in _LENS_KINDS for word in words):
            kinds.update(_LENS_KINDS[word] for word in words)
        elif name.endswith("brownconrady") and not bent:  # RealSense's variants
            kinds.add("pinhole")
        elif not is_model and re.search("fisheye|equidistant|kannalabrandt", name):
            kinds.add("fisheye")
        elif text not in _EMPTY_TEXTS and (is_model or name in _OTHER_LENSES):
            raise RigError(f"{key}: {choices(text, _SHOWN_LENSES, noun='lens')}")
    if len(kinds - {"pinhole"}) > 1:
        raise RigError("the lens is named both as Brown's and as a fisheye, expected one of them")
    return kinds


def _size(values: Values) -> tuple[int, int]:
    width, height, both = (_find_key(values, names) for names in (_WIDTH_KEYS, _HEIGHT_KEYS, _SIZE_KEYS))
    if width is not None and height is not None:
        size = _value_numbers(values, width, (1,)) + _value_numbers(values, height, (1,))
    elif both is not None:
        size = _value_numbers(values, both, (2,))
    else:
        raise RigError(
            f"no size of the pictures among {_listed(values)}; add image_width and image_height in pixels"
        )
    if not all(length == int(length) for length in size):
        raise RigError(f"the pictures are {size[0]:g} x {size[1]:g}, expected whole numbers of pixels")
    return int(size[0]), int(size[1])


def _pose(values: Values) -> NDArray[np.float64]:
    """`T_world_camera`, or the inverse of R and T; the identity if no key may be a pose."""
    R, T, unread = _find_key(values, _R_KEYS), _find_key(values, _T_KEYS), _unread_poses(values)
    if _POSE_KEY in values or not (R or T or unread):
        return _own_pose(values)
    if unread and not (R and T):
        raise _no_pose(unread)
    return np.linalg.inv(_extrinsics(values)).astype(np.float64)


def _no_pose(unread: list[str]) -> RigError:
    """The error for a camera whose pose is missing, or has unknown keys."""
    found = f"; unknown keys of a pose: {_listed(unread)}" if unread else ""
    return RigError(f"no R and T{found}; valid names: {_VALID_POSES}")


def _warn_of_unread(path: Path, values: Values) -> None:
    """Warn of keys that may mean another pose, and of poses of the calibration's board."""
    boards = [key for key in values if _find_key({key: key}, _BOARD_KEYS)]
    boards = [] if _POSE_KEY in values or _find_key(values, _T_KEYS) else boards
    for keys, why in (
        (_unread_poses(values), "not read beside the pose"),
        (boards, "poses of the board, not of the camera"),
    ):
        if keys:
            warnings.warn(f"{path}: {why}: {_listed(keys)}", HandSimWarning, stacklevel=4)


def _extrinsics(values: Values) -> NDArray[np.float64]:
    """R and T as one transform (4, 4)."""
    R, T = _find_key(values, _R_KEYS), _find_key(values, _T_KEYS)
    return rigid(_rotation(values, R or "R"), _value_numbers(values, T or "T", (3,)))


def _own_pose(values: Values) -> NDArray[np.float64]:
    """`T_world_camera`, or the identity."""
    return _matrix(values, (_POSE_KEY,), (4, 4)) if _POSE_KEY in values else np.eye(4)


def _unread_poses(values: Values) -> list[str]:
    """Keys that may mean a pose, and that are not read."""

    def may_be_pose(key: str, value: tuple[float, ...] | str) -> bool:
        named = _MAYBE_POSE.search(_bare_key(key)) is not None
        if isinstance(value, str):
            return named and re.match(r"[{\[]|.*\n", value) is not None
        return named or len(value) in _POSE_COUNTS

    return [key for key, value in values.items() if not _is_known(key) and may_be_pose(key, value)]


def _may_be_lens(key: str, value: tuple[float, ...] | str) -> bool:
    """Whether a key that is not read may hold coefficients of a lens."""
    plain = _bare_key(key)
    is_name = len(value) == 1 and (_FISHEYE_KEY.fullmatch(plain) or _MODEL_KEY.fullmatch(plain))
    known = _is_known(key) or is_name or isinstance(value, str)
    return not known and _MAYBE_LENS.search(plain) is not None and any(value)


def _is_known(key: str) -> bool:
    """Whether a key, with or without a number at its end, has a meaning or needs none."""
    bases = (key, re.sub(r"_?\d+$", "", key))
    read = any(_find_key({base: base}, (*_KNOWN_KEYS, *_BOARD_KEYS)) for base in bases)
    return read or any(_HARMLESS_KEY.search(_bare_key(base)) for base in bases)


def _listed(keys: Iterable[str]) -> str:
    """Keys for a sentence: the first few, and the number of the others."""
    names = [f"'{shortened(key)}'" for key in keys]
    more = f" and {len(names) - _SHOWN_KEYS} more" if len(names) > _SHOWN_KEYS else ""
    return ", ".join(names[:_SHOWN_KEYS]) + more if names else "no keys"


def _rotation(values: Values, key: str) -> NDArray[np.float64]:
    """The rotation of a matrix or of a rotation vector [rad]."""
    given = np.array(_value_numbers(values, key, None))
    if given.size == 3 and np.linalg.norm(given) < _MAX_TURN:
        return np.asarray(quaternion_matrix(vector_quaternions(given[None])[0]))
    if given.size != 9:
        shown = shortened(str(given.tolist()))
        raise RigError(f"{key} is {shown}, expected a rotation: 9 numbers of a matrix or 3 of a vector [rad]")
    return nearest_rotation(key, given.reshape(3, 3))


def _check_baseline(vector: NDArray[np.float64]) -> None:
    length = float(np.linalg.norm(vector))
    if length > _MAX_BASELINE:
        raise RigError(
            f"the cameras are {length:.4g} m apart, expected at most {_MAX_BASELINE:g} m; are these "
            "millimeters, or squares of the board? Positions are in meters"
        )


def _matrix(values: Values, names: tuple[str, ...], shape: tuple[int, int]) -> NDArray[np.float64]:
    found = _find_key(values, names)
    if found is None:
        raise RigError(
            f"no '{names[0]}' at the top level or in a table of each camera, expected OpenCV's calibration; "
            f"there is {_listed(values)}"
        )
    return np.array(_value_numbers(values, found, shape)).reshape(shape)


def _numbered(names: tuple[str, ...], number: int) -> tuple[str, ...]:
    return tuple(name + separator + str(number) for name in names for separator in ("", "_"))


def _find_key(values: Mapping[str, object], names: tuple[str, ...]) -> str | None:
    """The key that matches one of these names; only names of one or two letters are case-sensitive."""
    plain = {word for word in map(_bare_key, names) if len(word) > 2}
    exact = next((name for name in names if name in values), None)
    return exact or next((key for key in values if _bare_key(key) in plain), None)


def _value_numbers(values: Values, key: str, shape: tuple[int, ...] | None) -> tuple[float, ...]:
    if key not in values:
        raise RigError(f"no '{key}'")
    given = () if values[key] in _EMPTY_TEXTS else values[key]
    if isinstance(given, str) or not np.isfinite(given).all():
        raise RigError(f"{key} is no list of at most {_MAX_NUMBERS} finite numbers")
    if shape is not None and len(given) != np.prod(shape):
        expected = " x ".join(map(str, shape))
        raise RigError(f"{key} has {len(given)} numbers, expected {expected}")
    return given


def _read_file(path: Path) -> tuple[Values, Sections]:
    if path.suffix.lower() == ".toml":
        tables = foreign_cameras(read_toml(path, error=RigError))
        return {}, dict(_sections({name: one | {"K": one[TOML_MATRIX]} for name, one in tables.items()}))
    data = read_bytes(path, error=RigError, max_bytes=_MAX_BYTES)
    try:
        text = _LONG_LIST.sub('"long"', data.decode(text_encoding(data)))
    except UnicodeDecodeError as error:
        raise RigError(f"{path}: not a calibration: it is not UTF-8 text") from error
    if text.lstrip().startswith("<"):
        raise RigError(f"{path}: this is XML, expected OpenCV's YAML or JSON")
    content = _tables(path, text)
    sections = dict(_sections(content))
    inner = {"cameras", *sections} if sections else set()
    values = _values({key: value for key, value in content.items() if key not in inner})
    for key, kind in _FOREIGN_FILES.items():
        if not (sections or _find_key(values, _K_KEYS)) and re.search(_KEY_PATTERN.format(key), text, re.M):
            raise RigError(f"{path}: this is {kind}")
    return values, sections


def _tables(path: Path, text: str) -> dict[str, Any]:
    """The content of JSON or YAML as one table; a list of cameras is that of its key `cameras`."""
    import yaml

    steps = (1 if bracket in "[{" else -1 for bracket in re.findall(r"[\[\]{}]", text))
    if max(itertools.accumulate(steps), default=0) > _MAX_DEPTH:  # PyYAML's time is quadratic in it
        raise RigError(f"{path}: not a calibration: its brackets are nested more than {_MAX_DEPTH} deep")
    try:
        if text.lstrip().startswith(("{", "[")):
            parts = [json.loads(text)]
        else:
            parts = list(yaml.load_all(_YAML_VERSION.sub("", text), yaml.BaseLoader))
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise RigError(f"{path}: not a calibration: it is neither JSON nor YAML") from error
    parts = [{"cameras": part} if isinstance(part, list) else part for part in parts]
    return {str(key): value for part in parts if isinstance(part, dict) for key, value in part.items()}


def _sections(content: Mapping[str, object]) -> Iterator[tuple[str, Values]]:
    """The tables of cameras, at the top level or in a table or list `cameras`."""
    cameras = content.get("cameras", content)
    if isinstance(cameras, list):
        named = [
            (str(one["name"]) if "name" in one else str(n), one)
            for n, one in enumerate(cameras, 1)
            if isinstance(one, dict)
        ]
    else:
        named = list(cameras.items()) if isinstance(cameras, dict) else []
    for name, one in named[: _MAX_CAMERAS + 1]:
        if isinstance(one, dict) and _find_key(one, _K_KEYS) is not None:
            yield name, _values(one)


def _values(table: Mapping[str, object]) -> Values:
    """The values of a table, and those of tables in it with both keys: "distortion.model"."""
    values: Values = {}
    for key, value in table.items():
        inner = value if isinstance(value, dict) and "data" not in value else {"": value}
        values |= {f"{key}.{below}" if below else str(key): _value(one) for below, one in inner.items()}
    return values


def _value(value: object) -> tuple[float, ...] | str:
    """A number, or the numbers of nested lists if they are few; other values as text."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    words: list[str] = []
    waiting = [value]
    for _ in range(_MAX_PARTS):
        if not waiting or len(words) > _MAX_NUMBERS:
            break
        first = waiting.pop(0)
        if isinstance(first, list):
            waiting[:0] = first[: _MAX_NUMBERS + 1]
        else:
            words += str(float(first) if isinstance(first, bool) else first).split()
    found = words_numbers(words) if len(words) <= _MAX_NUMBERS else ()
    # YAML lists may contain themselves, so their text may be endless.
    return found or ("[...]" if value and isinstance(value, dict | list) else str(value)[:80])
