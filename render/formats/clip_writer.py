"""Clips in webdataset tars, laid out as UmeTrack's and HOT3D's are."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from handsim.errors import HandSimError
from handsim.hand.shape import HandShape
from render.formats.annotations import hand_crops, hands_json
from render.formats.annotations.common import shape_record, to_json
from render.formats.png_depth import encode_pictures
from render.formats.shards import new_tar, one_sentence, shard_name, shards_in
from render.frames import RenderedFrame

_STREAM: Final = re.compile(r"[A-Za-z0-9_-]+")
TAR: Final = ".tar"


class WebdatasetWriter:
    """`shard-00000.tar`: clips as UmeTrack and HOT3D have them, a sample a time, a stream a camera."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.folder, suffix=TAR)

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew.

        Args:
            shard: Its number, from 0.
            frames: Those of one number, from different cameras, follow one another.

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
        "hand_crops": hand_crops.crops_record(views),
        "objects": hands_json.objects_record(first),
        "markers": hands_json.markers_record(first),
        "choices": {view.camera.name: view.choices for view in views},
        "info": {"number": first.number, "time": first.time},
    }
    for name, record in records.items():
        yield f"{name}.json", to_json(record).encode()
