"""FreiHAND's folders: pictures numbered through the whole set, and the lists beside them.

One entry per hand, for loaders of that dataset. `K @ xyz` gives pixels that are counted from the first one's
center. Left hands stay left hands, although FreiHAND has none; `training_info.json` says which is which.
There are no MANO parameters: `training_mano.json` holds a null an entry, so that its readers find a list of
the right length.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from handsim.errors import DatasetError, HandSimError
from render.formats.records import (
    as_sensed,
    centered_K,
    encode_depth,
    encode_jpeg,
    is_seen,
    rounded,
    to_json,
    without_colors,
)
from render.formats.shards import (
    json_list,
    load_index,
    new_folder,
    one_sentence,
    save_index,
    save_text,
    shard_name,
    shards_in,
)
from render.frames import RenderedFrame

SET: Final = "training"
LISTS: Final = ("K", "xyz", "scale", "mano", "info")
"""The JSON files of a set."""
_NUMBERS: Final = "numbers.json"
_KINDS: Final = {"rgb": ".jpg", "mask": ".jpg", "depth": ".png"}


def hand_entries(frame: RenderedFrame) -> list[tuple[int, dict[str, Any]]]:
    """The visible hands: their indices in the frame, and their entries in each of the lists."""
    K = centered_K(frame.camera).tolist()
    entries = []
    for number, hand in enumerate(frame.hands):
        if not is_seen(hand):
            continue
        # FreiHAND measures hands by the first bone of the middle finger.
        scale = float(np.linalg.norm(hand.keypoints_world[10] - hand.keypoints_world[9]))
        entry: dict[str, Any] = {
            "K": K,
            "xyz": rounded(frame.camera.local(hand.keypoints_world), 9),
            "scale": scale,
            "mano": None,
            "info": {"side": hand.shape.side, "frame": frame.number, "camera": frame.camera.name},
        }
        entries.append((number, entry))
    return entries


class FreihandWriter:
    """`training/rgb/00000000.jpg`, `training/mask/00000000.jpg` and the lists `training_*.json`.

    One entry per hand: a picture of two hands comes twice. Shards wait in `parts` until `finish` moves their
    pictures to their numbers, which a shard keeps: what is rendered later comes after it. The shards' lists
    stay in `parts`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.parts = folder, folder / "parts"

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.parts)

    def files(self, shard: int) -> dict[str, Path]:
        """The files of a shard by the names that they had before they were numbered."""
        folder = self.parts / shard_name(shard)
        paths = [path for path in folder.rglob("*") if path.is_file()]
        files = {path.relative_to(self.folder).as_posix(): path for path in paths}
        for source, target in self._moves(shard, *self._numbers().get(str(shard), (0, 0))):
            if target.is_file() and not source.exists():
                files[source.relative_to(self.folder).as_posix()] = target
        return files

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew; one that is numbered keeps its number of entries."""
        folder = self.parts / shard_name(shard)
        _, numbered = self._numbers().get(str(shard), (0, None))
        with one_sentence(self.folder, f"writing shard {shard}"), new_folder(folder) as temporary:
            entries: list[dict[str, Any]] = []
            for kind in _KINDS:
                (temporary / kind).mkdir()
            for frame in frames:
                for hand, entry in hand_entries(frame):
                    for kind, content in _pictures(frame, hand).items():
                        (temporary / kind / f"{len(entries):08d}{_KINDS[kind]}").write_bytes(content)
                    entries.append(entry)
            if numbered not in (None, len(entries)):
                raise HandSimError(
                    f"{self.folder}: shard {shard} is numbered already with {numbered} entries, and cannot "
                    f"be written anew with {len(entries)}"
                )
            save_index(temporary, entries)

    def finish(self) -> list[Path]:
        """Number the pictures and write the lists."""
        with one_sentence(self.folder, "numbering the pictures"):
            numbers = self._numbered()
            for shard, (first, count) in numbers.items():
                self._move(int(shard), first, count)
            shards = sorted(numbers, key=lambda shard: numbers[shard])
            for name in LISTS:
                folders = (self.parts / shard_name(int(shard)) for shard in shards)
                entries = (entry[name] for folder in folders for entry in load_index(folder))
                save_text(self.folder / f"{SET}_{name}.json", json_list(entries))
        return [self.parts / _NUMBERS, *(self.folder / f"{SET}_{name}.json" for name in LISTS)]

    def _numbers(self) -> dict[str, list[int]]:
        """First number and count of every shard that has been numbered."""
        path = self.parts / _NUMBERS
        if not path.is_file():
            return {}
        try:
            numbers = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise DatasetError(f"{path}: damaged: it holds no JSON; render into another folder") from error
        if not isinstance(numbers, dict) or not all(
            isinstance(one, list) and [*map(type, one)] == [int, int] for one in numbers.values()
        ):
            raise DatasetError(f"{path}: damaged: it holds no numbers; render into another folder")
        after = 0
        for shard, (first, count) in sorted(numbers.items(), key=lambda entry: entry[1]):
            if first != after or count < 0 or not shard.isdecimal() or int(shard) not in self.done():
                raise DatasetError(f"{path}: damaged: its numbers do not follow; render into another folder")
            after += count
        return numbers

    def _numbered(self) -> dict[str, list[int]]:
        """Numbers of all complete shards, on the disk before the first picture moves."""
        numbers = self._numbers()
        after = max((first + count for first, count in numbers.values()), default=0)
        for shard in sorted(self.done()):
            count = len(load_index(self.parts / shard_name(shard)))
            if str(shard) not in numbers:
                numbers[str(shard)] = [after, count]
                after += count
            elif numbers[str(shard)][1] != count:
                raise DatasetError(
                    f"{self.parts / _NUMBERS}: damaged: shard {shard} has {count} entries, not "
                    f"{numbers[str(shard)][1]}; render into another folder"
                )
        save_text(self.parts / _NUMBERS, [to_json(numbers) + "\n"])
        return numbers

    def _move(self, shard: int, first: int, count: int) -> None:
        for source, target in self._moves(shard, first, count):
            if source.exists():  # it does not after an earlier `finish`, nor without such a picture
                target.parent.mkdir(parents=True, exist_ok=True)
                source.replace(target)

    def _moves(self, shard: int, first: int, count: int) -> Iterator[tuple[Path, Path]]:
        """Where each picture of a shard is written, and where it is once it has its number."""
        for kind, suffix in _KINDS.items():
            for index in range(count):
                source = self.parts / shard_name(shard) / kind / f"{index:08d}{suffix}"
                yield source, self.folder / SET / kind / f"{first + index:08d}{suffix}"


def _pictures(frame: RenderedFrame, hand: int) -> dict[str, bytes]:
    sensed = as_sensed(frame)
    if sensed.rgb is None:
        raise without_colors("freihand")
    # FreiHAND's readers expect masks as JPEG, whose best quality keeps black and white apart.
    mask = encode_jpeg(255 * frame.hands[hand].mask.astype(np.uint8), quality=100)
    files = {"rgb": encode_jpeg(sensed.rgb), "mask": mask}
    if sensed.depth is not None:
        files["depth"] = encode_depth(sensed.depth)
    return files
