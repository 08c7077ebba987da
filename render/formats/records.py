"""Encodes pictures, masks and JSON for all file formats, and has the joint order of UmeTrack.

We count pixels from the picture's corner, so that the first center is at 0.5. OpenCV, UmeTrack and COCO's
keypoints count from the first center: `CENTER` is subtracted for them.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.errors import DatasetError, HandSimError
from handsim.files.outputs import atomic_write, plain_json, plain_path, unwritten
from handsim.hand.shape import NUM_KEYPOINTS, Side
from handsim.kernels import kernel
from handsim.space.camera import Camera
from handsim.space.transforms import rotation_quaternions
from render.color_sensor import linear_of
from render.formats.png import encode_png
from render.frames import (
    Doubles,
    Flags,
    Floats,
    HandTruth,
    Integers,
    Pictures,
    RenderedFrame,
)

CENTER: Final = 0.5
"""Center of the first pixel in our count [px]."""
_DIGITS: Final = tuple(tuple(range(first, first + 4)) for first in range(1, NUM_KEYPOINTS, 4))
UMETRACK_JOINTS: Final = [
    *(digit[3] for digit in _DIGITS), 0, 2, 3, *(joint for digit in _DIGITS[1:] for joint in digit[:3])
]  # fmt: skip
"""Index in `KEYPOINT_NAMES` of every joint of UmeTrack and HOT3D.

They have five tips, the wrist, the thumb without its base, and three joints per finger.
"""
METERS_PER_UNIT: Final = 1e-4
"""Unit of a depth picture [m]."""
_UNIT_KEYWORD: Final = "metres_per_unit"
_NORMAL_ZERO, _NORMAL_SCALE = 128, 127
_RGB: Final = ("R", "G", "B")
_NORMALS: Final = ("N.X", "N.Y", "N.Z")
_IDS: Final = {"parts": "id.part", "instances": "id.instance", "markers": "id.marker"}
_SENSOR_PREFIX: Final = "sensor."


def labeled_keypoints(label: Mapping[str, Any]) -> tuple[Doubles, Doubles]:
    """Keypoints (21, 2) [px] from the picture's corner, and flags (21,), of an annotation of COCO's.

    Raises:
        DatasetError: There is another number of keypoints.
    """
    rows = np.asarray(label["keypoints"], dtype=np.float64)
    if rows.shape != (3 * NUM_KEYPOINTS,):
        raise DatasetError(
            f"{rows.size} numbers of keypoints of a hand, expected {3 * NUM_KEYPOINTS}: x, y and visibility "
            f"of {NUM_KEYPOINTS}"
        )
    return rows.reshape(-1, 3)[:, :2] + CENTER, rows[2::3]


def shifted_K(camera: Camera) -> Doubles:
    """Camera matrix for pixels that are counted from the first one's center."""
    K = camera.K.copy()
    K[:2, 2] -= CENTER
    return K


def as_sensed(frame: RenderedFrame) -> Pictures:
    """The frame's pictures as its camera takes them: noisy ones instead of ideal ones."""
    noisy = {name: getattr(frame.noisy, name) for name in ("rgb", "depth")}
    return dataclasses.replace(frame.ideal, **{name: one for name, one in noisy.items() if one is not None})


def is_seen(hand: HandTruth) -> bool:
    """Whether any part of the hand is in the picture."""
    return bool(np.isfinite(hand.box).all())


def keypoint_flags(pixels: Doubles, visible: Flags, size: tuple[int, int]) -> Integers:
    """COCO's flags (K,) of keypoints in a picture of this size [px]: 0 outside, 1 hidden, 2 visible."""
    inside = np.all((pixels >= 0.0) & (pixels < size), axis=1)  # False for NaN
    return np.where(inside, np.where(visible, 2, 1), 0)


def run_lengths(mask: Flags) -> str:
    """COCO's compressed run lengths of a mask (H, W): zeros and ones in turn, column by column.

    A length is stored as its difference from the length two runs before, in groups of five bits, the lowest
    first. A sixth bit says that more groups follow, and 48 is added to make each group a letter.
    """
    flat = cv2.transpose(mask.view(np.uint8)).ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.concatenate([[0], changes, [flat.size]])
    counts: list[int] = [0] * int(flat[0]) + np.diff(ends).tolist()
    letters = bytearray()
    for number, count in enumerate(counts):
        rest = count - counts[number - 2] if number > 2 else count
        more = True
        while more:
            piece, rest = rest & 31, rest >> 5
            more = rest != (-1 if piece & 16 else 0)
            letters.append(48 + piece + 32 * more)
    return letters.decode("ascii")


def by_side(frame: RenderedFrame) -> dict[Side, HandTruth]:
    """The frame's hands by their sides."""
    hands = {hand.shape.side: hand for hand in frame.hands}
    if len(hands) < len(frame.hands):
        sides = " and ".join(hand.shape.side for hand in frame.hands)
        raise HandSimError(
            f"frame {frame.number} has hands {sides}; this format holds at most one of each side"
        )
    return hands


def rigid_record(transform: Doubles) -> dict[str, list[float]]:
    """A rigid transform (4, 4) as quaternion (wxyz) and translation [m]."""
    return {
        "quaternion_wxyz": rotation_quaternions(transform[None, :3, :3])[0].tolist(),
        "translation_xyz": transform[:3, 3].tolist(),
    }


def body_records(frame: RenderedFrame) -> list[dict[str, Any]]:
    """Names and poses in the world of a frame's rigid bodies."""
    return [{"name": body.name, "T_world_body": body.T_world_body.tolist()} for body in frame.bodies]


def rounded(values: NDArray[np.floating], decimals: int) -> Any:
    """Numbers as nested lists, rounded to some decimals."""
    return np.round(np.asarray(values, dtype=np.float64), decimals).tolist()


def to_json(content: Any) -> str:
    """JSON of plain values and arrays; null for NaN, which strict readers refuse."""
    try:
        return json.dumps(content, default=_as_plain, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError):  # `plain_json` is slower, but knows NaN and more types
        return json.dumps(plain_json(content), allow_nan=False, separators=(",", ":"))


def _as_plain(content: Any) -> Any:
    if isinstance(content, np.ndarray | np.generic):
        return content.tolist()
    raise TypeError


def encode_jpeg(picture: UInt8[np.ndarray, "H W 3"], *, quality: int = 95) -> bytes:
    """Encode an sRGB picture as JPEG."""
    ordered = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "JPEG holds any picture"
    return data.tobytes()


def encode_depth(depth: Float32[np.ndarray, "H W"]) -> bytes:
    """Encode depth [m] as 16-bit gray PNG, with the unit as text `metres_per_unit`; 0 for too large depth."""
    return encode_png(_depth_steps(np.ascontiguousarray(depth)), text={_UNIT_KEYWORD: repr(METERS_PER_UNIT)})


@kernel
def _depth_steps(depth: Floats) -> Any:
    """Depth (H, W) in whole units; 0 for NaN and for depth beyond 65535 units."""
    steps = np.zeros(depth.shape, np.uint16)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            step = np.rint(depth[row, column] / METERS_PER_UNIT)
            if 0.0 < step <= 65535:  # False for NaN
                steps[row, column] = int(step)
    return steps


def encode_ids(pictures: Pictures) -> bytes | None:
    """Encode parts, instances and markers as red, green and blue of one PNG; None for no ids."""
    if pictures.parts is None or pictures.instances is None or pictures.markers is None:
        return None
    return encode_png(cv2.merge([pictures.parts, pictures.instances, pictures.markers]))


def encode_normals(normals: Float32[np.ndarray, "H W 3"]) -> bytes:
    """Encode unit normals as 8-bit PNG: x, y, z are (red, green, blue - 128) / 127; black for no surface."""
    return encode_png(_normal_levels(np.ascontiguousarray(normals)))


@kernel
def _normal_levels(normals: Floats) -> Any:
    """Normals (H, W, 3) as bytes."""
    levels = np.zeros(normals.shape, np.uint8)
    for row in range(normals.shape[0]):
        for column in range(normals.shape[1]):
            x, y, z = normals[row, column]
            if x != 0.0 or y != 0.0 or z != 0.0:
                levels[row, column, 0] = int(np.rint(x * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 1] = int(np.rint(y * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 2] = int(np.rint(z * _NORMAL_SCALE)) + _NORMAL_ZERO
    return levels


def encode_pictures(frame: RenderedFrame, *, lossless: bool) -> dict[str, bytes]:
    """Files of a frame's pictures by suffix: those of its camera, and ideal depth beside noisy depth."""
    pictures, files = as_sensed(frame), dict[str, bytes]()
    if pictures.rgb is not None:
        files[".png" if lossless else ".jpg"] = (encode_png if lossless else encode_jpeg)(pictures.rgb)
    if pictures.depth is not None:
        files[".depth.png"] = encode_depth(pictures.depth)
    if frame.noisy.depth is not None and frame.ideal.depth is not None:
        files[".depth_ideal.png"] = encode_depth(frame.ideal.depth)
    if pictures.normals is not None:
        files[".normals.png"] = encode_normals(pictures.normals)
    ids = encode_ids(pictures)
    if ids is not None:
        files[".ids.png"] = ids
    return files


def write_exr(path: str | Path, frame: RenderedFrame) -> None:
    """Write all pictures of a frame and its camera."""
    import OpenEXR

    noisy = {_SENSOR_PREFIX + name: values for name, values in _channels(frame.noisy).items()}
    channels = _channels(frame.ideal) | noisy
    record = frame.camera.record()
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "units": "m",
        "camera": frame.camera.name,
        "K": frame.camera.K,
        "T_world_camera": frame.camera.T_world_camera,
        "lens": json.dumps(record["lens"]),
    }
    with atomic_write(path) as temporary, plain_path(temporary) as plain:
        try:
            OpenEXR.File(header, channels).write(str(plain))
        except RuntimeError as error:  # raised on a full disk
            raise unwritten(temporary) from error


def _channels(pictures: Pictures) -> dict[str, NDArray[Any]]:
    channels: dict[str, NDArray[Any]] = {}
    if pictures.rgb is not None:
        light = linear_of(pictures.rgb) if pictures.light is None else pictures.light
        channels |= {name: light[..., index].astype(np.float16) for index, name in enumerate(_RGB)}
    if pictures.depth is not None:
        channels["Z"] = pictures.depth.astype(np.float32)
    if pictures.normals is not None:
        normals = pictures.normals.astype(np.float16)
        channels |= {name: normals[..., index] for index, name in enumerate(_NORMALS)}
    for field, name in _IDS.items():
        ids = getattr(pictures, field)
        if ids is not None:
            channels[name] = ids.astype(np.float16)
    return {name: np.ascontiguousarray(values) for name, values in channels.items()}
