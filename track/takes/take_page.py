"""The report page on a take and its tables, for checking the angles before they are used.

Angles are in degrees and residuals in millimeters. In the tables (.csv) column names contain the units, and
an empty cell stands for an unknown number.
"""

from __future__ import annotations

import csv
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.takes.take import COASTING, INITIALIZED, LOST, STATUSES, Take
from handsim._checks import check_choice
from handsim.files.outputs import atomic_write, check_ending, written_together
from handsim.hand.angles import ISB_JOINTS, ISB_NAMES, WRIST_NAMES, Convention
from handsim.hand.shape import DIGITS, JOINT_NAMES, JOINTS, Side
from handsim.pages import NOTHING, Paint, Section, html_list, picture, write_sections
from track.config import Size
from track.kinematics.pose_spread import CHANGING, DETECTABLE, SOURCES, measurement_error
from track.takes.methods import made_of, methods_paragraph
from track.takes.take_faults import AT_LIMIT, SuspectSpan
from track.takes.take_summary import find_suspect_spans, summarize, suspicions, vouch
from track.takes.trials import (
    FIGURES,
    PERCENTS,
    Cycles,
    cycles_of,
    draw_cycles,
    mean_and_spread,
    thumb_reach,
)
from track.user import MEASURED, hand_origin
from train.evaluation import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TABLES: Final = (".frames.csv", ".joints.csv", ".markers.csv", ".doubts.csv", ".reach.csv", ".angles.csv")
_CYCLES: Final = ".cycles.csv"
_RECORD: Final = "made of"
"""Last column of all tables: version, date and checksums of the take; in its first row, in a study in all."""
_WORDS: Final = ("capture", "person", "session")
"""Columns of words, which may look like numbers."""
_ANGLES: Final = (*_WORDS, "side", "joint", "measure", "value [deg]", "SD", "SD constant", "MDD",
                  "share measured", "convention", _RECORD)  # fmt: skip
_MEASURES: Final = "mean", "5th percentile", "95th percentile", "range of motion"
_CONSTANT: Final = [SOURCES.index("gluing"), SOURCES.index("person")]
"""Sources of an error that is the same in all frames of a session."""
_RANGE: Final = {"least": 0.0, "5th": 5.0, "median": 50.0, "95th": 95.0, "largest": 100.0}
"""Columns of a range of motion, and the percentile of each."""
_CHUNK: Final = 4096  # frames per call of forward kinematics
_WANTED: Final = 0.99  # share of right frames for which the page gives a number of looks
_MOST_SPANS: Final = 100  # rows of the page's table of doubtful spans
_BINS: Final = 750  # bins of a long take's curve, which shows the extremes of each
_SHOWN_SPAN: Final = 0.5  # [s] Hands of fewer frames are steps from one size to another.
_STROKES: Final = (Paint.VIOLET, Paint.BLUE, Paint.WARM, Paint.GREEN)
"""Colors of a digit's joints, from proximal to distal."""
_COASTING: Final = "#efd9c9"
_SHADES: Final = "Gray: the hand is lost and has no pose. Orange: it coasts, its pose is predicted."
_BANDS: Final = "The bands say how far off each joint angle may be; with a calibrated hand they are narrower."
_CALIBRATE: Final = (
    "A capture of half a minute in which every joint moves and the thumb touches each fingertip tells more: "
    "<code>handsim calibrate minute.c3d --out user.json</code>, then <code>handsim track ... --shape "
    "user.json</code>."
)


@dataclass(frozen=True, slots=True, eq=False)
class PageSettings:
    """What a page and its tables are to show of a take."""

    person: str = ""
    session: str = ""
    neutral: tuple[float, float] | Take | None = None
    """The pose in which the angles of a study are zero, see `Take.angles`."""
    decimal: str = "."
    """The decimal mark of the tables; with a comma their cells are separated by semicolons."""
    guesses: bool = False
    """Whether curves and frames have angles of joints that nothing shows, see `Take.shown_joints`."""
    cycles: str | None = None
    """The joint, as in `JOINT_NAMES`, between whose least angles are the cycles of a movement."""


def write_take_page(
    out: str | Path, take: Take, *, source: str = "take.npz", settings: PageSettings = PageSettings()
) -> tuple[Path, ...]:
    """Write the page on a take and its tables, all or none, as `handsim report` does.

    The page shows commands for the take's file `source`. Returns the paths of the page and of its tables:
    frames, joints, markers, doubtful frames, what the thumb reaches, cycles if asked for, and angles as a
    study compares them.

    Raises:
        ArgumentError: The path does not end in .html, or the joint of the cycles is unknown.
    """
    out = Path(out)
    check_ending(out, ".html")
    if settings.cycles is not None:
        check_choice(settings.cycles, JOINT_NAMES, noun="joint")
    hands, spans = hand_figures(take, guesses=settings.guesses), find_suspect_spans(take, most=None)
    paths, cycles = table_paths(out, settings), _cycles(take, hands, settings)
    sections = [
        _summary_section(take),
        _calibration_section(take),
        *(section for hand in hands for section in _hand_sections(take, hand)),
        *(
            _wrist_section(take, hand, settings)
            for hand in hands
            if take.forearm_index(hand.side) is not None
        ),
        *(_cycles_section(hand.side, found, settings) for hand, found in zip(hands, cycles, strict=False)),
        _spans_section(take, spans, source),
        *([_methods_section(take, spans, settings)] if take.made_by_tracker else []),
    ]
    tables = [rows(take, hands) for rows in (_frame_rows, _joint_rows, _marker_rows)]
    tables = [*tables, _span_rows(take, spans), _reach_rows(take, hands)]
    first = [take.settings.get("capture", Path(source).name), settings.person, settings.session]
    if settings.cycles is not None:
        tables.append(_cycle_rows(take, hands, cycles, first))
    tables = [_with_record(rows, take) for rows in tables]
    tables.append(_angle_rows(take, hands, first, settings))
    with written_together():
        write_sections(out, sections, title=f"Take {Path(source).name}", lead=_lead(take))
        for path, rows in zip(paths, tables, strict=True):
            _write_table(path, rows, settings.decimal)
    return out, *paths


def _with_record(rows: _Rows, take: Take) -> _Rows:
    """A table with a last column that says in the first row what the take was made of."""
    cells = [_RECORD, made_of(take.settings), *[""] * (len(rows) - 2)]
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


def table_paths(page: Path, settings: PageSettings = PageSettings()) -> tuple[Path, ...]:
    """Paths of a page's tables; the last is that of the angles of a study, before it that of cycles."""
    *endings, last = _TABLES
    cycles = [] if settings.cycles is None else [_CYCLES]
    return tuple(page.with_suffix(ending) for ending in (*endings, *cycles, last))


@dataclass(frozen=True, slots=True, eq=False)
class HandFigures:
    """Figures of one hand over the T frames of a take, with its M markers."""

    side: Side
    marker_names: tuple[str, ...]
    status: Int[np.ndarray, "T"]
    """Indices into `STATUSES`."""
    angles: Float[np.ndarray, "T 20"]
    """Joint angles in the order of `JOINT_NAMES` [deg]; NaN where lost, or where nothing shows a joint."""
    angle_spread: Float[np.ndarray, "T 20"] | None
    """Standard deviation of each angle [deg]; None if the take has none."""
    residuals: Float[np.ndarray, "T M"]
    """Distance of each labeled point from the pose's marker [m]; NaN without a point or a pose."""
    confidence: Float[np.ndarray, "T M"]
    """Confidence in each marker's label; NaN where the marker has no point."""
    beyond: Bool[np.ndarray, "20 M"]
    """Which markers each joint moves; none for a joint that nothing shows."""

    @property
    def seen(self) -> Bool[np.ndarray, "T M"]:
        """Which markers have a point."""
        return np.asarray(np.isfinite(self.confidence))

    @property
    def fitted(self) -> Bool[np.ndarray, "T"]:
        """Frames whose pose was fitted to points, not predicted."""
        return self.status >= INITIALIZED

    @property
    def rms(self) -> Float[np.ndarray, "T"]:
        """RMS of the residuals of each frame [m], also of simulated takes; NaN where there are none."""
        known = np.isfinite(self.residuals)
        total = np.sum(np.square(self.residuals), axis=1, where=known)
        count = np.where(known.any(axis=1), known.sum(axis=1), np.nan)
        return np.asarray(np.sqrt(total / count))

    @property
    def measured(self) -> Bool[np.ndarray, "T 20"]:
        """Fitted frames with a seen marker beyond the joint; in all others the angle is predicted."""
        return np.asarray(self.fitted[:, None] & (self.seen @ self.beyond.T))

    def gaps(self, seen: Bool[np.ndarray, "T K"]) -> list[list[int]]:
        """Lengths of the gaps of each column, from the hand's first pose to its last [frames]."""
        there = np.flatnonzero(self.status != LOST)
        hidden = ~seen[there[0] : there[-1] + 1] if len(there) else seen[:0]
        return [[last - first + 1 for first, last in runs_of(column)] for column in hidden.T]

    def joints(self) -> Float[np.ndarray, "20 9"]:
        """Each angle's `_RANGE` where measured, median SD [deg], shares at a limit, measured, longest gap."""
        found, measured = np.full((len(JOINTS), len(_RANGE) + 4), np.nan), self.measured
        for row, angles, told in zip(found, self.angles.T, measured.T, strict=True):
            if told.any():
                row[: len(_RANGE)] = np.percentile(angles[told], list(_RANGE.values()))
        if self.fitted.any():
            if self.angle_spread is not None:
                found[:, -4] = np.median(self.angle_spread[self.fitted], axis=0)
            low, high = np.array([(joint.low, joint.high) for joint in JOINTS]).T
            angles = self.angles[self.fitted]
            found[:, -3] = ((angles < low + AT_LIMIT) | (angles > high - AT_LIMIT)).mean(axis=0)
        found[:, -2] = measured.mean(axis=0)
        found[:, -1] = [max(gaps, default=0) for gaps in self.gaps(measured)]
        return found

    def markers(self) -> Iterator[MarkerFigures]:
        """Figures of each marker, in the glove's order."""
        seen = self.seen
        for marker, (name, gaps) in enumerate(zip(self.marker_names, self.gaps(seen), strict=True)):
            frames = np.flatnonzero(seen[:, marker])
            residuals = self.residuals[:, marker]
            known = residuals[np.isfinite(residuals)]
            median, high = np.percentile(known, (50.0, 95.0)).tolist() if len(known) else (np.nan, np.nan)
            confidence = float(np.median(self.confidence[frames, marker])) if len(frames) else np.nan
            share, longest = float(seen[:, marker].mean()), max(gaps, default=0)
            yield MarkerFigures(name, share, len(gaps), longest, median, high, confidence)


class MarkerFigures(NamedTuple):
    """Figures of one marker; NaN if it was never seen or there is no pose."""

    name: str
    seen: float
    """Share of all frames in which it has a point."""
    num_gaps: int
    """Number of gaps between the hand's first and last pose."""
    longest_gap: int
    """Length of the longest gap [frames]."""
    median_residual: float
    """Median distance from the pose's marker [m]."""
    high_residual: float
    """95th percentile of that distance [m]."""
    median_confidence: float
    """Median confidence in its labels."""


def hand_figures(take: Take, *, guesses: bool = False) -> tuple[HandFigures, ...]:
    """The figures of each hand of a simulated or tracked take; with guesses for joints that nothing shows."""
    found = []
    for number, (hand, labels) in enumerate(zip(take.hands, take.hand_labels, strict=True)):
        there = take.status[:, number] != LOST
        shown = take.shown_joints(hand.side)
        known = there[:, None] & (shown | guesses)
        angles = np.where(known, np.rad2deg(take.qpos[:, number, 7:]), np.nan)
        confidence = np.full((take.num_frames, len(labels)), np.nan)
        points = take.point_list
        own = (points.labels >= labels.start) & (points.labels < labels.stop)
        confidence[points.frames[own], points.labels[own] - labels.start] = points.confidence[own]
        residuals = np.full((take.num_frames, len(labels)), np.nan)
        observed = take.observed(hand.side)
        for span, worn in take.worn():
            posed = span.start + np.flatnonzero(there[span])
            for first in range(0, len(posed), _CHUNK):
                part = posed[first : first + _CHUNK]
                expected, _ = worn[number].markers(take.qpos[part, number])
                residuals[part] = np.linalg.norm(observed[part] - expected, axis=2)
        spread = None if take.angle_spread is None else np.rad2deg(take.angle_spread[:, number])
        status, names = take.status[:, number], hand.layout.names
        beyond = hand.attachment.beyond & shown[:, None]
        found.append(HandFigures(hand.side, names, status, angles, spread, residuals, confidence, beyond))
    return tuple(found)


def _lead(take: Take) -> str:
    """Capture, glove, hands and length of the take, in a sentence."""
    settings, user = take.settings, str(take.settings.get("user", ""))
    parts = [f"capture {settings['capture']}"] if "capture" in settings else []
    parts.append(f"glove {settings.get('glove', take.hands[0].layout.name)}")
    parts.append(f"hands {' and '.join(take.sides)}")
    if user.startswith(MEASURED):
        parts.append(f"size measured in the capture, {user.removeprefix(MEASURED)}")
    elif user in get_args(Size):
        parts.append(f"size {user}")
    end = f"{take.num_frames:,} frames, {take.duration:.1f} s at {take.rate:.4g} Hz."
    first = ", ".join(parts)
    return f"{first[0].upper()}{first[1:]}; {end}"


def _summary_section(take: Take) -> Section:
    told = suspicions(take) if take.made_by_tracker else []
    items = html_list([line[0].upper() + line[1:] for line in summarize(take)], "ul")
    kind = (
        "Found: the frame in which a hand is initialized. Tracked: its pose follows from the frame before. "
        "Coasting: for up to a tenth of a second its pose is predicted. Lost: it has no pose."
        if take.made_by_tracker
        else "The take is not of a tracker: its poses and labels are what was simulated or given."
    )
    return Section("The take", f"{kind}{items}", notes=told)


def _calibration_section(take: Take) -> Section:
    """Whether the hands are calibrated, and what that means for the angles, as HTML."""
    notes = str(take.settings.get("user", ""))
    if not take.made_by_tracker:
        text = "The hands are those that the take was made with: there is nothing to calibrate."
    elif notes.startswith(MEASURED) or notes in get_args(Size):
        named = f"the mean hands of size {notes}, in a glove as designed"
        known = "measured in the capture" if notes.startswith(MEASURED) else named
        text = f"The hands are not calibrated but {known}. {_BANDS} {_CALIBRATE}"
    elif notes:
        text = f"The hands are a user's, as calibrated or given: {escape(notes)}."
    else:
        text = "The hands were given, and the take does not say whether they are calibrated. "
        text += _BANDS
    if take.former:
        text += f" They changed while the take was recorded:{html_list(_changes(take), 'ul')}"
    return Section("Calibration", text)


def _changes(take: Take) -> list[str]:
    """From when to when which hands were tracked, without steps from one size to the next."""
    notes = [*(one.notes for one in take.former), str(take.settings.get("user", ""))]
    stops = [*(one.stop for one in take.former), take.num_frames]
    firsts = [0, *stops[:-1]]
    return [
        f"{take.times[first]:.1f} to {take.times[stop - 1]:.1f} s: {note.removeprefix(MEASURED)}"
        for first, stop, note in zip(firsts, stops, notes, strict=True)
        if take.times[stop - 1] - take.times[first] >= _SHOWN_SPAN
    ]


def _hand_sections(take: Take, hand: HandFigures) -> list[Section]:
    side = hand.side.capitalize()
    if not hand.fitted.any():
        return [Section(f"{side} hand", "It has no pose in any frame.")]
    angles = (
        "Angles of the model (docs/angles.md): zero is the flat hand. Flexion counts positive towards the "
        "palm, extension negative. Abduction counts positive towards the thumb; that of the first "
        "metacarpal, which is relative to the hand, away from the palm."
    )
    if hand.angle_spread is not None:
        angles += " The band is one standard deviation (SD) to either side."
    curves = picture((9.6, 9.6), _draw_angles, take.times, hand)
    rms = hand.rms[np.isfinite(hand.rms)]
    residuals, drawn = "None of its markers has a point.", []
    if len(rms):
        residuals = (
            "RMS distance of the labeled points of each frame from the pose's markers: median "
            f"{1e3 * np.median(rms):.2f} mm, 95th percentile {1e3 * np.percentile(rms, 95.0):.2f} mm."
        )
        drawn = [(picture((9.6, 2.2), _draw_residuals, take.times, hand), _SHADES)]
    return [
        Section(f"{side} hand: joint angles", angles, pictures=[(curves, _SHADES)]),
        _range_section(f"{side} hand: range of motion", take, hand),
        _error_section(f"{side} hand: errors of angles", take.settings, hand),
        _markers_section(f"{side} hand: markers", take, hand),
        Section(f"{side} hand: residuals", residuals, pictures=drawn),
    ]


def _draw_angles(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    """Draw one panel per digit with its four angles and their bands; shade lost and coasting frames."""
    panels = figure.subplots(len(DIGITS), 1, sharex=True)
    shape = len(times), len(DIGITS), -1
    angles = hand.angles.reshape(shape)
    spread = None if hand.angle_spread is None else hand.angle_spread.reshape(shape)
    names = np.reshape([joint.split("_", 1)[1].replace("_", " ") for joint in JOINT_NAMES], angles.shape[1:])
    for number, (digit, panel) in enumerate(zip(DIGITS, panels, strict=True)):
        _prepare(panel, times, hand.status)
        panel.axhline(0.0, color=Paint.LINE, linewidth=0.8)
        bands = None if spread is None else spread[:, number]
        _draw_curves(panel, times, names[number], angles[:, number], bands)
        panel.set_ylabel(f"{digit} [deg]")
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels()


def _draw_curves(
    panel: Axes,
    times: Float[np.ndarray, "T"],
    names: Iterable[str],
    angles: Float[np.ndarray, "T K"],
    spread: Float[np.ndarray, "T K"] | None,
) -> None:
    """Draw angles with their names, and bands of a standard deviation if they are known."""
    starts, _ = _bins(len(times))
    for number, (name, stroke) in enumerate(zip(names, _STROKES, strict=False)):
        values = angles[:, number]
        panel.plot(*decimated(times, values), color=stroke, linewidth=1.1, label=name)
        if spread is not None:
            low, high = values - spread[:, number], values + spread[:, number]
            low, high = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
            panel.fill_between(times[starts], low, high, color=stroke, alpha=0.15, linewidth=0.0)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=1.2)


class _WristFigures(NamedTuple):
    """Angles of a wrist over the frames of a take, in the order of `WRIST_NAMES`."""

    angles: Float[np.ndarray, "T 2"]
    """Angles [deg]; NaN where hand or forearm have no pose, or the forearm's axes are unknown."""
    spread: Float[np.ndarray, "T 2"]
    """Their standard deviations [deg]; NaN where unknown."""
    measured: Bool[np.ndarray, "T"]
    """Frames in which both poses were fitted to points."""
    constant: Float[np.ndarray, "2"]
    """Parts of the standard deviations that are the same in all frames [deg]."""


def _wrist_figures(take: Take, hand: HandFigures, settings: PageSettings) -> _WristFigures:
    """The figures of a wrist whose forearm is among the bodies."""
    angles, number = take.wrist_angles(hand.side, settings.neutral), take.hand_index(hand.side)
    assert angles is not None
    measured = hand.fitted & (take.body_status[:, take.forearm_index(hand.side)] >= INITIALIZED)
    spread = np.full(angles.shape, np.nan) if take.wrist_spread is None else take.wrist_spread[:, number]
    budget = np.array(
        take.settings.get("wrist_budget", {}).get(hand.side, np.full((2, len(SOURCES)), np.nan))
    )
    constant = np.linalg.norm(budget[:, _CONSTANT], axis=1)
    return _WristFigures(
        np.rad2deg(angles), np.rad2deg(spread), measured & np.isfinite(angles[:, 0]), constant
    )


def _wrist_section(take: Take, hand: HandFigures, settings: PageSettings) -> Section:
    """Curves and range of motion of a wrist."""
    title, wrist = f"{hand.side.capitalize()} wrist", _wrist_figures(take, hand, settings)
    if not wrist.measured.any():
        return Section(
            title,
            "Hand and forearm are never tracked together, or the axes of the forearm are unknown: "
            "<code>--neutral</code> gives them, as do landmarks (docs/angles.md).",
        )
    text = (
        "Angles of the ISB between forearm and third metacarpal (docs/angles.md): flexion counts positive, "
        "extension negative; radial deviation positive, ulnar deviation negative. The band is one standard "
        "deviation (SD) to either side; how well the axes of the forearm are known is not in it. SD constant "
        "is the part of it that is the same in all frames."
    )
    table = [["angle [deg]", *_RANGE, "median SD", "SD constant", "measured [%]"]]
    for number, name in enumerate(WRIST_NAMES):
        of = np.percentile(wrist.angles[wrist.measured, number], list(_RANGE.values()))
        cells = [*of, _medians(wrist.spread[wrist.measured])[number], wrist.constant[number]]
        shown = [NOTHING if np.isnan(cell) else f"{cell:.1f}" for cell in cells]
        table.append([name.replace("_", " "), *shown, percent(float(wrist.measured.mean()))])
    curves = picture((9.6, 2.6), _draw_wrist, take.times, hand, wrist)
    return Section(title, text, pictures=[(curves, _SHADES)], table=table)


def _draw_wrist(
    figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures, wrist: _WristFigures
) -> None:
    panel = figure.subplots()
    _prepare(panel, times, hand.status)
    panel.axhline(0.0, color=Paint.LINE, linewidth=0.8)
    names = [name.split("_", 1)[1].replace("_", " ") for name in WRIST_NAMES]
    _draw_curves(panel, times, names, wrist.angles, wrist.spread)
    panel.set_ylabel("wrist [deg]")
    panel.set_xlabel("time [s]")


def _range_section(title: str, take: Take, hand: HandFigures) -> Section:
    shares = "at its limits [%]", "measured [%]"
    table = [["joint [deg]", *_RANGE, "median SD", "model's range", *shares, "longest gap [s]"]]
    for joint, (*first, limits, measured, gap) in zip(JOINTS, hand.joints().tolist(), strict=True):
        cells = [NOTHING if np.isnan(one) else f"{one:.1f}" for one in first]
        cells += [f"{joint.low:g} to {joint.high:g}", percent(limits) if limits > 0.0 else NOTHING]
        cells += [percent(measured), f"{gap / take.rate:.3f}" if gap else NOTHING]
        table.append([joint.name.replace("_", " "), *cells])
    text = (
        "An angle is measured in a frame whose pose was fitted while a marker beyond the joint was seen, and "
        f"predicted in all others. {int(hand.fitted.sum()):,} frames have a fitted pose. The range is that "
        "of the measured frames; 5th and 95th are percentiles, which a single wrong frame does not change. "
        "SD: standard deviation of the angle. A gap is a run of frames in which it is not measured, from the "
        "hand's first pose to its last. At the limits of the model, which are soft by a few degrees, a joint "
        "may bend further than the table says."
    )
    return Section(title, text, table=table)


def _error_section(title: str, settings: Mapping[str, Any], hand: HandFigures) -> Section:
    """The standard deviation of each angle by its sources, and the cut-off of its filter."""
    errors = _joint_errors(settings, hand)
    if np.isnan(errors).all():
        return Section(title, "Filter: none, each pose was fitted to the markers of its frame.")
    factors = zip(CHANGING["frame"], SOURCES, strict=True)
    changing = " and ".join(f"{one:g} times {name}" for one, name in factors if one > 0.0)
    text = (
        "Filter: all poses were solved together, forward and backward in time, without a delay. It acts as a "
        "Butterworth filter of second order that runs forward and backward: at the cut-off an oscillation "
        "keeps half of its size. SD [deg]: standard deviation of the angle, the root of the sum of the "
        "squares of its four parts, each as root mean square over all frames. Gluing is a constant error, as "
        "is what stays of the person: sizes and directions of bones, and gestures unlike other people's. "
        "SEM: standard error of measurement of the angle in a frame between sessions of a person, with the "
        "glove put on anew: the SD of hands that are calibrated in each session; of other hands from "
        f"{changing}. MDD: minimal detectable difference of two sessions, 1.96 times the root of two times "
        "the SEM, of the angle in a frame, of its mean, of its 5th or 95th percentile (peak), and of its "
        "range of motion between these, each with a SEM of its own."
    )
    table = [["joint", "SD", *SOURCES, "SEM", *(f"MDD, {one}" for one in CHANGING), "cut-off [Hz]"]]
    for joint, cells in zip(JOINTS, errors.tolist(), strict=True):
        table.append([joint.name.replace("_", " "), *(f"{cell:.1f}" for cell in cells)])
    return Section(title, text, table=table)


def _joint_errors(settings: Mapping[str, Any], hand: HandFigures) -> Float[np.ndarray, "20 E"]:
    """Each angle's SD, its `SOURCES`, SEM, MDD by measure [deg], cut-off [Hz]; NaN if it is not smoothed."""
    cutoffs, budget = (settings.get(name, {}).get(hand.side) for name in ("filter", "budget"))
    if cutoffs is None or budget is None:
        return np.full((len(JOINTS), len(SOURCES) + len(CHANGING) + 3), np.nan)
    origin = hand_origin(str(settings.get("user", "")), hand.side)
    errors = np.transpose([measurement_error(np.array(budget), origin, measure) for measure in CHANGING])
    return np.column_stack(
        [np.linalg.norm(budget, axis=1), budget, errors[:, 0], DETECTABLE * errors, cutoffs]
    )


def _markers_section(title: str, take: Take, hand: HandFigures) -> Section:
    header = ["marker", "seen [%]", "gaps", "longest [s]", "residual: median [mm]", "95th [mm]"]
    table = [[*header, "confidence: median [%]"]]
    for marker in hand.markers():
        longest = f"{marker.longest_gap / take.rate:.3f}" if marker.num_gaps else NOTHING
        residuals = [
            NOTHING if np.isnan(one) else f"{1e3 * one:.2f}"
            for one in (marker.median_residual, marker.high_residual)
        ]
        first = [marker.name, percent(marker.seen), f"{marker.num_gaps:,}", longest]
        table.append([*first, *residuals, percent(marker.median_confidence)])
    drawn = picture((9.6, 1.0 + 0.17 * len(hand.marker_names)), _draw_presence, take.times, hand)
    text = (
        "Seen: the share of all frames in which a point has the marker's label. A gap is a run of frames "
        "without it, from the hand's first pose to its last. Residual: how far the point is from the marker "
        "of the pose."
    )
    caption = "Blue where the marker was seen; pale where it was seen in some of the frames of a column."
    return Section(title, text, pictures=[(drawn, caption)], table=table)


def _draw_presence(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    """Draw a strip for each marker: blue where it was seen; in long takes by the share seen."""
    from matplotlib.colors import LinearSegmentedColormap

    panel = figure.subplots()
    starts, ends = _bins(len(times))
    share = np.add.reduceat(hand.seen, starts, axis=0, dtype=np.float64) / (ends - starts)[:, None]
    colors = LinearSegmentedColormap.from_list("seen", (Paint.CARD, Paint.BLUE))
    edges = np.append(times[starts], _end(times))
    rows = np.arange(share.shape[1] + 1)
    panel.pcolormesh(edges, rows, share.T, cmap=colors, vmin=0.0, vmax=1.0, rasterized=True)
    panel.hlines(rows[1:-1], edges[0], edges[-1], color=Paint.CARD, linewidth=1.5)
    panel.set_yticks(rows[:-1] + 0.5, hand.marker_names, fontsize=7.5)
    panel.tick_params(axis="y", length=0.0)
    panel.invert_yaxis()
    panel.set_xlim(edges[0], edges[-1])
    panel.set_xlabel("time [s]")


def _draw_residuals(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    panel = figure.subplots()
    _prepare(panel, times, hand.status)
    panel.plot(*decimated(times, 1e3 * hand.rms), color=Paint.BLUE, linewidth=1.1)
    panel.set_ylim(bottom=0.0)
    panel.set_ylabel("RMS [mm]")
    panel.set_xlabel("time [s]")


def _prepare(panel: Axes, times: Float[np.ndarray, "T"], status: Int[np.ndarray, "T"]) -> None:
    """Set grid and limits of a panel, and shade the frames in which the hand is lost or coasts."""
    panel.grid(axis="y", color=Paint.BAND, linewidth=0.8)
    panel.set_xlim(times[0], _end(times))
    for state, color in ((COASTING, _COASTING), (LOST, Paint.LINE)):
        spans, across = shaded(times, status == state), panel.get_xaxis_transform()
        panel.broken_barh(spans, (0.0, 1.0), transform=across, facecolors=color, linewidth=0.0)
    panel.tick_params(labelcolor=Paint.SOFT)


def decimated(
    times: Float[np.ndarray, "T"], values: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """Reduce a curve to the least and largest value of each of at most 750 bins of frames; NaN if unknown."""
    starts, ends = _bins(len(times))
    if len(starts) == len(times):
        return times, values
    middles = (starts + ends) // 2
    pairs = np.stack([np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)], axis=1)
    return np.stack([times[starts], times[middles]], axis=1).ravel(), pairs.ravel()


def shaded(times: Float[np.ndarray, "T"], flags: Bool[np.ndarray, "T"]) -> list[tuple[float, float]]:
    """Begin and length of the runs of flagged frames [s], rounded up to whole bins."""
    starts, ends = _bins(len(times))
    edges = np.append(times, _end(times))
    runs = runs_of(np.logical_or.reduceat(flags, starts))
    return [(float(edges[starts[a]]), float(edges[ends[b]] - edges[starts[a]])) for a, b in runs]


def _bins(num_frames: int) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """First frame of each bin, and the frame after its last; one bin per frame of a short take."""
    width = 1 if num_frames <= 2 * _BINS else -(-num_frames // _BINS)
    starts = np.arange(0, num_frames, width)
    return starts, np.append(starts[1:], num_frames)


def _end(times: Float[np.ndarray, "T"]) -> float:
    """End of the last frame [s], which lasts as long as the one before."""
    return float(2.0 * times[-1] - times[-2]) if len(times) > 1 else float(times[-1]) + 1.0


def _spans_section(take: Take, spans: Sequence[SuspectSpan], source: str) -> Section:
    command = f"handsim view {shlex.quote(source)}"
    if not spans:
        return Section("Doubtful frames", "No label is probably wrong or missing.")
    table = [["frames", "start [s]", "end [s]", "of", "why", "to look at", "in"]]
    for span in spans[:_MOST_SPANS]:
        frames = f"{span.first}" if span.first == span.last else f"{span.first} to {span.last}"
        start, end, worst = (f"{take.times[one]:.3f}" for one in (span.first, span.last, span.worst))
        look = f"frame {span.worst}, {worst} s"
        table.append([frames, start, end, span.of, span.why, look, f"{command} --time {worst}"])
    vouched = vouch(take, spans)
    text = (
        f"{len(spans):,} rows; {100 * vouched.listed:.1f} % of the frames have doubtful labels. Faults of "
        "the take come first, then spans in which a label is probably wrong or a marker lacks its own, those "
        "with the most such frames first; the percentage is the least confidence in a point. "
        f"<code>{escape(command)}</code> lists the first of them too; a click leads there, "
        "and a wrong label can be corrected."
    )
    more = f"These are the first {_MOST_SPANS} of {len(spans):,}; the table beside the page has all."
    if take.made_by_tracker and (looks := vouched.looks(_WANTED)):
        text += f" After a look at the first {looks}, {100 * _WANTED:g} % of all frames should be right."
    elif take.made_by_tracker and vouched.after:
        text += f" After a look at all, {100 * vouched.after[-1]:.1f} % or more should be right."
    return Section("Doubtful frames", text, table=table, notes=[more] if len(spans) > _MOST_SPANS else [])


def _methods_section(take: Take, spans: Sequence[SuspectSpan], settings: PageSettings) -> Section:
    """The paragraph for a paper, and what the take was made of."""
    has_neutral = settings.neutral is not None
    text = methods_paragraph(take, vouch(take, spans).listed, has_neutral=has_neutral)
    made = made_of(take.settings)
    return Section("Methods", escape(text), notes=[f"Made of: {made}."] if made else [])


_Rows = list[list[object]]


def _frame_rows(take: Take, hands: Sequence[HandFigures]) -> _Rows:
    """One row per frame and hand; header first."""
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
    columns = [f"{name}_deg" for name in (*_RANGE, "model_low", "model_high", "spread")]
    columns += ["at_limits_share", "measured_share", "longest_gap_s", "sem_deg"]
    columns += [*(f"mdd_{measure}_deg" for measure in CHANGING), "cutoff_hz"]
    rows: _Rows = [["hand", "joint", *columns]]
    for hand in hands:
        errors = _joint_errors(take.settings, hand)[:, 1 + len(SOURCES) :].tolist()
        for joint, figures, error in zip(JOINTS, hand.joints().tolist(), errors, strict=True):
            *row, spread, limits, measured, gap = figures
            cells = *row, joint.low, joint.high, spread, limits, measured, gap / take.rate, *error
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


def _cycles(take: Take, hands: Sequence[HandFigures], settings: PageSettings) -> list[Cycles]:
    """The cycles of each hand, if they are asked for."""
    joint = settings.cycles
    if joint is None:
        return []
    found = []
    for hand in hands:
        angles = take.angles(hand.side, neutral=settings.neutral).values()
        found.append(cycles_of(np.rad2deg(np.transpose([*angles])), hand.measured, joint, take.rate))
    return found


def _cycles_section(side: Side, cycles: Cycles, settings: PageSettings) -> Section:
    """Mean and standard deviation of the angles over the cycles, as curves and in numbers."""
    title, joint = f"{side.capitalize()} hand: cycles", str(settings.cycles).replace("_", " ")
    text = (
        f"A cycle is from one least angle of {joint} to the next, if it bends by half of its range between."
    )
    if not cycles.spans:
        return Section(title, f"{text} There is none.")
    table = [["joint", "cycles", *(f"{name}: mean, SD" for name in FIGURES)]]
    (_, means), (_, spreads) = mean_and_spread(cycles.figures)
    counts = np.isfinite(cycles.figures[:, :, 0]).sum(axis=0).tolist()
    for name, count, *rows in zip(JOINT_NAMES, counts, means, spreads, strict=True):
        pairs = zip(*(row.tolist() for row in rows), strict=True)
        cells = [", ".join(NOTHING if np.isnan(one) else f"{one:.3g}" for one in pair) for pair in pairs]
        table.append([name.replace("_", " "), f"{count}", *cells])
    text += " Each joint counts in the cycles in nine tenths of which it is measured. SD: over the cycles."
    drawn = picture((9.6, 2.6), draw_cycles, cycles, _STROKES)
    return Section(title, text, [(drawn, "Mean over the cycles; the band is one SD to either side.")], table)


def _cycle_rows(
    take: Take, hands: Sequence[HandFigures], cycles: Sequence[Cycles], first: list[object]
) -> _Rows:
    """Rows of figures and curves: by hand and joint of each cycle, their mean and standard deviation."""
    header = [*_WORDS, "side", "joint", "cycle", "start [s]", *FIGURES]
    rows: _Rows = [[*header, *(f"{percent:g} %" for percent in PERCENTS)]]
    for hand, found in zip(hands, cycles, strict=True):
        starts = take.times[[span[0] for span in found.spans]]
        numbers = np.concatenate([found.figures, found.curves], axis=2)
        every = [
            (f"{n + 1}", _time(start), one)
            for n, (start, one) in enumerate(zip(starts, numbers, strict=True))
        ]
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


def _angle_rows(
    take: Take, hands: Sequence[HandFigures], first: list[object], settings: PageSettings
) -> _Rows:
    """Rows of the angles of a study: by hand, convention, joint and measure, in measured frames.

    SD and its constant part are those of a single angle, so that a range of motion has none.
    """
    rows: _Rows = [[*_ANGLES]]
    joints = dict(zip(ISB_NAMES, ISB_JOINTS, strict=True)) | {name: n for n, name in enumerate(JOINT_NAMES)}
    for hand in hands:
        errors = _joint_errors(take.settings, hand)
        constant = np.linalg.norm(errors[:, [1 + source for source in _CONSTANT]], axis=1)
        known = dict(zip(JOINT_NAMES, np.c_[hand.joints()[:, -4], constant, errors[:, -4:-1]], strict=True))
        measured_of = {name: hand.measured[:, number] for name, number in joints.items()}
        if take.forearm_index(hand.side) is not None:
            wrist = _wrist_figures(take, hand, settings)
            measured_of |= dict.fromkeys(WRIST_NAMES, wrist.measured)
            of_wrist = zip(WRIST_NAMES, _medians(wrist.spread[wrist.measured]), wrist.constant, strict=True)
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


def _medians(values: Float[np.ndarray, "F K"]) -> Float[np.ndarray, "K"]:
    """Medians of the columns, over the rows that are known; NaN if none is."""
    known = np.isfinite(values).all(axis=1)
    return np.median(values[known], axis=0) if known.any() else np.full(values.shape[1], np.nan)


def _number(value: float) -> str:
    """A number with six digits; empty for NaN."""
    return "" if np.isnan(value) else f"{value:.6g}"


def _time(seconds: float) -> str:
    """A time with sixteen digits, which resolve a microsecond of a clock that counts since 1970."""
    return f"{seconds:.16g}"
