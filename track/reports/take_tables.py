"""The tables beside a take's page, as .csv, with units in the names of columns.

Angles are in degrees and residuals in millimeters, as in the page. An empty cell is a number that does not
exist.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from gloves.takes.take import STATUSES, Take
from handsim.files.outputs import atomic_write
from handsim.hand.shape import JOINT_NAMES, JOINTS
from track.reports.hand_figures import RANGE, HandFigures
from track.take_summary import SuspectSpan

TABLES: Final = (".frames.csv", ".joints.csv", ".markers.csv", ".doubts.csv")
"""How their names end: frames, ranges of motion, markers, frames to look at."""


class Table(NamedTuple):
    """A table of text and numbers."""

    header: Sequence[str]
    rows: list[list[object]]


def table_paths(page: Path) -> tuple[Path, ...]:
    """The tables beside a page."""
    return tuple(page.with_suffix(ending) for ending in TABLES)


def tables_of(take: Take, hands: Sequence[HandFigures], doubts: Sequence[SuspectSpan]) -> tuple[Table, ...]:
    """The tables of a take, in the order of `TABLES`."""
    return _frames(take, hands), _joints(hands), _markers(take, hands), _doubts(take, doubts)


def write_table(path: Path, table: Table) -> None:
    """Write a table, UTF-8, whole or not at all.

    Raises:
        OSError: The file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.header)
        writer.writerows(table.rows)


def _frames(take: Take, hands: Sequence[HandFigures]) -> Table:
    """One row per frame and hand."""
    header = ["frame", "time_s", "hand", "status", "markers_seen", "residual_rms_mm"]
    numbers = []
    for hand in hands:
        spread = np.full_like(hand.angles, np.nan) if hand.angle_spread is None else hand.angle_spread
        numbers.append(np.column_stack([1e3 * hand.rms, hand.angles, spread]).tolist())
    counts = [hand.seen.sum(axis=1).tolist() for hand in hands]
    rows: list[list[object]] = []
    for frame, time in enumerate(take.times.tolist()):
        for hand, count, row in zip(hands, counts, numbers, strict=True):
            first = [frame, _time(time), hand.side, STATUSES[hand.status[frame]], count[frame]]
            rows.append([*first, *map(_number, row[frame])])
    header += [f"{joint}_deg" for joint in JOINT_NAMES]
    return Table([*header, *(f"{joint}_spread_deg" for joint in JOINT_NAMES)], rows)


def _joints(hands: Sequence[HandFigures]) -> Table:
    """The range of motion of each joint, beside the model's."""
    columns = [f"{name}_deg" for name in (*RANGE, "model_low", "model_high", "spread")]
    rows: list[list[object]] = [
        [hand.side, joint.name, *map(_number, (*row, joint.low, joint.high, spread))]
        for hand in hands
        for joint, row, spread in zip(
            JOINTS, hand.range_of_motion().tolist(), hand.usual_spreads().tolist(), strict=True
        )
    ]
    return Table(["hand", "joint", *columns], rows)


def _markers(take: Take, hands: Sequence[HandFigures]) -> Table:
    """What was seen of each marker."""
    header = ["hand", "marker", "seen_share", "gaps", "longest_gap_frames", "longest_gap_s"]
    header += ["residual_median_mm", "residual_95th_mm", "confidence_median"]
    rows: list[list[object]] = []
    for hand in hands:
        for marker in hand.markers():
            gaps = [marker.num_gaps, marker.longest_gap, _number(marker.longest_gap / take.rate)]
            residuals = (1e3 * marker.median_residual, 1e3 * marker.high_residual)
            last = map(_number, (*residuals, marker.median_confidence))
            rows.append([hand.side, marker.name, _number(marker.seen), *gaps, *last])
    return Table(header, rows)


def _doubts(take: Take, doubts: Sequence[SuspectSpan]) -> Table:
    """Frames to look at, the worst first; `frame` is the one to go to."""
    header = ["first_frame", "last_frame", "start_s", "end_s", "frame", "of", "why"]
    rows: list[list[object]] = []
    for doubt in doubts:
        span = [_time(float(take.times[one])) for one in (doubt.first, doubt.last)]
        rows.append([doubt.first, doubt.last, *span, doubt.worst, doubt.of, doubt.why])
    return Table(header, rows)


def _number(value: float) -> str:
    """Six digits; nothing for NaN."""
    return "" if np.isnan(value) else f"{value:.6g}"


def _time(seconds: float) -> str:
    """Nine digits, which hold a tenth of a millisecond of a day."""
    return f"{seconds:.9g}"
