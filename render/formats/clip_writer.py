"""Clips in webdataset tars, laid out as UmeTrack's and HOT3D's are, with `hand_crops.json`.

A crop's camera is a square pinhole camera at the place of the stream's camera, which looks at one hand. Its
axis goes through the middle of the hand's keypoints, and its picture has room around them. The tools warp
the stream's picture to it, which takes the lens out.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.hand.shape import HandShape
from handsim.space.camera import Camera
from render.formats.annotations import hands_json
from render.formats.annotations.common import by_side, is_seen, rigid_record, shape_record, to_json
from render.formats.png_depth import encode_pictures
from render.formats.shards import new_tar, one_sentence, shard_name, shards_in
from render.frames import RenderedFrame

_STREAM: Final = re.compile(r"[A-Za-z0-9_-]+")
TAR: Final = ".tar"
_FILLED: Final = 0.8  # of the crop's half width, by the keypoint that is farthest from its middle
_WIDEST: Final = np.deg2rad(120.0)  # a flat picture of more is mostly stretching
_ROUNDS: Final = 5  # towards the middle, which moves a little when the camera turns
_NEAREST: Final = 1e-3  # [m]


class WebdatasetWriter:
    """`shard-00000.tar`: clips as UmeTrack and HOT3D have them, a sample a time, a stream a camera."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.folder, suffix=TAR)

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew; frames of one number, from different cameras, follow one another.

        Raises:
            HandSimError: They do not, a frame has two hands of one side, or the disk takes no more.
        """
        persons: dict[str, HandShape] = {}
        numbers = set()
        path = self.folder / f"{shard_name(shard)}{TAR}"
        with one_sentence(self.folder, f"writing shard {shard}"), new_tar(path) as tar:
            for number, group in itertools.groupby(frames, key=lambda frame: frame.number):
                if number in numbers:
                    raise HandSimError(f"the pictures of frame {number} do not follow one another")
                numbers.add(number)
                views = list(group)
                for name, content in _sample(views):
                    tar.add(f"{number:06d}.{name}", content)
                for hand in views[0].hands:
                    persons.setdefault(to_json({**shape_record(hand.shape), "side": None}), hand.shape)
            if len(persons) == 1:  # a clip has room for one
                record = hands_json.hand_shapes_record(*persons.values())
                tar.add(hands_json.HAND_SHAPES, to_json(record).encode())

    def finish(self) -> None:
        """Tars stand alone."""


def _sample(views: list[RenderedFrame]) -> Iterator[tuple[str, bytes]]:
    """Files of one time: their names after the key, and their bytes."""
    names = [view.camera.name for view in views]
    for name in names:
        if not _STREAM.fullmatch(name):
            raise HandSimError(f"camera '{name}': a stream's name has letters, digits, - and _ only")
    if len(set(names)) < len(names):
        raise HandSimError(f"frame {views[0].number} has two pictures of one camera: {', '.join(names)}")
    for view in views:
        for suffix, content in encode_pictures(view, lossless=False).items():
            kind, _, ending = suffix.rpartition(".")
            yield f"{kind.strip('.') or 'image'}_{view.camera.name}.{ending}", content
    first = views[0]
    device = first.camera.T_world_camera  # the first camera is the device
    records = {
        "cameras": {view.camera.name: hands_json.camera_record(view.camera, device) for view in views},
        "hands": hands_json.hands_record(views),
        "hand_crops": crops_record(views),
        "objects": hands_json.objects_record(first),
        "markers": hands_json.markers_record(first),
        "choices": {view.camera.name: view.choices for view in views},
        "info": {"number": first.number, "time": first.time},
    }
    for name, record in records.items():
        yield f"{name}.json", to_json(record).encode()


def crops_record(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """`hand_crops.json` of one time: for each side the crop's camera in each stream that sees the hand.

    By stream: `T_world_from_crop_camera`, and `crop_camera_fov`, the full angle of view [rad].

    Raises:
        HandSimError: Two hands are of the same side.
    """
    record: dict[str, Any] = {"left": {}, "right": {}}
    for frame in frames:
        for side, hand in by_side(frame).items():
            crop = crop_camera(frame.camera, hand.keypoints_world) if is_seen(hand) else None
            if crop is not None:
                T_world_crop, angle = crop
                record[side][frame.camera.name] = {
                    "T_world_from_crop_camera": rigid_record(T_world_crop),
                    "crop_camera_fov": angle,
                }
    return record


def crop_camera(
    camera: Camera, keypoints: Float[np.ndarray, "21 3"]
) -> tuple[Float[np.ndarray, "4 4"], float] | None:
    """The pose of a camera for one hand alone, from its keypoints [m], and its full angle of view [rad].

    None for a hand beside or behind the camera, or one that no flat picture of 120 degrees holds.
    """
    local = camera.local(keypoints)
    if local[:, 2].mean() < _NEAREST:
        return None
    rotation = _looking_along(local.mean(axis=0))
    for _ in range(_ROUNDS):
        turned = local @ rotation
        if turned[:, 2].min() < _NEAREST:
            return None
        flat = turned[:, :2] / turned[:, 2:]
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2.0
        rotation = _looking_along(rotation @ np.append(middle, 1.0))
    turned = local @ rotation
    if turned[:, 2].min() < _NEAREST:
        return None
    reach = float(np.abs(turned[:, :2] / turned[:, 2:]).max()) / _FILLED
    angle = 2.0 * float(np.arctan(reach))
    if angle > _WIDEST:
        return None
    T_world_crop: NDArray[np.float64] = camera.T_world_camera.copy()
    T_world_crop[:3, :3] = T_world_crop[:3, :3] @ rotation
    return T_world_crop, angle


def _looking_along(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation whose z axis is this direction, and whose x axis is as level as the camera's."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
