"""Formats with folders of pictures per shard, named after their frames: png, exr, coco, yolo, interhand.

Photographs lie in `images/shard-00000`, and nothing else that is a picture: programs train on whatever they
find there. Depth, ids and normals have folders of the same names beside it, `depth/shard-00000`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from handsim.errors import HandSimError
from render.formats.annotations import coco, hands_json, interhand, yolo
from render.formats.annotations.common import to_json, without_colors
from render.formats.exr import write_exr
from render.formats.png_depth import encode_pictures
from render.formats.shards import (
    json_list,
    load_indexes,
    new_folder,
    one_sentence,
    save_index,
    save_text,
    shard_name,
    shards_in,
)
from render.frames import RenderedFrame

_IMAGES: Final = "images"
PICTURES: Final = ("depth", "depth_ideal", "normals", "ids")
"""Kinds of pictures beside the photographs, each of which has a folder."""
_LABELS: Final = "labels"
BESIDE: Final = (*PICTURES, _LABELS)
"""Folders that may stand beside that of the photographs."""


class FolderWriter:
    """For each shard a folder of pictures, which are named after frames, with an index of records.

    Args:
        folder: Where all is.
        inside: The folder of photographs in it.
        part: A folder in that one, and in those beside it, which holds the shards.
    """

    def __init__(self, folder: Path, *, inside: str = _IMAGES, part: str = ".") -> None:
        self.folder, self.part = folder, part
        self.pictures = folder / inside / part

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.pictures)

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew.

        Raises:
            HandSimError: The format cannot hold these frames, or the disk takes no more.
        """
        with one_sentence(self.folder, f"writing shard {shard}"), self.new_shard(shard) as temporary:
            save_index(temporary, list(self._add_all(temporary, frames, shard_name(shard))))

    @contextmanager
    def new_shard(self, shard: int) -> Iterator[Path]:
        """A temporary folder that becomes a shard when the block ends well; those in it go beside it.

        Photographs take their names last: a shard that is there is whole.
        """
        with new_folder(self.pictures / shard_name(shard)) as temporary:
            yield temporary
            for kind, place in self.beside(shard).items():
                if place.exists():
                    shutil.rmtree(place)
                if (temporary / kind).is_dir():
                    place.parent.mkdir(parents=True, exist_ok=True)
                    (temporary / kind).replace(place)

    def beside(self, shard: int) -> dict[str, Path]:
        """Where a shard's depth, ids and so on are, if there are any."""
        return {kind: self.folder / kind / self.part / shard_name(shard) for kind in BESIDE}

    def finish(self) -> None:
        """Nothing to merge, unless a format overrides this."""

    def _add_all(self, folder: Path, frames: Iterable[RenderedFrame], name: str) -> Iterator[dict[str, Any]]:
        keys = set()
        for frame in frames:
            if frame.key in keys:
                raise HandSimError(f"two frames of a shard are called '{frame.key}'; number them apart")
            keys.add(frame.key)
            yield self._add(folder, frame, name)

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        """Write one frame into a shard's folder of that name."""
        raise NotImplementedError

    def _add_pictures(
        self, folder: Path, frame: RenderedFrame, name: str, *, lossless: bool = False
    ) -> dict[str, str]:
        """Write a frame's pictures and return where those beside the photograph will be, from `folder` on."""
        files = {}
        for suffix, content in encode_pictures(frame, lossless=lossless).items():
            kind, _, ending = suffix.strip(".").rpartition(".")
            _write(folder / kind / f"{frame.key}.{ending}", content)
            if kind:
                files[f"{kind}_file"] = (Path(kind) / self.part / name / f"{frame.key}.{ending}").as_posix()
        return files

    def _records(self) -> Iterator[dict[str, Any]]:
        return load_indexes(self.pictures, sorted(self.done()))


class PngWriter(FolderWriter):
    """`images/shard-00000/KEY.png`, `depth/shard-00000/KEY.png` ..., and `KEY.json` beside the photograph.

    The JSON has everything that is known of the frame.
    """

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        files = self._add_pictures(folder, frame, name, lossless=True)
        record = hands_json.frame_record(frame) | files
        (folder / f"{frame.key}.json").write_text(to_json(record) + "\n", "utf-8")
        return {"key": frame.key, "number": frame.number, "camera": frame.camera.name}


class ExrWriter(FolderWriter):
    """`shard-00000/KEY.exr` with all pictures, and `KEY.json` with all that is known of the frame."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, inside=".")

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        write_exr(folder / f"{frame.key}.exr", frame)
        (folder / f"{frame.key}.json").write_text(to_json(hands_json.frame_record(frame)) + "\n", "utf-8")
        return {"key": frame.key, "number": frame.number, "camera": frame.camera.name}


class CocoWriter(FolderWriter):
    """`images/shard-00000/KEY.jpg`, `depth/shard-00000/KEY.png` ..., and `annotations.json` beside them."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        _need_colors(frame, "coco")
        record = coco.picture_record(frame, f"{name}/{frame.key}.jpg")
        record["image"] |= self._add_pictures(folder, frame, name)
        return record

    def finish(self) -> None:
        """Write `annotations.json`.

        Raises:
            HandSimError: A shard is damaged, or the disk takes no more.
        """

        def numbered() -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
            return coco.numbered(self._records())

        with one_sentence(self.folder, "writing the annotations"):
            save_text(self.folder / "annotations.json", _coco_file(numbered, [coco.CATEGORY]))


class YoloWriter(CocoWriter):
    """COCO's folder with `labels/shard-00000/KEY.txt`, and `data.yaml`, which ultralytics trains from."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = super()._add(folder, frame, name)
        _write(folder / _LABELS / f"{frame.key}.txt", yolo.label_lines(frame).encode())
        return record

    def finish(self) -> None:
        """Write `annotations.json` and `data.yaml`.

        Raises:
            HandSimError: A shard is damaged, or the disk takes no more.
        """
        super().finish()
        with one_sentence(self.folder, "writing data.yaml"):
            save_text(self.folder / "data.yaml", [yolo.data_yaml()])


class InterhandWriter(FolderWriter):
    """`images/train/shard-00000/KEY.jpg`, and InterHand2.6M's JSON files in `annotations/train`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, part=interhand.SPLIT)

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        _need_colors(frame, "interhand")
        record = interhand.picture_record(frame, f"{name}/{frame.key}.jpg")
        record["image"] |= self._add_pictures(folder, frame, name)
        return record

    def finish(self) -> None:
        """Write the files in `annotations`.

        Raises:
            HandSimError: A shard is damaged, pictures of one frame have different hands, or the disk takes
                no more.
        """
        annotations = self.folder / "annotations"
        start = annotations / interhand.SPLIT / f"InterHand2.6M_{interhand.SPLIT}"
        cameras = interhand.Cameras()

        def numbered() -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
            return interhand.numbered(self._records(), cameras)

        def joints() -> Iterator[str]:
            yield f'{{"{interhand.CAPTURE}":{{'
            for index, (number, record) in enumerate(interhand.frames_once(self._records())):
                yield f'{"," if index else ""}\n"{number}":{to_json(record)}'
            yield "\n}}\n"

        category = {"id": 1, "name": "hand", "supercategory": "hand"}
        with one_sentence(self.folder, "writing the annotations"):
            save_text(Path(f"{start}_joint_3d.json"), joints())
            save_text(Path(f"{start}_data.json"), _coco_file(numbered, [category]))
            save_text(Path(f"{start}_camera.json"), [to_json(cameras.table()) + "\n"])
            save_text(annotations / "skeleton.txt", [interhand.skeleton_lines()])


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)


def _need_colors(frame: RenderedFrame, name: str) -> None:
    if frame.ideal.rgb is None and frame.noisy.rgb is None:
        raise without_colors(name)


def _coco_file(
    numbered: Callable[[], Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]],
    categories: list[dict[str, Any]],
) -> Iterator[str]:
    """Pieces of a COCO file; the shards are read twice, so that they need not fit into memory.

    Its list of licenses is empty, because pictures belong to who draws them.
    """
    yield f'{{"info":{to_json(coco.INFO)},\n"licenses":[],\n"categories":{to_json(categories)},\n"images":'
    yield from json_list(image for image, _ in numbered())
    yield ',\n"annotations":'
    yield from json_list(hand for _, hands in numbered() for hand in hands)
    yield "}\n"
