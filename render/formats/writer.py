"""Writers of rendered frames, chosen by the name of a format.

Frames go out in shards, so that rendering can be killed and go on: a shard is written under a temporary name
and renamed when it is complete. Several processes may write different shards into one folder; when all are
done, one of them calls `finish`, which merges what the format stores in one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, Protocol

from handsim._checks import check_choice
from handsim.errors import HandSimError
from render.formats.clip_writer import WebdatasetWriter
from render.formats.folder_writers import (
    CocoWriter,
    ExrWriter,
    InterhandWriter,
    PngWriter,
    YoloWriter,
)
from render.formats.freihand_writer import FreihandWriter
from render.frames import RenderedFrame


class FrameWriter(Protocol):
    """A writer of one format, as `open_writer` returns it."""

    def done(self) -> frozenset[int]:
        """Numbers of the shards that are complete."""

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew.

        Args:
            shard: Its number, from 0.
            frames: What it shall hold; taken one at a time.

        Raises:
            HandSimError: The format cannot hold these frames, or the disk takes no more.
        """

    def finish(self) -> None:
        """Merge all complete shards into the files that the format requires; may be called again.

        Raises:
            HandSimError: A shard is damaged, or the disk takes no more.
        """


WRITERS: Final[dict[str, Callable[[Path], FrameWriter]]] = {
    "webdataset": WebdatasetWriter,
    "coco": CocoWriter,
    "yolo": YoloWriter,
    "freihand": FreihandWriter,
    "interhand": InterhandWriter,
    "exr": ExrWriter,
    "png": PngWriter,
}
FORMATS: Final = tuple(WRITERS)
NEED_COLORS: Final = ("coco", "yolo", "freihand", "interhand")
"""Formats of color pictures."""


def format_folder(folder: Path, formats: Sequence[str], name: str) -> Path:
    """Where one of a rendering's formats is: in a folder of its own if there are several."""
    return folder if len(formats) == 1 else folder / name


def open_writer(name: str, folder: str | Path) -> FrameWriter:
    """The writer of one of `FORMATS`, into a folder that is made when it is not there.

    Raises:
        HandSimError: There is no such format.
    """
    check_choice(name, WRITERS, noun="format", error=HandSimError)
    return WRITERS[name](Path(folder))
