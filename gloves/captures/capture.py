"""Trajectories of a marker file at a frame rate, their gaps and labels, and checks of unit and position.

Table 3 of Han et al. 2018 counts the gaps that `run_lengths` measures.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.text import check_rate
from handsim._checks import as_numbers, check_type
from handsim.errors import ArgumentError, CaptureError, HandSimWarning, choices, errors_of

UNLABELED: Final = "Unlabeled"
"""Columns of points without a marker are called Unlabeled1, Unlabeled2, ..."""
MAX_SPAN: Final = 30.0
"""Largest median span of clouds that are in meters [m]; a hand in millimeters would span more."""
AT_ORIGIN: Final = "all points are at the origin, (0, 0, 0)"
"""Text of errors on clouds for which `all_at_origin` is true."""
_MIN_SPAN: Final = 0.02  # smallest median span [m]; a fist with five markers spans three times as much
_MIN_CENTIMETERS: Final = 0.002  # smallest span of hands in centimeters that were read as millimeters [m]
_MAX_SPACING: Final = 1.5  # largest median distance of a point from its nearest neighbor [m]
_MIN_POINTS: Final = 5  # least number of points of a cloud that shows its unit; fewer may all be strays
_MIN_FRAMES: Final = 10  # least number of small or wide clouds; fewer may show only strays
_MAX_SAMPLES: Final = 200  # largest number of examined frames, evenly spaced


OF_ARRAYS: Final = "gloves.Capture(names, positions, rate) makes a capture of arrays (docs/marker_files.md)"
"""End of an error message for people whose positions are arrays."""


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Trajectories of a marker file: at least one frame and one trajectory.

    Raises:
        ArgumentError: A name is no text, or positions are no numbers.
        CaptureError: The arrays do not fit together, a position is infinite, or the rate is not from 1 to
            5,000 Hz.
    """

    names: tuple[str, ...]
    """One name per trajectory, never empty; it need not name a marker ("*12", "Unlabeled 2379")."""
    positions: Float[np.ndarray, "T N 3"] = field(repr=False)
    """Positions [m] in the file's axes; NaN, always in all three coordinates, where a marker was not seen."""
    rate: float
    """Frames per second [Hz]."""
    findings: Mapping[str, int] = field(default_factory=dict)
    """How many values of a file were not read as measured points, by the reason."""

    def __post_init__(self) -> None:
        listed = isinstance(self.names, Iterable) and not isinstance(self.names, str)
        names = tuple(self.names) if listed else (self.names,)
        for name in names:
            check_type("a name", name, str, "text, one per trajectory")
        check_type("findings", self.findings, Mapping, "counts by their reasons")
        positions = as_numbers("positions", self.positions).copy()  # the next lines change it
        if positions.ndim != 3 or positions.shape[1:] != (len(names), 3):
            raise CaptureError(
                f"positions have shape {positions.shape}, expected (T, {len(names)}, 3) for "
                f"{len(names)} names"
            )
        if 0 in positions.shape:
            raise CaptureError(
                f"a capture needs at least one frame and one marker, got {len(positions)} frames of "
                f"{len(names)} markers"
            )
        if np.isinf(positions).any():
            raise CaptureError("positions hold infinite values, expected finite numbers or NaN")
        if isinstance(self.rate, np.ndarray) and not self.rate.ndim:  # a number in an archive of NumPy
            object.__setattr__(self, "rate", self.rate.item())
        check_rate(self.rate)
        positions[np.isnan(positions).any(axis=-1)] = np.nan  # two coordinates do not make a point
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "rate", float(self.rate))
        object.__setattr__(self, "findings", dict(self.findings))

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.positions)


def column_runs(flags: Bool[np.ndarray, "T M"]) -> Int[np.ndarray, "3 G"]:
    """The column, the first and the last frame of each unbroken stretch of True, column by column."""
    steps = np.diff(np.pad(flags.T.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    return np.stack([*np.nonzero(steps == 1), np.nonzero(steps == -1)[1] - 1])


def run_lengths(flags: Bool[np.ndarray, "T M"], *, inside: bool = False) -> Int[np.ndarray, "G"]:
    """Lengths [frames] of all stretches of True, column by column; `inside` leaves out those at the ends."""
    _, first, last = column_runs(flags)
    lengths: np.ndarray = last - first + 1
    return lengths[(first > 0) & (last < len(flags) - 1)] if inside else lengths


def runs_of(flags: Bool[np.ndarray, "T"]) -> list[tuple[int, int]]:
    """The first and the last frame of each unbroken stretch of True."""
    return [(first, last) for _, first, last in column_runs(flags[:, None]).T.tolist()]


def select_markers(capture: Capture, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The columns of the named markers, in their order; a subject's prefix ("Anna:ThumbTip") is ignored."""
    bare = [column.rsplit(":", 1)[-1].strip() for column in capture.names]
    for name in names:
        if name not in bare:
            raise CaptureError(
                f"the glove's marker is not among the columns: {choices(name, bare, noun='column')}"
            )
        if bare.count(name) > 1:
            raise CaptureError(f"marker '{name}' has {bare.count(name)} columns in the capture, expected one")
    return capture.positions[:, [bare.index(name) for name in names]]


def select_hands(capture: Capture, names: Sequence[str]) -> list[Float[np.ndarray, "T M 3"]]:
    """The named markers of every hand of a labeled capture, in their order.

    A capture of two hands, as `handsim track` and `handsim label` write it, has a set of columns for each,
    "right:ThumbTip" and so on. Frames without any marker of a hand are left out: it was not there.
    """
    parts = [column.rpartition(":") for column in capture.names]
    columns = [(prefix.strip(), name.strip()) for prefix, _, name in parts]
    sets = list(dict.fromkeys(prefix for prefix, name in columns if name in names))
    held = [name for _, name in columns if name in names]
    if len(sets) < 2 or len(held) == len(set(held)):
        return [_while_there(select_markers(capture, names))]
    hands = []
    for prefix in sets:
        mine = [number for number, (other, _) in enumerate(columns) if other == prefix]
        part = Capture(tuple(columns[number][1] for number in mine), capture.positions[:, mine], capture.rate)
        with errors_of(f"columns '{prefix}:...'", CaptureError):
            hands.append(_while_there(select_markers(part, names)))
    return hands


def _while_there(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "K M 3"]:
    """The frames in which a marker was seen."""
    return np.asarray(markers[np.isfinite(markers[..., 0]).any(axis=1)])


def unlabeled_frames(capture: Capture) -> list[Float[np.ndarray, "N 3"]]:
    """The points of every frame [m] without their labels; an empty frame is (0, 3)."""
    there = np.isfinite(capture.positions).all(axis=-1)
    return [points[seen] for points, seen in zip(capture.positions, there, strict=True)]


def labeled_columns(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    labels: Sequence[Int[np.ndarray, "N"]],
    names: Sequence[str],
    rate: float,
) -> Capture:
    """Labeled points as a capture: one column per marker, then columns for the points without one."""
    extra = max((int((label < 0).sum()) for label in labels), default=0)
    positions = np.full((len(frames), len(names) + extra, 3), np.nan)
    for frame, (points, label) in enumerate(zip(frames, labels, strict=True)):
        column = label.copy()
        column[label < 0] = len(names) + np.arange((label < 0).sum())
        positions[frame, column] = points
    columns = [*names, *(f"{UNLABELED}{number + 1}" for number in range(extra))]
    return Capture(tuple(columns), positions, rate)


class UnitFault(NamedTuple):
    """Clouds in a wrong unit."""

    found: str
    """The evidence in words that the clouds are not in meters."""
    guess: str
    """The unit of length that they probably had before they were scaled."""

    @property
    def hint(self) -> str:
        """The guess as a question about positions that should be in meters."""
        return "; scaled twice?" if self.guess == "meters" else f"; {self.guess}?"


def spacing(cloud: Float[np.ndarray, "N 3"]) -> float:
    """Median distance of a point from its nearest neighbor [m], of two points or more."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(cloud).query(cloud, k=2)  # the nearest is the point itself
    return float(np.median(distances[:, 1]))


def unit_fault(clouds: Sequence[Float[np.ndarray, "N 3"]], *, only_wide: bool = False) -> UnitFault | None:
    """The evidence that clouds are not in meters; None if there is none."""
    shown = [cloud for cloud in clouds if len(cloud) >= _MIN_POINTS]
    step = -(-len(shown) // _MAX_SAMPLES) or 1
    shown = shown[::step]
    if not shown:
        return None
    spans = [float((cloud.max(axis=0) - cloud.min(axis=0)).max()) for cloud in shown]
    span = max(spans)
    if span > MAX_SPAN:  # the median costs more than all else here
        span = float(np.median(spans))
    if span > MAX_SPAN:
        return UnitFault(f"the points of a frame span {span:.0f} m", "millimeters")
    if only_wide or len(shown) < _MIN_FRAMES:
        return None
    span = float(np.median(spans))
    if span < _MIN_SPAN:
        unit = "meters" if span < _MIN_CENTIMETERS else "centimeters"
        return UnitFault(f"the points of a frame span {1e3 * span:.2g} mm", unit)
    apart = float(np.median([spacing(cloud) for cloud in shown]))
    if apart > _MAX_SPACING:
        return UnitFault(f"the points of a frame are {apart:.2g} m apart", "centimeters")
    return None


def all_at_origin(clouds: Sequence[Float[np.ndarray, "N 3"]]) -> bool:
    """Whether there are several points, and each of them is at exactly (0, 0, 0)."""
    return sum(map(len, clouds)) > 1 and not any(cloud.any() for cloud in clouds)


def check_unit(clouds: Sequence[Float[np.ndarray, "N 3"]], *, only_wide: bool = False) -> None:
    """Refuse clouds that are not in meters by `unit_fault`."""
    if not only_wide and all_at_origin(clouds):
        raise ArgumentError(f"{AT_ORIGIN}, expected positions in meters")
    fault = unit_fault(clouds, only_wide=only_wide)
    if fault is not None:
        raise ArgumentError(f"{fault.found}, expected a hand in meters{fault.hint}")


def check_place(capture: Capture, farthest: float) -> None:
    """Warn of points that will be left out, because a coordinate exceeds `farthest` [m]."""
    there = np.isfinite(capture.positions[..., 0])
    far = int((np.abs(capture.positions[there]).max(axis=-1, initial=0.0) >= farthest).sum())
    points = int(there.sum())
    if far > points / 2:
        raise CaptureError(
            f"{far} of {points} points lie {farthest:.0f} m or more from the origin, expected hands in a "
            "room; move the origin of the capture into the room"
        )
    if far:
        warnings.warn(
            f"{far} of {points} points lie {farthest:.0f} m or more from the origin and are left out",
            HandSimWarning,
            stacklevel=2,
        )
