"""Corrected labels of a tracked take, in a TOML file beside the take.

A correction identifies a point by its position in the first frame of a span, so that it also fits a new
tracking of the same capture. Within the span the point is followed by its ID, or without an ID from position
to position.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.takes.points import PointList
from gloves.takes.take import Take
from handsim.errors import CaptureError, HandSimError, choices, errors_of
from handsim.files.inputs import (
    check_keys,
    numbers,
    read_toml,
    shown,
    tables_of,
    text_of,
    toml_number,
    toml_string,
)
from handsim.files.outputs import write_text, writing

CORRECTIONS_SUFFIX: Final = ".corrections.toml"
"""Ending of the names of correction files."""
NO_MARKER: Final = "none"
"""The label of a point that is no marker; labels of markers contain a colon."""
FREE: Final = -2
"""The label of a point without a correction."""
_CORRECTION_KEYS: Final = ("frames", "place_mm", "label")
_SAME_PLACE: Final = 0.002  # largest distance of a point from its position in the file [m]; formats round it
_MAX_STEP: Final = 0.02  # largest distance of a point without an ID from its prediction [m]
_FILE_COMMENT: Final = "# Corrected labels; `handsim track` applies them again, `handsim view` adds to them."


@dataclass(frozen=True, slots=True)
class Correction:
    """The right label of one point over a span of frames."""

    first: int
    """The first frame of the span, from 0."""
    last: int
    """The last frame of the span, inclusive."""
    place: tuple[float, float, float]
    """Position of the point in the first frame [m]."""
    label: str
    """Name of its marker (`right:ThumbTip`), or `NO_MARKER`."""

    def __str__(self) -> str:
        return f"{self.label} in frames {self.first} to {self.last}"

    def record(self) -> dict[str, Any]:
        """The correction as a record of its file and of a take's settings."""
        place = [round(1e3 * value, 6) for value in self.place]
        return {"frames": [self.first, self.last], "place_mm": place, "label": self.label}


class Pins(NamedTuple):
    """The labels that corrections give to the points of a take."""

    labels: Int[np.ndarray, "P"]
    """Corrected label of each point, -1 for no marker; `FREE` for a point without a correction."""
    unfitting: tuple[Correction, ...]
    """Corrections that fit no point."""


def corrections_path(take: Path) -> Path:
    """The file of a take's corrections: `tracked.corrections.toml` beside `tracked.npz`."""
    return take.with_name(f"{take.stem}{CORRECTIONS_SUFFIX}")


def load_corrections(path: Path) -> tuple[Correction, ...]:
    """Read a file of corrections."""
    table = read_toml(path, error=CaptureError)
    with errors_of(path, CaptureError):
        check_keys(table, "the file", ("correction",), optional=("correction",))
        entries = enumerate(tables_of(table, "correction"), start=1)
        return tuple(_read_correction(entry, f"correction {number}") for number, entry in entries)


def corrections_of(take: Path) -> tuple[Correction, ...]:
    """The corrections beside a take; none where there is no such file."""
    path = corrections_path(take)
    return load_corrections(path) if path.exists() else ()


def save_corrections(path: Path, corrections: Iterable[Correction]) -> None:
    """Write corrections; `load_corrections` gives the same again."""
    lines = [_FILE_COMMENT]
    for correction in corrections:
        record = correction.record()
        place = ", ".join(toml_number(value) for value in record["place_mm"])
        lines += ["", "[[correction]]", f"frames = {record['frames']}", f"place_mm = [{place}]"]
        lines += [f"label = {toml_string(correction.label)}"]
    with writing(path, CaptureError):
        write_text(path, "\n".join(lines) + "\n")


def find_pins(corrections: Sequence[Correction], points: PointList, label_names: Sequence[str]) -> Pins:
    """Find the points of corrections; of two corrections of one point the later one holds."""
    pinned = np.full(len(points.ids), FREE, dtype=np.int64)
    unfitting = []
    for number, correction in enumerate(corrections, start=1):
        label = _label_of(correction, number, len(points.counts), label_names)
        followed = follow_point(points, correction)
        if not len(followed):
            unfitting.append(correction)
        pinned[followed] = label
    for frame in np.unique(points.frames[pinned >= 0]):
        own = pinned[points.of(frame)]
        given = np.bincount(own[own >= 0])
        if given.max() > 1:
            name = label_names[int(given.argmax())]
            raise CaptureError(f"two points of frame {frame} are corrected to {name}, expected one point")
    return Pins(pinned, tuple(unfitting))


def follow_point(points: PointList, correction: Correction) -> NDArray[np.int64]:
    """Indices (K,) of a corrected point, one for each frame that holds it; none without a point at its place.

    A point is followed by its ID, also across gaps. A point without an ID is followed to the nearest point to
    the extrapolation of its last two positions, until none is within `_MAX_STEP`.
    """
    first, last = correction.first, correction.last
    start = _nearest(points, first, np.array(correction.place), _SAME_PLACE)
    if start is None:
        return np.empty(0, dtype=np.int64)
    number = points.ids[start]
    if number >= 0:
        begin, end = points.starts[first], points.starts[last + 1]
        return np.asarray(begin + np.flatnonzero(points.ids[begin:end] == number))
    found, step = [start], np.zeros(3)
    for frame in range(first + 1, last + 1):
        place = points.points[found[-1]]
        nearest = _nearest(points, frame, place + step, _MAX_STEP, only_free=True)
        if nearest is None:
            break
        found.append(nearest)
        step = points.points[nearest] - place
    return np.array(found)


def _nearest(
    points: PointList, frame: int, place: Float[np.ndarray, "3"], most: float, *, only_free: bool = False
) -> int | None:
    """The point of a frame nearest to a place [m], among those without an ID if asked; None beyond `most`."""
    part = points.of(frame)
    squares = ((points.points[part] - place) ** 2).sum(axis=1)
    if only_free:
        squares[points.ids[part] >= 0] = np.inf
    if not len(squares) or squares.min() > most**2:
        return None
    return int(part.start + squares.argmin())


def pin_labels(points: PointList, pinned: Int[np.ndarray, "P"]) -> NDArray[np.int16]:
    """Labels after corrections; another point of the same frame that has a corrected label loses it."""
    result: NDArray[np.int16] = np.where(pinned != FREE, pinned, points.labels).astype(np.int16)
    for frame in np.unique(points.frames[pinned >= 0]):
        part = points.of(frame)
        own = pinned[part]
        result[part][(own == FREE) & np.isin(points.labels[part], own[own >= 0])] = -1
    return result


def applied_corrections(take: Take) -> tuple[dict[str, Any], ...]:
    """The records of the corrections that a take was saved with."""
    records = take.settings.get("corrections", ())
    return tuple(one for one in records if isinstance(one, dict)) if isinstance(records, list) else ()


def _label_of(correction: Correction, number: int, frames: int, names: Sequence[str]) -> int:
    """The label of a correction; a `CaptureError` if the take lacks its frames or its name."""
    if correction.last >= frames:
        raise CaptureError(
            f"correction {number} is for frames {correction.first} to {correction.last}, expected frames "
            f"from 0 to {frames - 1}"
        )
    if correction.label == NO_MARKER:
        return -1
    if correction.label not in names:
        unknown = choices(correction.label, (*names, NO_MARKER), noun="label")
        raise CaptureError(f"correction {number}: {unknown}")
    return list(names).index(correction.label)


def _read_correction(table: Mapping[str, object], owner: str) -> Correction:
    check_keys(table, owner, _CORRECTION_KEYS)
    span = numbers(f"{owner}: frames", table["frames"], (2,), "the first and the last frame")
    first, last = (int(value) for value in span)
    if not 0 <= first <= last or (span != [first, last]).any():
        expected = "whole numbers, the first frame, from 0 on, and the last"
        raise HandSimError(f"{owner}: frames is {shown(table['frames'])}, expected {expected}")
    expected = "three numbers [x, y, z] in millimeters"
    x, y, z = 1e-3 * numbers(f"{owner}: place_mm", table["place_mm"], (3,), expected)
    return Correction(first, last, (float(x), float(y), float(z)), text_of(table, "label", f"{owner}: "))


def unfitting_sentences(path: Path, corrections: Iterable[Correction]) -> Iterator[str]:
    """A sentence for each correction that fits no point."""
    for correction in corrections:
        yield (
            f"{path}: the correction to {correction} no longer fits: there is no point at its place in frame "
            f"{correction.first}; it is left out"
        )
