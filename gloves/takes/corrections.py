"""Labels of a tracked take that a person corrected, as a TOML file beside the take.

A correction names a point by its place in the first frame of a span, so that it also fits a new tracking of
the same capture. From there the point's ID leads through the span; a point without one is followed from
place to place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.takes.take import Take
from handsim.errors import CaptureError, HandSimError, choices
from handsim.files.atomic import atomic_write, read_toml
from handsim.files.toml_values import check_keys, numbers, quoted, shown, tables_of, text_of, written

SUFFIX: Final = ".corrections.toml"
"""How the names of such files end."""
NO_MARKER: Final = "none"
"""The label of a point that is no marker; a marker's has a colon in it."""
FREE: Final = -2
"""What stands for a point that no correction is about."""
_KEYS: Final = ("frames", "place_mm", "label")
_SAME_PLACE: Final = 0.002  # [m] between a point and its place in the file; formats round differently
_LONGEST_STEP: Final = 0.02  # [m] of a point without an ID, from where it is expected in the next frame
_COMMENT: Final = "# Corrected labels; `handsim track` applies them again, `handsim view` adds to them."


@dataclass(frozen=True, slots=True)
class Correction:
    """The right label of one point over a span of frames."""

    first: int
    """The first frame of the span, from 0."""
    last: int
    """The last one, which belongs to it."""
    place: tuple[float, float, float]
    """Where the point is in the first frame [m]."""
    label: str
    """Name of its marker (`right:ThumbTip`), or `NO_MARKER`."""

    def __str__(self) -> str:
        return f"{self.label} in frames {self.first} to {self.last}"

    def record(self) -> dict[str, Any]:
        """Itself as the file and a take's settings hold it."""
        place = [round(1e3 * value, 6) for value in self.place]
        return {"frames": [self.first, self.last], "place_mm": place, "label": self.label}


class Pins(NamedTuple):
    """What corrections say about the points of a take."""

    labels: Int[np.ndarray, "T N"]
    """Label of each point, -1 for no marker; `FREE` where no correction is about it."""
    unfitting: tuple[Correction, ...]
    """Corrections that fit no point."""


def corrections_path(take: Path) -> Path:
    """The file of a take's corrections: `tracked.corrections.toml` beside `tracked.npz`."""
    return take.with_name(f"{take.stem}{SUFFIX}")


def load_corrections(path: Path) -> tuple[Correction, ...]:
    """Read a file of corrections."""
    table = read_toml(path, error=CaptureError)
    try:
        check_keys(table, "the file", ("correction",), optional=("correction",))
        entries = enumerate(tables_of(table, "correction"), start=1)
        return tuple(_parse(entry, f"correction {number}") for number, entry in entries)
    except CaptureError:
        raise
    except HandSimError as error:
        raise CaptureError(f"{path}: {error}") from error


def corrections_of(take: Path) -> tuple[Correction, ...]:
    """The corrections beside a take; none where there is no such file.

    Raises:
        CaptureError: There is one that cannot be read.
    """
    path = corrections_path(take)
    return load_corrections(path) if path.exists() else ()


def save_corrections(path: Path, corrections: Iterable[Correction]) -> None:
    """Write corrections; `load_corrections` gives the same again."""
    lines = [_COMMENT]
    for correction in corrections:
        record = correction.record()
        place = ", ".join(written(value) for value in record["place_mm"])
        lines += ["", "[[correction]]", f"frames = {record['frames']}", f"place_mm = [{place}]"]
        lines += [f"label = {quoted(correction.label)}"]
    try:
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", "utf-8")
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error


def find_pins(
    corrections: Sequence[Correction],
    points: Float[np.ndarray, "T N 3"],
    ids: Int[np.ndarray, "T N"],
    label_names: Sequence[str],
) -> Pins:
    """The points that corrections are about; of two about one point, the later counts."""
    pinned = np.full(points.shape[:2], FREE, dtype=np.int64)
    unfitting = []
    for number, correction in enumerate(corrections, start=1):
        label = _label_of(correction, number, len(points), label_names)
        frames, columns = follow_point(points, ids, correction)
        if not len(frames):
            unfitting.append(correction)
        pinned[frames, columns] = label
    for frame in np.flatnonzero((pinned >= 0).any(axis=1)):
        given = np.bincount(pinned[frame, pinned[frame] >= 0])
        if given.max() > 1:
            name = label_names[int(given.argmax())]
            raise CaptureError(f"two points of frame {frame} are corrected to {name}, expected one point")
    return Pins(pinned, tuple(unfitting))


def follow_point(
    points: Float[np.ndarray, "T N 3"], ids: Int[np.ndarray, "T N"], correction: Correction
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frames (K,) in which the point of a correction is there, and its column (K,) in each.

    Nothing where there is no point at the place. A point with an ID is what has that ID, also after a gap.
    One without is the nearest to where its last two places lead, until there is none.
    """
    first, last = correction.first, correction.last
    start = nearest_column(points[first], np.array(correction.place), _SAME_PLACE)
    if start is None:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    number = ids[first, start]
    if number >= 0:
        there = (ids[first : last + 1] == number) & np.isfinite(points[first : last + 1, :, 0])
        frames, columns = np.nonzero(there)
        return first + frames, columns
    found, place, step = [start], points[first, start], np.zeros(3)
    for frame in range(first + 1, last + 1):
        free = np.where(ids[frame, :, None] < 0, points[frame], np.nan)
        column = nearest_column(free, place + step, _LONGEST_STEP)
        if column is None:
            break
        found.append(column)
        place, step = points[frame, column], points[frame, column] - place
    return first + np.arange(len(found)), np.array(found)


def nearest_column(
    points: Float[np.ndarray, "N 3"], place: Float[np.ndarray, "3"], most: float
) -> int | None:
    """The column of the point nearest to a place [m]; None where none is within `most` [m]."""
    squares = ((points - place) ** 2).sum(axis=1)
    squares[np.isnan(squares)] = np.inf
    if not len(squares) or squares.min() > most**2:
        return None
    return int(squares.argmin())


def pin_labels(labels: Int[np.ndarray, "T N"], pinned: Int[np.ndarray, "T N"]) -> NDArray[np.int16]:
    """Labels with the pinned ones; another point of the same frame that has such a label loses it.

    Args:
        labels: Label of each point, -1 for none.
        pinned: `Pins.labels`.
    """
    result: NDArray[np.int16] = np.where(pinned != FREE, pinned, labels).astype(np.int16)
    for frame in np.flatnonzero((pinned >= 0).any(axis=1)):
        taken = pinned[frame, pinned[frame] >= 0]
        result[frame, (pinned[frame] == FREE) & np.isin(labels[frame], taken)] = -1
    return result


def applied_corrections(take: Take) -> tuple[dict[str, Any], ...]:
    """The records of the corrections that a take was saved with."""
    records = take.settings.get("corrections", ())
    return (
        tuple(record for record in records if isinstance(record, dict)) if isinstance(records, list) else ()
    )


def _label_of(correction: Correction, number: int, frames: int, names: Sequence[str]) -> int:
    """The label that a correction gives, if its span and its name are those of a take."""
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


def _parse(table: Mapping[str, object], owner: str) -> Correction:
    check_keys(table, owner, _KEYS)
    span = numbers(f"{owner}: frames", table["frames"], (2,), "the first and the last frame")
    first, last = (int(value) for value in span)
    if not 0 <= first <= last or (span != [first, last]).any():
        expected = "whole numbers, the first frame, from 0 on, and the last"
        raise HandSimError(f"{owner}: frames is {shown(table['frames'])}, expected {expected}")
    expected = "three numbers [x, y, z] in millimeters"
    x, y, z = 1e-3 * numbers(f"{owner}: place_mm", table["place_mm"], (3,), expected)
    return Correction(first, last, (float(x), float(y), float(z)), text_of(table, "label", f"{owner}: "))


def told(path: Path, corrections: Iterable[Correction]) -> Iterator[str]:
    """A sentence for each correction that fits no point."""
    for correction in corrections:
        yield (
            f"{path}: the correction to {correction} no longer fits: there is no point at its place in frame "
            f"{correction.first}; it is left out"
        )
