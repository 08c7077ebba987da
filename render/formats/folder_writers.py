"""Formats with one folder of pictures per shard, named after their frames: png, exr, coco, interhand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from handsim.errors import HandSimError
from render.formats.annotations import coco, hands_json, interhand
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


class FolderWriter:
    """One folder per shard: pictures named after their frames, and an index of records."""

    def __init__(self, folder: Path, inside: str = ".") -> None:
        self.folder = folder
        self.pictures = folder / inside

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.pictures)

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew.

        Raises:
            HandSimError: The format cannot hold these frames, or the disk takes no more.
        """
        folder = self.pictures / shard_name(shard)
        with one_sentence(self.folder, f"writing shard {shard}"), new_folder(folder) as temporary:
            save_index(temporary, list(self._add_all(temporary, frames, folder.name)))

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

    def _records(self) -> Iterator[dict[str, Any]]:
        return load_indexes(self.pictures, sorted(self.done()))


class PngWriter(FolderWriter):
    """`shard-00000/KEY.png`, the other pictures of a frame, and `KEY.json` with everything known of it."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        _write_pictures(folder, frame, lossless=True)
        (folder / f"{frame.key}.json").write_text(to_json(hands_json.frame_record(frame)) + "\n", "utf-8")
        return {"key": frame.key, "number": frame.number, "camera": frame.camera.name}


class ExrWriter(FolderWriter):
    """`shard-00000/KEY.exr` with all pictures, and `KEY.json` with all that is known of the frame."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        write_exr(folder / f"{frame.key}.exr", frame)
        (folder / f"{frame.key}.json").write_text(to_json(hands_json.frame_record(frame)) + "\n", "utf-8")
        return {"key": frame.key, "number": frame.number, "camera": frame.camera.name}


class CocoWriter(FolderWriter):
    """`images/shard-00000/KEY.jpg`, and `annotations.json` beside `images`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "images")

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = coco.picture_record(frame, f"{name}/{frame.key}.jpg")
        _need_colors(frame, "coco")
        _write_pictures(folder, frame, lossless=False)
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


class InterhandWriter(FolderWriter):
    """`images/train/shard-00000/KEY.jpg`, and InterHand2.6M's JSON files in `annotations/train`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, f"images/{interhand.SPLIT}")

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = interhand.picture_record(frame, f"{name}/{frame.key}.jpg")
        _need_colors(frame, "interhand")
        _write_pictures(folder, frame, lossless=False)
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


def _write_pictures(folder: Path, frame: RenderedFrame, *, lossless: bool) -> None:
    for suffix, content in encode_pictures(frame, lossless=lossless).items():
        (folder / f"{frame.key}{suffix}").write_bytes(content)


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
