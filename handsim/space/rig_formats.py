"""Readers of camera calibrations of Vicon, Qualisys, Motive and COLMAP; docs/rigs.md describes their axes.

Vicon's radial coefficients undistort points: a point at r pixels from the principal point moves to r (1 + k1
r^2 + k2 r^4 + k3 r^6). Qualisys uses OpenCV's lens, with v down, in 64ths of a sensor pixel. Motive's
`IntrinsicStandardCameraModel` has OpenCV's lens, and its `Intrinsic` a lens of Motive's own.
"""

from __future__ import annotations

import dataclasses
import io
import re
import struct
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple
from xml.parsers import expat

import numpy as np

from handsim.errors import HandSimWarning, RigError, choices, errors_of, shortened
from handsim.files.inputs import read_bytes, read_toml, shown, text_encoding, words_numbers
from handsim.space.camera import Camera, Lens, brown_lens, camera_matrix
from handsim.space.opencv_cameras import read_opencv_cameras
from handsim.space.rig import (
    NOT_IN_NAMES,
    camera_names,
    checked_cameras,
    foreign_cameras,
    nearest_rotation,
    read_rig_file,
)
from handsim.space.transforms import UpAxis, quaternion_matrix, rigid, room_axes

_MAX_VALUE: Final = 1e9  # largest number in a calibration, in any unit
_MAX_XML_BYTES: Final = 1 << 25  # These files also hold masks and thresholds of cameras.
_MAX_ELEMENTS: Final = 200_000
_MAX_DEPTH: Final = 64
_XML_DECLARATION: Final = re.compile(r"^\s*<\?xml[^>]*\?>")
_MILLIMETER: Final = 1e-3
_MAX_DISTORTION: Final = 0.5  # shift of a picture's corner, as a share of its distance from the center
_VIDEO_TYPES: Final = ("vue", "videoinputdevice")
_SUBPIXELS: Final = 64.0  # Qualisys' units per pixel
_TO_OPENCV: Final = np.diag([1.0, -1.0, -1.0])
_MOTIVE_LENS_KEYS: Final = ("k1", "k2", "TangentialX", "TangentialY", "k3")
_COLOR_IMAGER: Final = "30"  # `ImagerIndex` of Motive's color cameras
CAMERAS: Final = "cameras.txt"
IMAGES: Final = "images.txt"
_MAX_COLMAP_BYTES: Final = 1 << 28  # images.txt lists all points of each image
_COLMAP_MODELS: Final = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "OPENCV_FISHEYE": 8,
}
"""Known camera models, and their numbers of parameters."""
_COLMAP_MODEL_IDS: Final = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
_ONE_FOCAL: Final = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MIN_UPRIGHT: Final = 0.3  # mean component of the cameras' upward axes along the axis that points up
_OPENCV_ENDINGS: Final = (".yml", ".yaml", ".json")
_XML_ENDINGS: Final = (".xcp", ".xml", ".txt", ".mcal")
_CLOSED_FORMATS: Final = {
    ".cal": "Motive's .cal is a closed format; load it in Motive 3.2 or newer and export the calibration "
    "from there as .mcal",
    ".qca": "QTM's .qca is a closed format; export the calibration from QTM as .txt or .xml",
}


class LabCamera(NamedTuple):
    """A camera, with its pose in the calibration's world [m]."""

    camera: Camera
    video: bool = False
    """Whether the camera takes pictures and sees no markers."""
    y_up: bool = False
    """Whether the file states that y points up in its world."""


class Skipped(NamedTuple):
    """A camera without a pose in the calibration, and the reason."""

    name: str
    why: str


def _warn(sentence: str) -> None:
    warnings.warn(sentence, HandSimWarning, stacklevel=4)


class _Element(NamedTuple):
    """An element of XML, and the name of its camera in messages."""

    element: ET.Element
    owner: str

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Space-separated numbers of an attribute."""
        text = self.element.get(key)
        if text is None:
            raise RigError(f"{self.owner} lacks {key}")
        values = words_numbers(text.split())
        if len(values) != count or not all(abs(value) < _MAX_VALUE for value in values):  # never so for NaN
            expected = "a finite number" if count == 1 else f"{count} finite numbers"
            raise RigError(f"{self.owner}: {key} is {shown(text)}, expected {expected}")
        return values

    def number(self, key: str, default: float | None = None) -> float:
        """The number of an attribute, or `default` (unless None) if it is missing."""
        return self.numbers(key, 1)[0] if default is None or key in self.element.attrib else default

    def child(self, tag: str) -> _Element:
        """The first child of a tag."""
        found = self.element.find(tag)
        if found is None:
            raise RigError(f"{self.owner} lacks <{tag}>")
        return _Element(found, self.owner)


def picture_size(owner: str, width: float, height: float) -> tuple[int, int]:
    """Width and height [px]."""
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise RigError(f"{owner}: the picture is {width:g} x {height:g}, expected whole numbers of pixels")
    return int(width), int(height)


def read_xml(path: Path) -> ET.Element:
    """The root of an XML file in UTF-8, UTF-16 or Latin-1."""
    text = _decoded(path, read_bytes(path, error=RigError, max_bytes=_MAX_XML_BYTES))
    if "<!DOCTYPE" in text:
        raise RigError(f"{path}: the XML has a document type, which no calibration has; it is not read")
    root, depth = ET.Element(""), 0
    data = io.BytesIO(text.encode("utf-8", "surrogatepass"))
    try:
        for number, (event, element) in enumerate(ET.iterparse(data, ("start", "end"))):
            root, depth = element, depth + (1 if event == "start" else -1)
            if number > 2 * _MAX_ELEMENTS or depth > _MAX_DEPTH:
                raise RigError(
                    f"{path}: the XML has more than {_MAX_ELEMENTS} elements or is nested deeper than "
                    f"{_MAX_DEPTH}, expected the calibration of a camera system"
                )
    except ET.ParseError as error:
        reason = expat.ErrorString(error.code)
        raise RigError(
            f"{path}: not a calibration: it is no XML (line {error.position[0]}: {reason})"
        ) from error
    return root  # the last event is the end of the root


def _decoded(path: Path, data: bytes) -> str:
    """The text without its XML declaration, whose encoding is wrong in files of some programs."""
    try:
        text = data.decode(text_encoding(data))
    except UnicodeDecodeError as error:
        if not re.match(rb"\s*<\?xml[^>]*(8859-1|1252)", data[:200], re.I):
            raise RigError(f"{path}: not a calibration: it is no XML text") from error
        text = data.decode("latin-1")
    return _XML_DECLARATION.sub("", text, count=1)


def _vicon_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    device = entry.get("DEVICEID") or entry.get("USERID") or str(number)
    owner = f"camera {shown(device)}"
    frames = entry.findall("KeyFrames/KeyFrame")
    if not frames:
        return Skipped(device, "is not calibrated")
    if len(frames) > 1:
        _warn(f"{owner} moves: it has {len(frames)} key frames, of which the first is taken")
    outer, frame = _Element(entry, owner), _Element(frames[0], owner)
    size = picture_size(owner, *outer.numbers("SENSOR_SIZE", 2))
    focal, aspect = frame.number("FOCAL_LENGTH"), outer.number("PIXEL_ASPECT_RATIO", 1.0)
    if not aspect > 0.0:
        raise RigError(f"{owner}: PIXEL_ASPECT_RATIO is {aspect:g}, expected a positive number")
    K = camera_matrix(focal, focal / aspect, *frame.numbers("PRINCIPAL_POINT", 2))
    x, y, z, w = frame.numbers("ORIENTATION", 4)
    quaternion = np.array([w, x, y, z])
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-2:
        raise RigError(f"{owner}: ORIENTATION is a quaternion of length {length:.4g}, expected 1")
    pose = rigid(quaternion_matrix(quaternion).T, _MILLIMETER * np.array(frame.numbers("POSITION", 3)))
    kind = (entry.get("DISPLAY_TYPE") or entry.get("TYPE") or "").lower()
    video = entry.get("SYSTEM") == "DV" or entry.get("ISDV") == "1" or kind.startswith(_VIDEO_TYPES)
    camera = Camera(device, size, K, pose)
    return LabCamera(dataclasses.replace(camera, lens=_vicon_lens(frame, camera)), video=video)


def _vicon_lens(frame: _Element, camera: Camera) -> Lens:
    """Fit the inverse of Vicon's lens over the picture, because our lens distorts points."""
    straighten = _vicon_coefficients(frame)
    if not any(straighten):
        return Lens()
    center = camera.K[:2, 2]
    corner = float(np.hypot(*np.maximum(center, camera.size - center)))  # [px]
    measured = np.linspace(0.0, corner, 257)[1:]
    factor = 1.0 + sum(k * measured ** (2 * n) for n, k in enumerate(straighten, 1))
    if not np.abs(factor - 1.0).max() < _MAX_DISTORTION:
        _warn(f"{frame.owner}: its lens would move a corner by more than half its distance; it is left out")
        return Lens()
    straight = measured * factor / camera.K[0, 0]  # [focal lengths]
    powers = straight[:, None] ** np.array([2, 4, 6])
    fitted = np.linalg.lstsq(powers * straight[:, None], straight / factor - straight, rcond=None)[0]
    k1, k2, k3 = map(float, fitted)
    return Lens("brown", (k1, k2, 0.0, 0.0, k3))


def _vicon_coefficients(frame: _Element) -> tuple[float, ...]:
    """k1, k2, ... [1/px^2, 1/px^4, ...]; in VICON_RADIAL2 they follow a name and a center."""
    words = (frame.element.get("VICON_RADIAL2") or "").split()
    if words and len(words) != 6:
        raise RigError(
            f"{frame.owner}: VICON_RADIAL2 has {len(words)} words, expected a name and five numbers"
        )
    if words:
        newer = ET.Element("KeyFrame", {"VICON_RADIAL2": " ".join(words[1:])})
        return _Element(newer, frame.owner).numbers("VICON_RADIAL2", 5)[2:]
    return frame.numbers("VICON_RADIAL", 2) if frame.element.get("VICON_RADIAL") else ()


def _qualisys_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    serial = entry.get("serial") or str(number)
    camera = _Element(entry, f"camera {shown(serial)}")
    for key, why in (("active", "is switched off"), ("calibrated", "is not calibrated")):
        if entry.get(key, "1").lower() in ("0", "false"):
            return Skipped(serial, why)
    video = any(word in entry.get("model", "").lower() for word in ("video", "hybrid"))
    inner, place = camera.child("intrinsic"), camera.child("transform")
    view, other = ("fov_video", "fov_marker") if video else ("fov_marker", "fov_video")
    area = camera.child(view if entry.find(view) is not None else other)
    left, top, right, bottom = (area.number(side) for side in ("left", "top", "right", "bottom"))
    if right <= left or bottom <= top:
        raise RigError(
            f"{camera.owner}: <{area.element.tag}> is empty, expected left < right and top < bottom"
        )
    size = picture_size(camera.owner, right - left + 1, bottom - top + 1)
    scale = 1.0 / (_SUBPIXELS * _binning(camera, view, inner))
    u, v = (inner.number(f"centerPoint{axis}") * scale for axis in "UV")
    fx, fy = (inner.number(f"focalLength{axis}") * scale for axis in "UV")
    K = camera_matrix(fx, fy, u - left, v - top)
    rows = [[place.number(f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)]
    axes = nearest_rotation(f"{camera.owner}: the matrix r11 to r33", np.array(rows))
    position = np.array([place.number(axis) for axis in "xyz"])
    k1, k2, k3 = (inner.number(f"radialDistortion{n}", 0.0) for n in (1, 2, 3))
    p1, p2 = (inner.number(f"tangentalDistortion{n}", 0.0) for n in (1, 2))
    pose = rigid(axes.T @ _TO_OPENCV, _MILLIMETER * position)
    return LabCamera(Camera(serial, size, K, pose, brown_lens(k1, k2, p1, p2, k3)), video=video)


def _binning(camera: _Element, view: str, inner: _Element) -> int:
    """Sensor pixels per picture pixel, each way."""
    if camera.element.find(f"{view}_max") is None:
        return 1
    whole = camera.child(f"{view}_max")
    width = whole.number("right") - whole.number("left") + 1
    span = inner.number("sensorMaxU", 0.0) - inner.number("sensorMinU", 0.0)
    return max(1, round(span / _SUBPIXELS / width)) if width > 0 else 1


def _motive_camera(entry: ET.Element, number: int) -> LabCamera | Skipped:
    serial = entry.get("Serial") or str(number)
    camera = _Element(entry, f"camera {shown(serial)}")
    properties = entry.find("Properties")
    own = {} if properties is None else properties.attrib
    if own.get("Enabled") == "0":
        return Skipped(serial, "is switched off")
    standard = entry.find("IntrinsicStandardCameraModel") is not None
    lens = "IntrinsicStandardCameraModel" if standard else "Intrinsic"
    if entry.find("Extrinsic") is None or entry.find(lens) is None:
        return Skipped(serial, "is not calibrated")
    imager, outer, inner = (camera.child(tag) for tag in ("Attributes", "Extrinsic", lens))
    size = picture_size(camera.owner, *(imager.number(f"ImagerPixel{side}") for side in ("Width", "Height")))
    fx, fy = (inner.number(f"{way}FocalLength") for way in ("Horizontal", "Vertical"))
    cx, cy = (inner.number(f"LensCenter{axis}") for axis in "XY")
    K = camera_matrix(fx, fy, cx, cy)
    matrix = np.array([outer.number(f"OrientMatrix{n}") for n in range(9)]).reshape(3, 3)
    axes = nearest_rotation(f"{camera.owner}: OrientMatrix", matrix)
    position = np.array([outer.number(axis) for axis in "XYZ"])
    bends = [inner.number(key, 0.0) for key in _MOTIVE_LENS_KEYS] if standard else []
    video = serial.startswith("C") or own.get("ImagerIndex") == _COLOR_IMAGER
    pose = rigid(axes @ _TO_OPENCV, position)
    return LabCamera(Camera(serial, size, K, pose, brown_lens(*bends)), video=video, y_up=True)


def read_colmap_cameras(path: Path) -> tuple[Camera, ...]:
    """A camera for each image of a reconstruction in meters, with the name of the image."""
    folder = path if path.is_dir() else path.parent
    cameras, images = folder / CAMERAS, folder / IMAGES
    is_binary = cameras.with_suffix(".bin").is_file()
    if not (is_binary or cameras.is_file()):
        raise RigError(
            f"{folder}: no {CAMERAS} and no {cameras.stem}.bin; give the folder in which COLMAP wrote them, "
            "such as sparse/0"
        )
    if is_binary and not cameras.is_file():
        cameras, images = cameras.with_suffix(".bin"), images.with_suffix(".bin")
        lines = [_binary_lines(cameras, _binary_lens), _binary_lines(images, _binary_image)]
    else:
        # Each image has two lines, the second one with its points.
        lines = [_colmap_lines(cameras), _colmap_lines(images, keep_empty=True)[::2]]
    lenses = dict(_colmap_lens(cameras, line) for line in lines[0])
    return checked_cameras(images, [_colmap_image(images, line, lenses) for line in lines[1]])


def _binary_lines(path: Path, read: Callable[[bytes, int], tuple[int, str]]) -> list[str]:
    """The records of a binary file of COLMAP, in the form of lines of its text file."""
    data, at, lines = read_bytes(path, error=RigError, max_bytes=_MAX_COLMAP_BYTES), 8, []
    try:
        for _ in range(*struct.unpack_from("<Q", data)):
            at, line = read(data, at)
            lines.append(line)
        if at > len(data):
            raise ValueError("points are cut")
    except (struct.error, ValueError, LookupError, OverflowError) as error:
        raise RigError(
            f"{path}: cut or damaged, or of an unknown version of COLMAP; colmap model_converter writes text"
        ) from error
    return lines


def _binary_lens(data: bytes, at: int) -> tuple[int, str]:
    """The end of a record of a camera, and its line."""
    number, model, width, height = struct.unpack_from("<iiQQ", data, at)
    name = _COLMAP_MODEL_IDS[model] if model >= 0 else ""
    count = {**_COLMAP_MODELS, "FOV": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16}[name]
    parameters = struct.unpack_from(f"<{count}d", data, at + 24)
    return at + 24 + 8 * count, " ".join(map(str, (number, name, width, height, *parameters)))


def _binary_image(data: bytes, at: int) -> tuple[int, str]:
    """The end of a record of an image, with its points, and its line."""
    values = struct.unpack_from("<i7di", data, at)
    end = data.index(b"\0", at + 64)
    name = " ".join(data[at + 64 : end].decode("utf-8", "replace").split())  # fit for a line of text
    (points,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * points, " ".join(map(str, (*values, name)))


def _colmap_lines(path: Path, *, keep_empty: bool = False) -> list[str]:
    """Lines without comments; with `keep_empty` also the empty lines of images without points."""
    try:
        text = read_bytes(path, error=RigError, max_bytes=_MAX_COLMAP_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RigError(
            f"{path}: not COLMAP's text: it is not UTF-8; colmap model_converter writes it"
        ) from error
    lines = [line.strip() for line in text.splitlines() if not line.startswith("#")]
    if not keep_empty:
        return [line for line in lines if line]
    while lines and not lines[-1]:
        lines.pop()
    return lines


def _colmap_lens(path: Path, line: str) -> tuple[str, Camera]:
    """`CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`."""
    number, *rest = line.split()
    owner = f"{path}: camera {shortened(number)}"
    if len(rest) < 3:
        raise RigError(f"{owner} has {1 + len(rest)} values, expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    model = rest[0]
    if model not in _COLMAP_MODELS:
        raise RigError(f"{owner}: {choices(model, _COLMAP_MODELS, noun='model')}")
    width, height, *parameters = _numbers(owner, rest[1:])
    if len(parameters) != _COLMAP_MODELS[model] or not (width.is_integer() and height.is_integer()):
        raise RigError(
            f"{owner}: {width:g} x {height:g} pixels and {len(parameters)} parameters, expected whole "
            f"numbers and {_COLMAP_MODELS[model]} parameters of {model}"
        )
    if model in _ONE_FOCAL:
        parameters.insert(0, parameters[0])
    with errors_of(owner, RigError):
        K, lens = camera_matrix(*parameters[:4]), _colmap_distortion(model, parameters[4:])
        return number, Camera(number, (int(width), int(height)), K, lens=lens)


def _colmap_distortion(model: str, bent: list[float]) -> Lens:
    if model.endswith("FISHEYE"):
        return Lens("fisheye", (*bent, 0.0, 0.0, 0.0)[:4])
    if model.endswith("RADIAL"):
        return brown_lens(*(*bent, 0.0)[:2], 0.0, 0.0, 0.0)
    if any(bent[5:]):
        raise RigError("k4, k5 or k6 of FULL_OPENCV is not 0, expected the model OPENCV")
    return brown_lens(*(*bent, *[0.0] * 5)[:5])


def _colmap_image(path: Path, line: str, lenses: dict[str, Camera]) -> Camera:
    """`IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, with the pose of the world in the camera's frame."""
    words = line.split(maxsplit=9)
    if len(words) != 10:
        raise RigError(
            f"{path}: the line '{shortened(line)}' has {len(words)} values, expected "
            "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points after it"
        )
    owner = f"{path}: image {shortened(words[0])}"
    pose = np.array(_numbers(owner, words[1:8]))
    length = float(np.linalg.norm(pose[:4]))
    if abs(length - 1.0) > 1e-3:
        raise RigError(f"{owner}: a quaternion of length {length:.4g}, expected 1")
    if words[8] not in lenses:
        raise RigError(f"{owner}: {choices(words[8], lenses, noun='camera')}")
    R_world_camera = quaternion_matrix(pose[:4] / length).T
    lens = lenses[words[8]]
    name = NOT_IN_NAMES.sub("_", words[9].rpartition(".")[0] or words[9])[-64:]
    return Camera(name, lens.size, lens.K, rigid(R_world_camera, -R_world_camera @ pose[4:]), lens.lens)


def _numbers(owner: str, words: list[str]) -> list[float]:
    for word in words:
        (value,) = words_numbers([word]) or (np.nan,)
        if not abs(value) < _MAX_VALUE:
            raise RigError(f"{owner}: '{shortened(word)}' is no number that fits")
    return list(words_numbers(words))


_XML_READERS: Final[dict[str, tuple[str, Callable[[ET.Element, int], LabCamera | Skipped]]]] = {
    "Cameras": ("Camera", _vicon_camera),
    "calibration": ("camera", _qualisys_camera),
    "calibrationProfile": ("Camera", _motive_camera),
}
"""The tag of the cameras and the reader of one, by the root's tag."""


def load_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Read the cameras of a file by its ending."""
    return tuple(one.camera for one in load_lab_cameras(path))


def import_cameras(path: str | Path, up: UpAxis | None = None) -> tuple[Camera, ...]:
    """The cameras of a calibration that see markers, in a world whose z axis points up."""
    found = load_lab_cameras(path)
    seeing = [one for one in found if not one.video] or list(found)
    if len(seeing) < len(found):
        named = ", ".join(one.camera.name for one in found if one.video)
        _warn(f"{path}: video cameras see no markers and are left out: {named}")
    axis: UpAxis = up or ("y" if all(one.y_up for one in seeing) else "z")
    turn = rigid(room_axes(axis), np.zeros(3))
    cameras = tuple(one.camera.at(turn @ one.camera.T_world_camera) for one in seeing)
    # Labs may turn cameras on their sides, and a single camera often has no pose.
    guessed = len(seeing) > 1 and not (seeing[0].y_up and axis == "y")
    if guessed and -np.mean([one.T_world_camera[2, 1] for one in cameras]) < _MIN_UPRIGHT:
        _warn(
            f"{path}: with {axis} up, the tops of its cameras' pictures do not point up on average; is "
            "another axis up? --up says which"
        )
    return cameras


def load_lab_cameras(path: str | Path) -> tuple[LabCamera, ...]:
    """Read the cameras of a file by its ending, with the facts that the file states on each: video, y up."""
    path, ending = Path(path), Path(path).suffix.lower()
    if ending == ".toml" and not foreign_cameras(read_toml(path, error=RigError)):
        return tuple(map(LabCamera, checked_cameras(path, read_rig_file(path).cameras)))
    if ending in (*_OPENCV_ENDINGS, ".toml"):
        return tuple(map(LabCamera, read_opencv_cameras(path)))
    if path.is_dir() or (path.stem in ("cameras", "images") and ending in (".txt", ".bin")):
        return tuple(map(LabCamera, read_colmap_cameras(path)))
    if ending in _CLOSED_FORMATS:
        raise RigError(f"{path}: {_CLOSED_FORMATS[ending]}")
    if ending in _XML_ENDINGS:
        return _xml_cameras(path)
    hint = "; colmap model_converter writes text" if ending == ".bin" else ""
    raise RigError(
        f"{path}: unknown kind of camera file, expected .toml, Vicon's .xcp, Qualisys' .xml or .txt, "
        f"Motive's .mcal, OpenCV's .yml or .json, or COLMAP's {CAMERAS} and {IMAGES}{hint}"
    )


def _xml_cameras(path: Path) -> tuple[LabCamera, ...]:
    root = read_xml(path)
    tags = [root.tag, *(entry.tag for entry in root)]  # QTM's server wraps its answer
    known = next((tag for tag in tags if tag in _XML_READERS), None)
    if known is None:
        raise RigError(
            f"{path}: its XML begins with <{shortened(root.tag)}>, expected <{'>, <'.join(_XML_READERS)}>: "
            "Vicon's, Qualisys' or Motive's calibration; OpenCV's is read as .yml"
        )
    with errors_of(path, RigError):
        tag, read_camera = _XML_READERS[known]
        read = [read_camera(entry, number) for number, entry in enumerate(root.iter(tag), 1)]
    skipped = [one for one in read if isinstance(one, Skipped)]
    if skipped:
        named = ", ".join(f"{shortened(one.name)} {one.why}" for one in skipped[:8])
        more = f" and {len(skipped) - 8} more" if len(skipped) > 8 else ""
        _warn(f"{path}: {len(skipped)} of {len(read)} cameras are left out: {named}{more}")
    found = [one for one in read if isinstance(one, LabCamera)]
    names = camera_names([one.camera.name for one in found])
    renamed = [
        one._replace(camera=dataclasses.replace(one.camera, name=name))
        for one, name in zip(found, names, strict=True)
    ]
    checked_cameras(path, [one.camera for one in renamed])
    return tuple(renamed)
