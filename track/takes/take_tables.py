"""Tables of a take (.csv), in degrees and millimeters.

Column names contain the units, and an empty cell stands for an unknown number.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Final, get_args

import numpy as np

from gloves.takes.take import STATUSES, Take
from handsim.files.outputs import atomic_write
from handsim.hand.angles import ISB_JOINTS, ISB_NAMES, WRIST_NAMES, Convention
from handsim.hand.shape import JOINT_NAMES, JOINTS
from track.kinematics.pose_spread import CHANGING, SOURCES
from track.takes.methods import made_of
from track.takes.take_faults import SuspectSpan
from track.takes.take_figures import CONSTANT, RANGE, HandFigures, PageSettings, joint_errors, wrist_figures
from track.takes.trials import FIGURES, PERCENTS, Cycles, mean_and_spread, thumb_reach

_ENDINGS: Final = (".frames.csv", ".joints.csv", ".markers.csv", ".doubts.csv", ".reach.csv", ".angles.csv")
_CYCLE_ENDING: Final = ".cycles.csv"
_RECORD_COLUMN: Final = "made of"
"""Last column of all tables: version, date and checksums of the take, in the first row or in all of a
study."""
_WORDS: Final = ("capture", "person", "session")
"""Columns of words, which keep points that look like decimal points."""
_ANGLES: Final = (*_WORDS, "side", "joint", "measure", "value [deg]", "SD", "SD constant", "MDD",
                  "share measured", "convention", _RECORD_COLUMN)  # fmt: skip
_MEASURES: Final = "mean", "5th percentile", "95th percentile", "range of motion"

_Row = list[object]
_Rows = list[_Row]


def table_paths(page: Path, settings: PageSettings = PageSettings()) -> tuple[Path, ...]:  # noqa: B008
    """Paths of a page's tables: the last is that of a study's angles, preceded by that of cycles."""
    *endings, last = _ENDINGS
    cycles = [] if settings.cycles is None else [_CYCLE_ENDING]
    return tuple(page.with_suffix(ending) for ending in (*endings, *cycles, last))


def write_tables(
    page: Path,
    take: Take,
    hands: Sequence[HandFigures],
    spans: Sequence[SuspectSpan],
    cycles: Sequence[Cycles],
    *,
    source: str,
    settings: PageSettings,
) -> tuple[Path, ...]:
    """Write the tables beside a page, see `write_take_page`; returns their paths."""
    tables = [rows(take, hands) for rows in (_frame_rows, _joint_rows, _marker_rows)]
    tables = [*tables, _span_rows(take, spans), _reach_rows(take, hands)]
    first = [take.settings.get("capture", Path(source).name), settings.person, settings.session]
    if settings.cycles is not None:
        tables.append(_cycle_rows(take, hands, cycles, first))
    tables = [_with_record(rows, take) for rows in tables]
    tables.append(_angle_rows(take, hands, first, settings))
    paths = table_paths(page, settings)
    for path, rows in zip(paths, tables, strict=True):
        _write_table(path, rows, settings.decimal)
    return paths


def _with_record(rows: _Rows, take: Take) -> _Rows:
    """A table with a last column that says in the first row what the take was made of."""
    cells = [_RECORD_COLUMN, made_of(take.settings), *[""] * (len(rows) - 2)]
    return [[*row, cell] for row, cell in zip(rows, cells, strict=False)]


def _write_table(path: Path, rows: _Rows, decimal: str) -> None:
    """Write a table as CSV, with points or commas in its numbers."""
    header, *others = rows
    if decimal == ",":
        others = [
            [cell if name in _WORDS else _with_comma(cell) for name, cell in zip(header, row, strict=True)]
            for row in others
        ]
    # Names of files need not be valid text.
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        separator = ";" if decimal == "," else ","
        csv.writer(file, delimiter=separator, lineterminator="\n").writerows([header, *others])


def _with_comma(cell: object) -> object:
    """A number with a decimal comma; other cells as they are."""
    try:
        float(str(cell))
    except ValueError:
        return cell
    return str(cell).replace(".", ",")


def _frame_rows(take: Take, hands: Sequence[HandFigures]) -> _Rows:
    """Rows of the table of frames: a header, then a row for each frame and hand."""
    header = ["frame", "time_s", "hand", "status", "markers_seen", "residual_rms_mm"]
    header += [f"{joint}_deg" for joint in JOINT_NAMES]
    rows: _Rows = [[*header, *(f"{joint}_spread_deg" for joint in JOINT_NAMES)]]
    numbers = []
    for hand in hands:
        spread = np.full_like(hand.angles, np.nan) if hand.angle_spread is None else hand.angle_spread
        numbers.append(np.column_stack([1e3 * hand.rms, hand.angles, spread]).tolist())
    counts = [hand.seen.sum(axis=1).tolist() for hand in hands]
    for frame, time in enumerate(take.times.tolist()):
        for hand, count, row in zip(hands, counts, numbers, strict=True):
            first = [frame, _time(time), hand.side, STATUSES[hand.status[frame]], count[frame]]
            rows.append([*first, *map(_number, row[frame])])
    return rows


def _joint_rows(take: Take, hands: Sequence[HandFigures]) -> _Rows:
    """Rows of the table of joints: range of motion, range of the model, errors between sessions."""
    columns = [f"{name}_deg" for name in (*RANGE, "model_low", "model_high", "spread")]
    columns += ["at_limits_share", "measured_share", "longest_gap_s", "sem_deg"]
    columns += [*(f"mdd_{measure}_deg" for measure in CHANGING), "cutoff_hz"]
    rows: _Rows = [["hand", "joint", *columns]]
    for hand in hands:
        errors = joint_errors(take.settings, hand)[:, 1 + len(SOURCES) :].tolist()
        for joint, figures, error in zip(JOINTS, hand.joints().tolist(), errors, strict=True):
            *row, spread, limits, measured, gap = figures
            cells = *row, joint.low_deg, joint.high_deg, spread, limits, measured, gap / take.rate, *error
            rows.append([hand.side, joint.name, *map(_number, cells)])
    return rows


def _marker_rows(take: Take, hands: Sequence[HandFigures]) -> _Rows:
    """Rows of the figures of each marker."""
    header = ["hand", "marker", "seen_share", "gaps", "longest_gap_frames", "longest_gap_s"]
    rows: _Rows = [[*header, "residual_median_mm", "residual_95th_mm", "confidence_median"]]
    for hand in hands:
        for marker in hand.markers():
            gaps = [marker.num_gaps, marker.longest_gap, _number(marker.longest_gap / take.rate)]
            residuals = (1e3 * marker.median_residual, 1e3 * marker.high_residual)
            last = map(_number, (*residuals, marker.median_confidence))
            rows.append([hand.side, marker.name, _number(marker.seen), *gaps, *last])
    return rows


def _span_rows(take: Take, spans: Sequence[SuspectSpan]) -> _Rows:
    """Rows of doubtful spans, the worst first; `frame` is the one to look at."""
    rows: _Rows = [["first_frame", "last_frame", "start_s", "end_s", "frame", "of", "why"]]
    for span in spans:
        times = [_time(float(take.times[one])) for one in (span.first, span.last)]
        rows.append([span.first, span.last, *times, span.worst, span.of, span.why])
    return rows


def _cycle_rows(take: Take, hands: Sequence[HandFigures], cycles: Sequence[Cycles], first: _Row) -> _Rows:
    """Rows of figures and curves: by hand and joint of each cycle, their mean and standard deviation."""
    header = [*_WORDS, "side", "joint", "cycle", "start [s]", *FIGURES]
    rows: _Rows = [[*header, *(f"{percent:g} %" for percent in PERCENTS)]]
    for hand, found in zip(hands, cycles, strict=True):
        starts = take.times[[span[0] for span in found.spans]]
        numbers = np.concatenate([found.figures, found.curves], axis=2)
        rows_of = enumerate(zip(starts, numbers, strict=True), 1)
        every = [(f"{number}", _time(start), one) for number, (start, one) in rows_of]
        every += [(name, "", one) for name, one in mean_and_spread(numbers)] if every else []
        for name, start, joints in every:
            for joint, values in zip(JOINT_NAMES, joints.tolist(), strict=True):
                rows.append([*first, hand.side, joint, name, start, *map(_number, values)])
    return rows


def _reach_rows(take: Take, hands: Sequence[HandFigures]) -> _Rows:
    """Rows of how near the thumb came to each target of a test of opposition."""
    rows: _Rows = [["side", "target", "gap_mm", "spread_mm", "time_s"]]
    for hand in hands:
        for name, gap, time, spread in thumb_reach(take, hand.side):
            rows.append([hand.side, name, _number(1e3 * gap), _number(1e3 * spread), _time(time)])
    return rows


def _angle_rows(take: Take, hands: Sequence[HandFigures], first: _Row, settings: PageSettings) -> _Rows:
    """Rows of the angles of a study: by hand, convention, joint and measure, in measured frames.

    SD and its constant part are those of a single angle, so that a range of motion has none.
    """
    rows: _Rows = [[*_ANGLES]]
    joints = dict(zip(ISB_NAMES, ISB_JOINTS, strict=True)) | {name: n for n, name in enumerate(JOINT_NAMES)}
    for hand in hands:
        errors = joint_errors(take.settings, hand)
        constant = np.linalg.norm(errors[:, [1 + source for source in CONSTANT]], axis=1)
        known = dict(zip(JOINT_NAMES, np.c_[hand.joints()[:, -4], constant, errors[:, -4:-1]], strict=True))
        measured_of = {name: hand.measured[:, number] for name, number in joints.items()}
        if take.forearm_index(hand.side) is not None:
            wrist = wrist_figures(take, hand, settings)
            measured_of |= dict(zip(WRIST_NAMES, wrist.measured.T, strict=True))
            of_wrist = zip(WRIST_NAMES, wrist.median_spreads(), wrist.constant, strict=True)
            known |= {name: np.array([spread, same, *[np.nan] * 3]) for name, spread, same in of_wrist}
        for convention in get_args(Convention) if hand.fitted.any() else ():
            zero = "" if settings.neutral is None else ", zero in the neutral pose"
            angles = take.angles(hand.side, convention=convention, neutral=settings.neutral)
            for name, values in angles.items():
                measured = measured_of[name]
                degrees = np.rad2deg(values[measured]) if measured.any() else np.array([np.nan])
                low, high = np.percentile(degrees, (5.0, 95.0))
                last = _number(measured.mean()), f"{convention}{zero}", made_of(take.settings)
                spread, same, mean, peak, moved = known.get(name, [np.nan] * 5)
                errors_of = [(spread, same, one) for one in (mean, peak, peak)] + [(np.nan, np.nan, moved)]
                of_measures = (degrees.mean(), low, high, high - low), errors_of
                for measure, value, error in zip(_MEASURES, *of_measures, strict=True):
                    numbers = map(_number, (value, *error))
                    rows.append([*first, hand.side, name, measure, *numbers, *last])
    return rows


def _number(value: float) -> str:
    """A number with six digits; empty for NaN."""
    return "" if np.isnan(value) else f"{value:.6g}"


def _time(seconds: float) -> str:
    """A time with sixteen digits, which resolve a microsecond of a clock that counts since 1970."""
    return f"{seconds:.16g}"
