"""Several renderings copied into one: shards, frames and ids are numbered anew."""

from __future__ import annotations

import json
import re
import shutil
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from handsim.errors import DatasetError, HandSimError
from handsim.files.capacity import check_free
from handsim.files.json_files import load_json, save_json
from render.formats.annotations.common import to_json
from render.formats.clip_writer import TAR
from render.formats.shards import (
    INDEX,
    load_index,
    new_folder,
    new_tar,
    one_sentence,
    save_index,
    shard_name,
)
from render.formats.writer import open_writer

CONFIG: Final = "render.json"
"""Settings of a rendering, in its folder."""
_MERGEABLE: Final = ("webdataset", "coco", "exr", "png")
_INSIDE: Final = {"coco": "images"}
_LARGEST: Final = 1 << 30  # bytes of a picture's file
_SAMPLE: Final = re.compile(r"(\d+)(\..+)")


def merge_renderings(folders: Sequence[Path], out: Path) -> int:
    """Copy the shards of several renderings into one folder.

    Frames of the second rendering are numbered after those of the first, and so on, in keys, names of files
    and records; COCO's ids are counted anew. Renderings of one format or of the same several can be merged.

    Args:
        folders: Folders that `render_take` or this function wrote; complete shards count.
        out: A new folder.

    Returns:
        Number of shards of each format; pictures [px] and depth [m] are as they were.

    Raises:
        HandSimError: A folder holds no rendering, their formats differ or have no place for several
            renderings, `out` is not new, or the disk is too small.
        DatasetError: A shard is damaged.
    """
    settings = [_settings(folder) for folder in folders]
    formats = settings[0]["formats"]
    for folder, one in zip(folders, settings, strict=True):
        if one["formats"] != formats:
            raise HandSimError(
                f"{folder} has the formats {', '.join(one['formats'])}, expected {', '.join(formats)} as in "
                f"{folders[0]}"
            )
    for name in formats:
        if name not in _MERGEABLE:
            raise HandSimError(
                f"renderings of the format {name} cannot be merged; expected {', '.join(_MERGEABLE)}"
            )
    if len(folders) < 2 or len({folder.resolve() for folder in folders}) < len(folders):
        raise HandSimError("expected two or more different folders to merge")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise HandSimError(f"{out} is not empty; name a new folder")
    _check_space(folders, out)
    count = 0
    for name in formats:
        count = _merge_format(name, folders, [one["frames"] for one in settings], formats, out)
        open_writer(name, _folder(out, formats, name)).finish()
    frames = sum(one["frames"] for one in settings)
    save_json(out / CONFIG, {"formats": formats, "frames": frames, "merged": settings})
    return count


def _settings(folder: Path) -> dict[str, Any]:
    if not (folder / CONFIG).is_file():
        raise HandSimError(f"{folder} holds no {CONFIG}, expected a folder that handsim render wrote")
    settings = load_json(folder / CONFIG)
    formats, frames = settings.get("formats"), settings.get("frames")
    good = isinstance(formats, list) and formats and all(isinstance(name, str) for name in formats)
    if not good or not isinstance(frames, int) or not 0 < frames < 1 << 40:
        raise DatasetError(f"{folder / CONFIG} is damaged: formats or frames are missing")
    return settings


def _check_space(folders: Sequence[Path], out: Path) -> None:
    needed = sum(file.stat().st_size for one in folders for file in one.rglob("*") if file.is_file())
    check_free(out, needed, "the merged pictures", "merge fewer renderings", error=HandSimError)


def _folder(folder: Path, formats: Sequence[str], name: str) -> Path:
    return folder if len(formats) == 1 else folder / name


def _merge_format(
    name: str, folders: Sequence[Path], frames: Sequence[int], formats: Sequence[str], out: Path
) -> int:
    """Copy all shards of one format, and return their number."""
    number, offset = 0, 0
    inside = _INSIDE.get(name, ".")
    for folder, count in zip(folders, frames, strict=True):
        source = _folder(folder, formats, name)
        for shard in sorted(open_writer(name, source).done()):
            start, end = source / inside / shard_name(shard), _folder(out, formats, name) / inside
            with one_sentence(out, f"copying {start}"):
                _COPY[name](start, end / shard_name(number), offset)
            number += 1
        offset += count
    if not number:
        raise HandSimError(f"{', '.join(map(str, folders))}: no finished shards of the format {name}")
    return number


def _copy_tar(start: Path, end: Path, offset: int) -> None:
    start, end = start.with_name(start.name + TAR), end.with_name(end.name + TAR)
    try:
        with tarfile.open(start, "r:") as source, new_tar(end) as target:
            for entry in source:
                file = source.extractfile(entry) if entry.isfile() and entry.size <= _LARGEST else None
                if file is None:
                    raise DatasetError(f"{start}: '{entry.name}' is not a file that handsim render writes")
                target.add(*_renumbered(entry.name, file.read(), offset))
    except (tarfile.TarError, ValueError, KeyError, TypeError, EOFError) as error:
        raise DatasetError(f"{start}: a damaged tar; delete it and render again") from error


def _renumbered(name: str, content: bytes, offset: int) -> tuple[str, bytes]:
    sample = _SAMPLE.fullmatch(name)
    if sample is None:  # the hand shapes of the shard
        return name, content
    if sample[2] == ".info.json":
        info = json.loads(content)
        content = to_json({**info, "number": info["number"] + offset}).encode()
    return f"{int(sample[1]) + offset:06d}{sample[2]}", content


def _copy_folder(start: Path, end: Path, offset: int) -> None:
    """A shard of the formats png and exr: files named after keys, and an index of keys."""
    records = []
    with new_folder(end) as temporary:
        for record, files in _keyed(start, lambda record: str(record["key"])):
            number = int(record["number"]) + offset
            key = f"{record['camera']}_{number:06d}"
            for suffix, file in files.items():
                if suffix == ".json":
                    content = {**load_json(file), "number": number}
                    (temporary / f"{key}.json").write_text(to_json(content) + "\n", "utf-8")
                else:
                    shutil.copyfile(file, temporary / f"{key}{suffix}")
            records.append({**record, "key": key, "number": number})
        save_index(temporary, records)


def _copy_coco(start: Path, end: Path, offset: int) -> None:
    records = []
    with new_folder(end) as temporary:
        for record, files in _keyed(start, lambda record: Path(record["image"]["file_name"]).stem):
            image = record["image"]
            number = int(image["frame"]) + offset
            key = f"{image['camera']}_{number:06d}"
            for suffix, file in files.items():
                shutil.copyfile(file, temporary / f"{key}{suffix}")
            named = {**image, "file_name": f"{end.name}/{key}.jpg", "frame": number}
            records.append({**record, "image": named})
        save_index(temporary, records)


def _keyed(
    start: Path, key_of: Callable[[dict[str, Any]], str]
) -> Iterator[tuple[dict[str, Any], dict[str, Path]]]:
    """Records of a shard, and the files of each by what follows the key in their names."""
    files: dict[str, dict[str, Path]] = {}
    for path in sorted(start.iterdir()):
        key, _, _ = path.name.partition(".")
        if path.name != INDEX:
            files.setdefault(key, {})[path.name.removeprefix(key)] = path
    for record in load_index(start):
        try:
            key = key_of(record)
            yield record, files[key]
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{start}: its index does not fit its files; render it again") from error


_COPY: Final[dict[str, Callable[[Path, Path, int], None]]] = {
    "webdataset": _copy_tar,
    "coco": _copy_coco,
    "exr": _copy_folder,
    "png": _copy_folder,
}
