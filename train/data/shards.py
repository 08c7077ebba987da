"""Reads and writes training sets: `.npy` shards of rows and hands, and a manifest that lists and checks them.

A row is clean: the pose of the hand and what the rig sees of it. Jitter, drops and a shuffled order are added
during training (`train.data.batches`). Rows stay in their files (`MappedRows`), so that the operating system
keeps one copy for all processes.
"""

from __future__ import annotations

import dataclasses
import io
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Int, Shaped
from numpy.typing import NDArray
from upath import UPath

from gloves.layout import MarkerLayout, stored_layout
from gloves.optics.ghosts import MAX_GHOSTS
from handsim._checks import check_type
from handsim.app.output import CHECKSUMS, Output, Place, check_store, place_of
from handsim.cards import card, share_drawing
from handsim.errors import ArgumentError, DatasetError, HandSimError, LayoutError
from handsim.files.arrays import check_npy_header
from handsim.files.inputs import checksum, load_json
from handsim.files.outputs import atomic_write
from handsim.hand.shape import HAND_DTYPE, NUM_QPOS, SIDES, HandShape, unpack_hand
from handsim.settings import Limits, Settings

SCHEMA: Final = 2
MANIFEST: Final = "manifest.json"
CONFIG: Final = "config.json"
_MAX_NAME_BYTES: Final = 100  # bytes of a file name; file systems allow 255


def row_dtype(num_markers: int) -> np.dtype[np.void]:
    """Record type of one frame of one hand.

    `qpos` (position [m], quaternion wxyz, 20 joint angles [rad]), `hand` (index into the shard's hands), true
    `markers` (M, 3) [m], `cameras` with a free view of each marker (bits), positions `observed` by the
    optical system (M, 3) [m] (NaN for lost markers), and `ghosts` (4, 3) [m] (NaN for absent ones).
    """
    return np.dtype(
        [
            ("qpos", "<f4", (NUM_QPOS,)),
            ("hand", "<u4"),
            ("markers", "<f4", (num_markers, 3)),
            ("cameras", "<u4", (num_markers,)),
            ("observed", "<f4", (num_markers, 3)),
            ("ghosts", "<f4", (MAX_GHOSTS, 3)),
        ]
    )


def worn_dtype(num_markers: int) -> np.dtype[np.void]:
    """Record type of one hand: a `HAND_DTYPE`, the `places` (M, 3) of its glove's markers as worn, `person`.

    A place is `along`, `around` [rad] and `across` of a `MarkerPlace`; NaN for a hand without rows. The
    `person` is numbered from 0 through the set; it has two records, its left hand and its right one.
    """
    return np.dtype([*HAND_DTYPE.descr, ("places", "<f8", (num_markers, 3)), ("person", "<u4")])


@dataclass(frozen=True, slots=True)
class Manifest(Settings):
    """The contents of a finished training set."""

    noun: ClassVar[str] = "field"
    config: dict[str, Any]
    """Settings of the training set."""
    marker_names: tuple[str, ...]
    num_frames: Annotated[int, Limits(1)]
    min_cameras: Annotated[int, Limits(1)]
    """Number of cameras that must see a marker."""
    files: dict[str, str]
    """SHA-256 of every file, by name."""
    redrawn: dict[str, int] | None = None
    """Numbers of redrawn people and scenes, by reason; None in old sets, which did not count them."""
    handsim: str = ""
    """Version that finished the set; empty in old sets."""
    units: str = "metres, radians, world frame"
    schema: int = SCHEMA

    def check(self) -> None:
        """Refuse wrong types, repeated marker names, and files in other folders."""
        if not isinstance(self.config, dict):
            raise ArgumentError("config is not a table")
        if not 0 < len(set(self.marker_names)) == len(self.marker_names):
            raise ArgumentError("marker_names is not a list of different names")
        names_are_local = _is_table_of(self.files, str) and all(
            Path(name).name == name and len(name.encode(errors="replace")) <= _MAX_NAME_BYTES
            for name in self.files
        )
        if not names_are_local:
            raise ArgumentError("files is not a table of names of files in this folder and their SHA-256")
        if not (self.redrawn is None or _is_table_of(self.redrawn, int)):
            raise ArgumentError("redrawn is not a table of counts")


def _is_table_of(value: object, kind: type) -> bool:
    """Whether a value is a dictionary whose values have this type."""
    return isinstance(value, dict) and all(type(entry) is kind for entry in value.values())


def rows_name(shard: int) -> str:
    """Name of the file of a shard's rows."""
    return f"rows-{shard:05d}.npy"


def hands_name(shard: int) -> str:
    """Name of the file of a shard's hands."""
    return f"hands-{shard:05d}.npy"


def redrawn_name(shard: int) -> str:
    """Name of the file of a shard's counts of redraws."""
    return f"redrawn-{shard:05d}.json"


def load_redrawn(path: Path, num_shards: int) -> dict[str, int] | None:
    """Counts of redraws in all shards, by reason; None if an earlier version made a shard."""
    files = [path / redrawn_name(shard) for shard in range(num_shards)]
    if not all(file.is_file() for file in files):
        return None
    total: Counter[str] = Counter()
    for file in files:
        total.update(load_json(file))
    return dict(sorted(total.items()))


def array_bytes(dtype: np.dtype[np.void], count: int) -> int:
    """Length of the `.npy` file of `count` records [bytes]."""
    header = io.BytesIO()
    content = np.lib.format.header_data_from_array_1_0(np.empty(0, dtype=dtype)) | {"shape": (count,)}
    np.lib.format.write_array_header_1_0(header, content)
    return len(header.getvalue()) + count * dtype.itemsize


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an `.npy` file completely or not at all."""
    # numpy.save reports a full disk as "8192 requested and 6690 written", without its errno.
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
        file.write(np.ascontiguousarray(array).tobytes())


def load_manifest(path: Path) -> Manifest:
    """Manifest of a finished training set; its other files are not checked."""
    file = path / MANIFEST
    if path.is_file():
        raise DatasetError(f"{path} is a file, expected the folder of a training set")
    if not file.is_file():
        unfinished = "is unfinished; run handsim generate again"
        hint = unfinished if (path / CONFIG).is_file() else "holds none; handsim generate makes one"
        raise DatasetError(f"expected a training set with a {MANIFEST}, but {path} {hint}")
    content = load_json(file)
    if content.get("schema") != SCHEMA:
        raise DatasetError(f"{path} has schema {content.get('schema')}, expected {SCHEMA}")
    try:
        for field in dataclasses.fields(Manifest):
            if field.default is dataclasses.MISSING and field.name not in content:
                raise DatasetError(f"the field {field.name} is missing")
        return Manifest.of(None, content)
    except HandSimError as error:
        raise DatasetError(
            f"{file} is damaged: {error}; run handsim generate again, which writes it anew"
        ) from error


class Dataset:
    """A finished training set of `len(dataset)` frames, its rows memory-mapped.

    A row is one frame of one hand. Its fields are `qpos` (27,) [m, rad], true `markers` (M, 3) [m], the
    `cameras` that see each marker, positions `observed` (M, 3) [m] and `ghosts` (4, 3) [m].

    Args:
        path: The folder written by `handsim generate`: `.npy` shards and a `manifest.json`. A folder of an
            object store, as s3://bucket/prefix, is copied for as long as the set is open.

    Raises:
        DatasetError: The folder is no training set, unfinished, of another schema, or damaged.
    """

    def __init__(self, path: str | Place) -> None:
        check_type("path", path, (str, Path, UPath), "the folder of a training set")
        place = place_of(path)
        if isinstance(place, Path):
            self._open(place)
            return
        self._copy = tempfile.TemporaryDirectory(prefix="handsim-set-")  # removed with the `Dataset`
        store, folder = Output(place, Path(self._copy.name)), Path(self._copy.name)
        try:
            check_store(place)
            store.fetch(MANIFEST, CONFIG)
            store.fetch(*load_manifest(folder).files)
            self._open(folder)
        except DatasetError as error:  # it names the copy
            raise DatasetError(str(error).replace(self._copy.name, str(place))) from error

    def _open(self, path: Path) -> None:
        """Check the files of a folder, and map the rows."""
        self.manifest = load_manifest(path)
        for name, expected in self.manifest.files.items():
            file = path / name
            if not file.is_file():
                raise DatasetError(f"{file} is missing; run handsim generate again, which makes it anew")
            if checksum(file) != expected:
                raise DatasetError(
                    f"{file} is damaged (its checksum is not the manifest's); run handsim generate again, "
                    "which makes such files anew"
                )
        self.path = path
        self.shards = self._map_shards()
        found = sum(map(len, self.shards))
        if found != self.manifest.num_frames:
            raise DatasetError(
                f"{path / MANIFEST} says {self.manifest.num_frames} frames, but the shards hold {found}; "
                "run handsim generate again, which writes it anew"
            )

    def _map_shards(self) -> list[NDArray[np.void]]:
        """The memory-mapped rows of each shard."""
        names = sorted(name for name in self.manifest.files if name.startswith("rows-"))
        dtype = row_dtype(len(self.manifest.marker_names))
        return [_load_records(self.path / name, dtype) for name in names]

    def __getstate__(self) -> dict[str, Any]:
        """The folder and the manifest: another process maps the same pages without checking them again."""
        return {"path": self.path.absolute(), "manifest": self.manifest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path, self.manifest = state["path"], state["manifest"]
        self.shards = self._map_shards()

    def __len__(self) -> int:
        return self.manifest.num_frames

    @property
    def layout(self) -> MarkerLayout:
        """Glove of the set's hands.

        Raises:
            DatasetError: The manifest has no layout.
        """
        try:
            return stored_layout(self.manifest.config["layout"])
        except (KeyError, TypeError, LayoutError) as error:
            raise DatasetError(f"{self.path / MANIFEST} holds no layout: {error}") from error

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers in label order."""
        return self.manifest.marker_names

    def _repr_html_(self) -> str:
        """The card that notebooks show: how often the rig sees each marker, in frames from all of the set."""
        sample = self.mapped_rows()[np.linspace(0, len(self) - 1, min(len(self), 1000)).astype(np.int64)]
        seen = np.isfinite(sample["observed"]).all(axis=-1).mean(axis=0)
        facts = {
            "frames": str(len(self)),
            "folder": str(self.path),
            "handsim": self.manifest.handsim or "unknown",
        }
        shares = dict(zip(self.marker_names, map(float, seen), strict=True))
        return card("Training set", facts, share_drawing(shares))

    def rows(self) -> Shaped[np.ndarray, "T"]:
        """All T rows in order, read into memory; see `row_dtype` for their fields."""
        return np.concatenate(self.shards)

    def mapped_rows(self) -> MappedRows:
        """All T rows in order, left in their files; processes that read them share one copy."""
        return MappedRows(self.shards)

    def people(self) -> Int[np.ndarray, "T"]:
        """Person of each row, numbered from 0 through the set; rows of a person are contiguous."""
        parts, first = [], 0
        for number, shard in enumerate(self.shards):
            parts.append(first + shard["hand"].astype(np.int64) // len(SIDES))
            first += len(self._hand_records(number)) // len(SIDES)
        return np.concatenate(parts)

    def hands(self, shard: int) -> list[HandShape]:
        """Hands of a shard; `hand` of its rows is an index into them."""
        return [unpack_hand(record) for record in self._hand_records(shard)]

    def gloves(self, shard: int) -> list[MarkerLayout | None]:
        """Glove of each hand of a shard as worn, with all slips; None for a hand without rows.

        `attach(glove, hand)` puts it on; the rows' markers are those of their hand's glove.

        Raises:
            DatasetError: The set was written by a version that did not store them.
        """
        records = self._hand_records(shard)
        if "places" not in (records.dtype.names or ()):
            raise DatasetError(f"{self.path / hands_name(shard)} holds no places of markers as worn")
        names = ("along", "around", "across")
        return [
            None if np.isnan(places).any() else dataclasses.replace(self.layout, markers=tuple(
                dataclasses.replace(marker, **dict(zip(names, place, strict=True)))
                for marker, place in zip(self.layout.markers, places.tolist(), strict=True)
            ))
            for places in records["places"]
        ]  # fmt: skip

    def _hand_records(self, shard: int) -> NDArray[np.void]:
        """Memory-mapped hands of a shard; old ones have no person, or no places of markers either."""
        worn = worn_dtype(len(self.manifest.marker_names))
        return _load_records(self.path / hands_name(shard), worn, np.dtype(worn.descr[:-1]), HAND_DTYPE)


def is_dataset(given: object) -> bool:
    """Whether this is a training set, or names the folder of one, finished or not, or a place in a store."""
    if not isinstance(given, str | Path | UPath):
        return isinstance(given, Dataset)
    place = place_of(given)
    if not isinstance(place, Path):
        return True
    return place.is_dir() and any(file for name in (MANIFEST, CHECKSUMS) for file in place.glob(name))


def load_dataset(dataset: Dataset | str | Place) -> Dataset:
    """Open a training set, given as an object or by its folder."""
    if isinstance(dataset, Dataset):
        return dataset
    check_type("dataset", dataset, (str, Path, UPath), "a Dataset or the folder of one")
    return Dataset(dataset)


def _load_records(file: Path, *dtypes: np.dtype[np.void]) -> NDArray[np.void]:
    """Memory-map records of one of these types; raise a `DatasetError` if the file holds other data."""
    try:
        with file.open("rb") as content:
            check_npy_header(content, file.stat().st_size)
        records: NDArray[np.void] = np.load(file, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise DatasetError(f"{file} is damaged: it is no .npy file") from error
    if records.dtype not in dtypes or records.ndim != 1:
        raise DatasetError(f"{file} holds other records than those of this set; expected {dtypes[0].names}")
    return records


class MappedRows:
    """Rows of several arrays in sequence, copied only when requested.

    Args:
        shards: The arrays, memory-mapped or not, with one record type (`train.data.shards.row_dtype`).
        start: First row of this span.
        stop: Row after the last one; all rows if not given.
    """

    def __init__(
        self, shards: Sequence[NDArray[np.void]], *, start: int = 0, stop: int | None = None
    ) -> None:
        self._shards = shards
        self._ends = np.cumsum([len(shard) for shard in shards])
        self._start, self._stop = start, int(self._ends[-1]) if stop is None else stop

    def __len__(self) -> int:
        return self._stop - self._start

    def span(self, start: int, stop: int) -> MappedRows:
        """The rows from `start` to before `stop`, left in their files."""
        return MappedRows(self._shards, start=self._start + start, stop=self._start + stop)

    def __getitem__(self, wanted: str | Int[np.ndarray, "B"]) -> Shaped[np.ndarray, "B *rest"]:
        """A copy of the rows with these numbers (0 or more), or of one field of all rows."""
        if isinstance(wanted, str):
            return np.concatenate([part[wanted] for part in self._parts()])
        numbers = np.asarray(wanted) + self._start
        if len(numbers) and not self._start <= numbers.min() <= numbers.max() < self._stop:
            raise IndexError(f"rows {wanted.min()} to {wanted.max()} of {len(self)}")
        rows: NDArray[Any] = np.empty(len(numbers), dtype=self._shards[0].dtype)
        holders = np.searchsorted(self._ends, numbers, side="right")
        for holder in np.unique(holders):
            here = holders == holder
            shard = self._shards[holder]
            rows[here] = shard[numbers[here] - (self._ends[holder] - len(shard))]
        return rows

    def _parts(self) -> list[NDArray[np.void]]:
        """The rows of this span in each array."""
        firsts = [int(end) - len(shard) for end, shard in zip(self._ends, self._shards, strict=True)]
        return [
            shard[max(self._start - first, 0) : max(self._stop - first, 0)]
            for first, shard in zip(firsts, self._shards, strict=True)
        ]
