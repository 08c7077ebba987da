"""Writers of rendered frames by the name of their format, and renderings merged into one.

Frames go out in shards, so that rendering can be killed and go on: a shard is written under a temporary
name and renamed when it is complete. Several processes may write different shards into one folder; when all
are done, one of them calls `finish`, which merges what the format stores in one file.
"""

from __future__ import annotations

import json
import re
import shutil
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from handsim._checks import check_choice, check_type
from handsim.app.output import CHECKSUMS, checked_list, checksums_name, save_checksums
from handsim.errors import DatasetError, HandSimError
from handsim.files.inputs import load_json
from handsim.files.outputs import check_free, save_json
from render.formats.coco import CocoWriter, YoloWriter
from render.formats.records import to_json, write_exr
from render.formats.shards import (
    INDEX,
    PICTURES,
    FolderWriter,
    load_index,
    new_tar,
    one_sentence,
    save_index,
    shard_name,
)
from render.formats.webdataset import WebdatasetWriter, frame_record
from render.frames import RenderedFrame

CONFIG: Final = "render.json"
"""Settings of a rendering, in its folder."""
WITH_COLORS: Final = ("coco", "yolo")
"""Formats that need color pictures."""
_MOST_BYTES: Final = 1 << 30  # size of the largest file of a picture
_SAMPLE_NAME: Final = re.compile(r"(\d+)(\..+)")


class PngWriter(FolderWriter):
    """`images/shard-00000/KEY.png`, `depth/shard-00000/KEY.png` ..., and `KEY.json` beside the photograph.

    The JSON has everything that is known of the frame.
    """

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = frame_record(frame) | self._add_files(folder, frame, name)
        (folder / f"{frame.key}.json").write_text(to_json(record) + "\n", "utf-8")
        return {"key": frame.key, "number": frame.number, "camera": frame.camera.name}

    def _add_files(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, str]:
        return self._add_pictures(folder, frame, name, lossless=True)


class ExrWriter(PngWriter):
    """`shard-00000/KEY.exr` with all pictures, and `KEY.json` with all that is known of the frame."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, inside=".")

    def _add_files(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, str]:
        write_exr(folder / f"{frame.key}.exr", frame)
        return {}


FrameWriter = FolderWriter | WebdatasetWriter
"""A writer of one format, as `open_writer` returns it."""


_WRITERS: Final[dict[str, Callable[[Path], FrameWriter]]] = {
    "webdataset": WebdatasetWriter,
    "coco": CocoWriter,
    "yolo": YoloWriter,
    "exr": ExrWriter,
    "png": PngWriter,
}
FORMATS: Final = tuple(_WRITERS)


def open_writer(name: str, folder: str | Path) -> FrameWriter:
    """The writer of one of `FORMATS` into a folder."""
    check_choice(name, FORMATS, noun="format", error=HandSimError)
    return _WRITERS[name](Path(folder))


def open_writers(folder: Path, formats: Sequence[str]) -> list[FrameWriter]:
    """The writers of a rendering's formats; if there are several, each writes into a folder of its own."""
    return [open_writer(name, folder if len(formats) == 1 else folder / name) for name in formats]


def shard_files(folder: Path, formats: Sequence[str], shard: int) -> dict[str, Path]:
    """The files of a shard in all formats of a rendering, by their names relative to its folder."""
    return {
        (writer.folder / name).relative_to(folder).as_posix(): path
        for writer in open_writers(folder, formats)
        for name, path in writer.files(shard).items()
    }


def whole_shards(folder: Path, formats: Sequence[str]) -> tuple[frozenset[int], list[str]]:
    """Complete shards of a rendering whose files are as they were written, and the files that are not.

    All complete shards count in a folder of an earlier version, which wrote no checksums.
    """
    done = frozenset.intersection(*(writer.done() for writer in open_writers(folder, formats)))
    if not any(folder.glob(CHECKSUMS)):
        return done, []
    whole, changed = [], []
    for shard in sorted(done):
        files = shard_files(folder, formats, shard)
        record, found = checked_list(folder / checksums_name(shard), files)
        changed += found
        whole += [shard] if record and not found else []
    return frozenset(whole), changed


def merge_renderings(folders: Sequence[str | Path], out: str | Path) -> int:
    """Copy the shards of several renderings into one folder.

    Frames of the second rendering are numbered after those of the first, and so on, in keys, names of files
    and records; COCO's ids are counted anew. Renderings of one format or of the same several can be merged.

    Args:
        folders: Folders that `render_take` or this function wrote; complete shards count.
        out: A new folder.

    Returns:
        Number of shards of each format; pictures [px] and depth [m] are as they were.

    Raises:
        HandSimError: A folder holds no rendering, their formats differ or are unknown, `out` is not
            new, or the disk is too small.
        DatasetError: A shard is damaged.
    """
    check_type("folders", folders, (list, tuple), "paths of folders")
    parts, out = [Path(folder) for folder in folders], Path(out)
    settings = [_read_settings(folder) for folder in parts]
    formats = settings[0]["formats"]
    for folder, one in zip(parts, settings, strict=True):
        if one["formats"] != formats:
            raise HandSimError(
                f"{folder} has the formats {', '.join(one['formats'])}, expected {', '.join(formats)} as in "
                f"{parts[0]}"
            )
    for name in formats:
        check_choice(name, FORMATS, noun="format of a rendering", error=HandSimError)
    if len(parts) < 2 or len({folder.resolve() for folder in parts}) < len(parts):
        raise HandSimError("expected two or more different folders to merge")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise HandSimError(f"{out} is not empty; name a new folder")
    needed = sum(file.stat().st_size for one in parts for file in one.rglob("*") if file.is_file())
    check_free(out, needed, "the merged pictures", "merge fewer renderings", error=HandSimError)
    shards = []
    for folder in parts:
        whole, changed = whole_shards(folder, formats)
        if changed:
            raise DatasetError(
                f"{folder}: {', '.join(changed)} are damaged (other checksums); the command that rendered it "
                "makes them again"
            )
        shards.append(sorted(whole))
    count = sum(map(len, shards))
    if not count:
        raise HandSimError(f"{', '.join(map(str, parts))}: no finished shards of the format {formats[0]}")
    frames = [one["take_frames"] for one in settings]
    sources = (open_writers(folder, formats) for folder in parts)
    for target, *own in zip(open_writers(out, formats), *sources, strict=True):
        _merge_format(own, shards, frames, target)
        target.finish()
    for number in range(count):
        save_checksums(out / checksums_name(number), shard_files(out, formats, number))
    save_json(out / CONFIG, {"formats": formats, "take_frames": sum(frames), "merged": settings})
    return count


def _read_settings(folder: Path) -> dict[str, Any]:
    if not (folder / CONFIG).is_file():
        raise HandSimError(f"{folder} holds no {CONFIG}, expected a folder that handsim render wrote")
    settings = load_json(folder / CONFIG)
    frames = settings.setdefault("take_frames", settings.get("frames"))  # its name in earlier versions
    formats = settings.get("formats")
    good = isinstance(formats, list) and formats and all(isinstance(name, str) for name in formats)
    if not good or not isinstance(frames, int) or not 0 < frames < 1 << 40:
        raise DatasetError(f"{folder / CONFIG} is damaged: formats or frames are missing")
    return settings


def _merge_format(
    sources: Sequence[FrameWriter], shards: Sequence[list[int]], frames: Sequence[int], target: FrameWriter
) -> None:
    """Copy the shards of one format."""
    number, offset = 0, 0
    for source, chosen, count in zip(sources, shards, frames, strict=True):
        for shard in chosen:
            with one_sentence(target.folder, f"copying shard {shard} of {source.folder}"):
                if isinstance(source, FolderWriter) and isinstance(target, FolderWriter):
                    _copy_folder(source, shard, target, number, offset)
                else:
                    (tar,), (copy,) = source.files(shard).values(), target.files(number).values()
                    _copy_tar(tar, copy, offset)
            number += 1
        offset += count


def _copy_tar(tar: Path, copy: Path, offset: int) -> None:
    """Copy a shard's tar; its frames' numbers grow by an offset."""
    try:
        with tarfile.open(tar, "r:") as source, new_tar(copy) as add:
            for entry in source:
                file = source.extractfile(entry) if entry.isfile() and entry.size <= _MOST_BYTES else None
                if file is None:
                    raise DatasetError(f"{tar}: '{entry.name}' is not a file that handsim render writes")
                add(*_renumbered(entry.name, file.read(), offset))
    except (tarfile.TarError, ValueError, KeyError, TypeError, EOFError) as error:
        raise DatasetError(f"{tar}: a damaged tar; delete it and render again") from error


def _renumbered(name: str, content: bytes, offset: int) -> tuple[str, bytes]:
    """Name and content of a file in a tar, after the offset is added to its frame's number."""
    sample = _SAMPLE_NAME.fullmatch(name)
    if sample is None:  # the file of hand shapes belongs to no frame
        return name, content
    if sample[2] == ".info.json":
        info = json.loads(content)
        content = to_json({**info, "number": info["number"] + offset}).encode()
    return f"{int(sample[1]) + offset:06d}{sample[2]}", content


def _copy_folder(source: FolderWriter, shard: int, target: FolderWriter, number: int, offset: int) -> None:
    """Copy a shard of a format with folders; its frames' numbers grow by an offset."""
    pictures, folders_beside = source.pictures / shard_name(shard), source.beside(shard)
    records = []
    with target.new_shard(number) as temporary:
        for record, files in _records_with_files(pictures, folders_beside):
            image = record.get("image", record)  # some formats have the frame's number in a record `image`
            field = "frame" if "image" in record else "number"
            frame = int(image[field]) + offset
            key = f"{image['camera']}_{frame:06d}"
            named = {
                f"{kind}_file": f"{kind}/{shard_name(number)}/{key}{suffix}"
                for kind, suffix in files
                if kind in PICTURES
            }
            image[field] = frame
            if "image" in record:
                image |= {"file_name": f"{shard_name(number)}/{key}.jpg", **named}
            else:
                image["key"] = key
            for (kind, suffix), file in files.items():
                (temporary / kind).mkdir(exist_ok=True)
                if suffix == ".json":
                    content = load_json(file) | {"number": frame} | named
                    (temporary / f"{key}.json").write_text(to_json(content) + "\n", "utf-8")
                else:
                    shutil.copyfile(file, temporary / kind / f"{key}{suffix}")
            records.append(record)
        save_index(temporary, records)


def _records_with_files(
    pictures: Path, folders_beside: Mapping[str, Path]
) -> Iterator[tuple[dict[str, Any], dict[tuple[str, str], Path]]]:
    """Records of a shard, and the files of each by folder and ending."""
    files: dict[str, dict[tuple[str, str], Path]] = {}
    for kind, folder in {"": pictures, **folders_beside}.items():
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.is_file() and path.name != INDEX:
                files.setdefault(path.stem, {})[kind, path.suffix] = path
    for record in load_index(pictures):
        try:
            key = Path(record["image"]["file_name"]).stem if "image" in record else str(record["key"])
            yield record, files[key]
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{pictures}: its index does not fit its files; render it again") from error
