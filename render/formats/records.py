"""What the file formats share: encoded pictures, masks, JSON, and joint orders of other data sets.

We count pixels from the picture's corner, so that the first center is at 0.5. OpenCV, and with it FreiHAND,
InterHand2.6M, UmeTrack and COCO's keypoints, count from the first center: `CENTER` is subtracted for them.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import ArgumentError, HandSimError
from handsim.files.outputs import atomic_write, plain_path, unwritten
from handsim.hand.shape import NUM_KEYPOINTS, HandShape, Side
from handsim.kernels import kernel
from handsim.space.camera import Camera
from handsim.space.transforms import rotation_quaternions
from render.color_sensor import linear_of
from render.frames import FOREARM, PARTS_A_HAND, Doubles, Flags, Floats, HandTruth, Pictures, RenderedFrame

CENTER: Final = 0.5
"""Where our count of pixels has the first one's center [px]."""


def shifted_K(camera: Camera) -> Doubles:
    """K for pixels that are counted from the first one's center; a lens is left to its coefficients."""
    K = camera.K.copy()
    K[:2, 2] -= CENTER
    return K


def centered_K(camera: Camera) -> Doubles:
    """`shifted_K` of a pinhole, which alone projects points; other lenses are refused."""
    if camera.lens.kind != "pinhole":
        raise HandSimError(
            f"camera '{camera.name}' has a lens '{camera.lens.kind}', which this format cannot hold; "
            "expected a pinhole camera, or the format webdataset, coco, yolo, exr or png"
        )
    return shifted_K(camera)


def as_sensed(frame: RenderedFrame) -> Pictures:
    """The frame's pictures as its camera has them: the noisy ones where there are any."""
    ideal, noisy = frame.ideal, frame.noisy
    return Pictures(
        rgb=ideal.rgb if noisy.rgb is None else noisy.rgb,
        depth=ideal.depth if noisy.depth is None else noisy.depth,
        normals=ideal.normals,
        parts=ideal.parts,
        instances=ideal.instances,
        markers=ideal.markers,
    )


def is_seen(hand: HandTruth) -> bool:
    """Whether any of the hand is in the picture."""
    return bool(np.isfinite(hand.box).all())


def keypoint_flags(hand: HandTruth, size: tuple[int, int]) -> Int[np.ndarray, "21"]:
    """COCO's flags of keypoints in a picture of this size [px]: 0 outside it, 1 hidden, 2 seen."""
    inside = np.all((hand.keypoints >= 0.0) & (hand.keypoints < size), axis=1)  # never so for NaN
    return np.where(inside, np.where(hand.visible, 2, 1), 0)


def hand_mask(frame: RenderedFrame, hand: int) -> Bool[np.ndarray, "H W"] | None:
    """Mask of one hand of a frame with its markers, without its forearm; None without an id picture."""
    parts, instances = frame.ideal.parts, frame.ideal.instances
    first = 1 + PARTS_A_HAND * hand
    if instances is not None:
        mask: Flags = instances == hand + 1
        return mask if parts is None else mask & (parts != first + FOREARM)
    if parts is not None:
        return (parts >= first) & (parts < first + FOREARM)
    return None


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """COCO's uncompressed run lengths: of alternating zeros and ones, zeros first, column by column."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.concatenate([[0], changes, [flat.size]])
    counts: list[int] = np.diff(ends).tolist()
    return [0, *counts] if flat[0] else counts


def by_side(frame: RenderedFrame) -> dict[Side, HandTruth]:
    """The frame's hands by their sides."""
    hands = {hand.shape.side: hand for hand in frame.hands}
    if len(hands) < len(frame.hands):
        sides = " and ".join(hand.shape.side for hand in frame.hands)
        raise HandSimError(
            f"frame {frame.number} has hands {sides}; this format holds at most one of each side"
        )
    return hands


def without_colors(name: str) -> HandSimError:
    """The error for a format that needs color pictures."""
    return HandSimError(f"the format {name} needs color pictures; add rgb to the passes")


def rigid_record(transform: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """A rigid transform as quaternion (wxyz) and translation [m]."""
    return {
        "quaternion_wxyz": rotation_quaternions(transform[None, :3, :3])[0].tolist(),
        "translation_xyz": transform[:3, 3].tolist(),
    }


def shape_record(shape: HandShape) -> dict[str, Any]:
    """A person's hand as JSON; the fields of `HandShape`."""
    fields = {name: getattr(shape, name) for name in HandShape.__dataclass_fields__}
    return {name: _listed(x) if isinstance(x, np.ndarray | np.generic) else x for name, x in fields.items()}


def rounded(values: NDArray[np.floating], decimals: int) -> Any:
    """Numbers as nested lists, short enough to be read."""
    return np.round(np.asarray(values, dtype=np.float64), decimals).tolist()


def to_json(content: Any) -> str:
    """JSON of plain values and arrays; null for NaN, which strict readers refuse."""
    try:
        return json.dumps(content, default=_listed, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError):  # something the quick way has no word for
        return json.dumps(_plain(content), allow_nan=False, separators=(",", ":"))


def _listed(content: Any) -> Any:
    if isinstance(content, np.ndarray | np.generic):
        return content.tolist()
    raise TypeError


def _plain(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value) for value in content]
    if isinstance(content, np.ndarray | np.generic):
        return _plain(content.tolist())
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


# Joint orders, in one table because a wrong permutation looks almost right:
# - FreiHAND, MediaPipe and COCO-WholeBody: wrist, then thumb to little, base to tip. This is ours.
# - MANO with its tips appended, as in HO-3D and H2O-3D: wrist, three joints each of index, middle, little,
#   ring and thumb, then the tips from thumb to little.
# - InterHand2.6M: thumb to little, tip to base, then the wrist; its files have a right hand and a left one.
# - HANDS17 and BigHand2.2M: wrist, five first joints, then the other three per digit.
# - OpenXR: palm, wrist, four of the thumb, five per finger from its metacarpal on; WebXR has no palm.
# - UmeTrack and HOT3D: five tips, wrist, thumb without its base, three joints per finger; with 21 landmarks
#   the palm's center comes last.
ABSENT: Final = -1
"""Index of a joint that we lack."""
_WRIST: Final = 0
_THUMB, _INDEX, _MIDDLE, _RING, _LITTLE = _DIGITS = tuple(
    tuple(range(4 * digit + 1, 4 * digit + 5)) for digit in range(5)
)


def _flat(*parts: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(chain.from_iterable(parts))


_OURS: Final = tuple(range(NUM_KEYPOINTS))
_TIPS: Final = tuple(digit[3] for digit in _DIGITS)
_MANO: Final = _flat((_WRIST,), *(digit[:3] for digit in (_INDEX, _MIDDLE, _LITTLE, _RING, _THUMB)), _TIPS)
_INTERHAND: Final = _flat(*(digit[::-1] for digit in _DIGITS), (_WRIST,))
_HANDS17: Final = _flat((_WRIST,), tuple(digit[0] for digit in _DIGITS), *(digit[1:] for digit in _DIGITS))
_WEBXR: Final = _flat((_WRIST,), _THUMB, *((ABSENT, *digit) for digit in _DIGITS[1:]))
_UMETRACK: Final = _flat(_TIPS, (_WRIST,), _THUMB[1:3], *(digit[:3] for digit in _DIGITS[1:]))

JOINT_ORDERS: Final[dict[str, tuple[int, ...]]] = {
    "handsim": _OURS,
    "freihand": _OURS,
    "mediapipe": _OURS,
    "coco_wholebody_hand": _OURS,
    "mano": _MANO,
    "ho3d": _MANO,
    "interhand": _INTERHAND,
    "hands17": _HANDS17,
    "bighand": _HANDS17,
    "openxr": (ABSENT, *_WEBXR),
    "webxr": _WEBXR,
    "umetrack": _UMETRACK,
    "hot3d": _UMETRACK,
    "umetrack21": (*_UMETRACK, ABSENT),
}
"""Index in `KEYPOINT_NAMES` of every joint of an order."""


def joint_order(name: str) -> tuple[int, ...]:
    """One of `JOINT_ORDERS`."""
    check_choice(name, JOINT_ORDERS, noun="joint order")
    return JOINT_ORDERS[name]


def to_order(points: Float[np.ndarray, "*batch 21 k"], name: str) -> Float[np.ndarray, "*batch n k"]:
    """Our keypoints, or other rows with one per keypoint, in one of `JOINT_ORDERS`; NaN for those we lack."""
    order, points = list(joint_order(name)), _rows(points, NUM_KEYPOINTS, "our keypoints")
    nowhere = np.full_like(points[..., :1, :], np.nan)
    return np.concatenate([points, nowhere], axis=-2)[..., order, :]


def _rows(points: NDArray[np.floating], count: int, noun: str) -> NDArray[np.floating]:
    points = np.asarray(points)
    if points.ndim < 2 or points.shape[-2] != count:
        raise ArgumentError(f"{noun} have shape {points.shape}, expected (..., {count}, k)")
    return points if np.issubdtype(points.dtype, np.floating) else points.astype(np.float64)


METERS_PER_UNIT: Final = 1e-4
"""Unit of a depth picture [m]."""
_KEYWORD: Final = b"metres_per_unit"
_FIRST_CHUNK: Final = slice(8, 33)  # IHDR: length, name, 13 bytes, checksum
_MOST: Final = 65535
_NORMAL_ZERO, _NORMAL_SCALE = 128, 127
_JPEG_QUALITY: Final = 95


def encode_png(picture: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """An sRGB picture as PNG."""
    return _encode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def encode_jpeg(picture: UInt8[np.ndarray, "H W *C"], *, quality: int = _JPEG_QUALITY) -> bytes:
    """An sRGB or gray picture as JPEG."""
    ordered = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    return _encode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_depth(depth: Float32[np.ndarray, "H W"]) -> bytes:
    """Depth [m] as 16-bit gray PNG, with its unit in a text chunk `metres_per_unit`.

    0, NaN and what does not fit into 65535 units become 0.
    """
    data = _encode(".png", _depth_steps(np.ascontiguousarray(depth)))
    text = _KEYWORD + b"\0" + repr(METERS_PER_UNIT).encode("ascii")
    end = _FIRST_CHUNK.stop
    return data[:end] + _chunk(b"tEXt", text) + data[end:]


@kernel
def _depth_steps(depth: Floats) -> Any:
    """Depth (H, W) in whole units; 0 for what does not fit."""
    steps = np.zeros(depth.shape, np.uint16)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            step = np.rint(depth[row, column] / METERS_PER_UNIT)
            if 0.0 < step <= _MOST:  # never so for NaN
                steps[row, column] = int(step)
    return steps


def encode_ids(pictures: Pictures) -> bytes | None:
    """Parts, instances and markers as red, green and blue of one PNG; None when there are none of them."""
    layers = (pictures.parts, pictures.instances, pictures.markers)
    known = [layer for layer in layers if layer is not None]
    if not known:
        return None
    return encode_png(np.stack([np.zeros_like(known[0]) if x is None else x for x in layers], axis=-1))


def encode_normals(normals: Float32[np.ndarray, "H W 3"]) -> bytes:
    """Unit normals as 8-bit PNG: x, y, z are (red, green, blue - 128) / 127; black is nothing."""
    return _encode(".png", _normal_levels(np.ascontiguousarray(normals)))


@kernel
def _normal_levels(normals: Floats) -> Any:
    """Normals (H, W, 3) as bytes, z first as OpenCV has blue."""
    levels = np.zeros(normals.shape, np.uint8)
    for row in range(normals.shape[0]):
        for column in range(normals.shape[1]):
            x, y, z = normals[row, column]
            if x != 0.0 or y != 0.0 or z != 0.0:
                levels[row, column, 2] = int(np.rint(x * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 1] = int(np.rint(y * _NORMAL_SCALE)) + _NORMAL_ZERO
                levels[row, column, 0] = int(np.rint(z * _NORMAL_SCALE)) + _NORMAL_ZERO
    return levels


def encode_pictures(frame: RenderedFrame, *, lossless: bool) -> dict[str, bytes]:
    """Files of a frame's pictures as its camera has them, and of ideal depth beside noisy, by suffix."""
    pictures = as_sensed(frame)
    files: dict[str, bytes] = {}
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


def _encode(suffix: str, picture: NDArray[Any], options: list[int] | None = None) -> bytes:
    done, data = cv2.imencode(suffix, np.ascontiguousarray(picture), options or [])
    assert done, "these formats take any picture"
    return data.tobytes()


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)


_RGB: Final = ("R", "G", "B")
_NORMALS: Final = ("N.X", "N.Y", "N.Z")
_IDS: Final = {"parts": "id.part", "instances": "id.instance", "markers": "id.marker"}
_SENSOR: Final = "sensor."


def write_exr(path: str | Path, frame: RenderedFrame) -> None:
    """Write all pictures of a frame and its camera."""
    import OpenEXR

    channels = {
        **_channels(frame.ideal),
        **{_SENSOR + name: values for name, values in _channels(frame.noisy).items()},
    }
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
        light = linear_of(pictures.rgb).astype(np.float16)
        channels |= {name: light[..., index] for index, name in enumerate(_RGB)}
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
