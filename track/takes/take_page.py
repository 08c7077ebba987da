"""The report page on a take, for checking the angles before they are used.

Angles are in degrees and residuals in millimeters.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.takes.take import COASTING, LOST, Take
from handsim._checks import check_choice
from handsim.arrays import Doubles
from handsim.files.outputs import check_ending, written_together
from handsim.hand.angles import WRIST_NAMES
from handsim.hand.shape import DIGITS, JOINT_NAMES, JOINTS, Side
from handsim.pages import NOTHING, Paint, Section, html_list, picture, write_sections
from track.config import SizeChoice
from track.kinematics.pose_spread import CHANGING, SOURCES
from track.takes.methods import made_of, methods_paragraph
from track.takes.take_faults import SuspectSpan
from track.takes.take_figures import (
    RANGE,
    HandFigures,
    PageSettings,
    WristFigures,
    cycles_of_hands,
    hand_figures,
    joint_errors,
    wrist_figures,
)
from track.takes.take_summary import find_suspect_spans, summarize, suspicions, vouch
from track.takes.take_tables import write_tables
from track.takes.trials import FIGURES, Cycles, draw_cycles, mean_and_spread
from track.user import MEASURED, hand_origin
from train.evaluation import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WANTED: Final = 0.99  # share of right frames for which the page gives a number of spans to look at
_MOST_SPANS: Final = 100  # rows of the page's table of doubtful spans
_MOST_BINS: Final = 750  # largest number of bins of a curve, which shows the extremes of each bin
_SHOWN_SPAN: Final = 0.5  # [s] Hands worn for a shorter time are steps from one size to another.
_STROKES: Final = (Paint.VIOLET, Paint.BLUE, Paint.WARM, Paint.GREEN)
"""Colors of a digit's joints, from proximal to distal."""
_COASTING_COLOR: Final = "#efd9c9"
_SHADES: Final = "Gray: the hand is lost and has no pose. Orange: it coasts, its pose is predicted."
_BANDS: Final = "The bands say how far off each joint angle may be; with a calibrated hand they are narrower."
_CALIBRATE: Final = (
    "A capture of half a minute in which every joint moves and the thumb touches each fingertip tells more: "
    "<code>handsim calibrate minute.c3d --out user.json</code>, then <code>handsim track ... --shape "
    "user.json</code>."
)


def write_take_page(
    out: str | Path,
    take: Take,
    *,
    source: str = "take.npz",
    settings: PageSettings = PageSettings(),  # noqa: B008 (immutable)
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
    cycles = cycles_of_hands(take, hands, settings)
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
    with written_together():
        write_sections(out, sections, title=f"Take {Path(source).name}", lead=_lead(take))
        paths = write_tables(out, take, hands, spans, cycles, source=source, settings=settings)
    return out, *paths


def _lead(take: Take) -> str:
    """Capture, glove, hands and length of the take, in a sentence."""
    settings, user = take.settings, str(take.settings.get("user", ""))
    parts = [f"capture {settings['capture']}"] if "capture" in settings else []
    parts.append(f"glove {settings.get('glove', take.hands[0].layout.name)}")
    parts.append(f"hands {' and '.join(take.sides)}")
    if user.startswith(MEASURED):
        parts.append(f"measured size {user.removeprefix(MEASURED)}")
    elif user in get_args(SizeChoice):
        parts.append(f"size {user}")
    end = f"{take.num_frames:,} frames, {take.duration:.1f} s at {take.rate:.4g} Hz."
    first = ", ".join(parts)
    return f"{first[0].upper()}{first[1:]}; {end}"


def _summary_section(take: Take) -> Section:
    warnings = suspicions(take) if take.made_by_tracker else []
    items = html_list([line[0].upper() + line[1:] for line in summarize(take)], "ul")
    kind = (
        "Found: the frame in which a hand is initialized. Tracked: its pose follows from the frame before. "
        "Coasting: for up to a tenth of a second its pose is predicted. Lost: it has no pose."
        if take.made_by_tracker
        else "The take is not of a tracker: its poses and labels are what was simulated or given."
    )
    return Section("The take", f"{kind}{items}", notes=warnings)


def _calibration_section(take: Take) -> Section:
    """Say as HTML whether the hands are calibrated, and what that means for the angles."""
    notes = str(take.settings.get("user", ""))
    if not take.made_by_tracker:
        text = "The hands are those that the take was made with: there is nothing to calibrate."
    elif notes.startswith(MEASURED) or hand_origin(notes, take.sides[0]) == "named":
        named = f"the mean hands of size {notes}, in a glove as designed"
        known = "of measured size" if notes.startswith(MEASURED) else named
        text = f"The hands are not calibrated but {known}. {_BANDS} {_CALIBRATE}"
    elif notes:
        text = f"The hands are a user's, as calibrated or given: {escape(notes)}."
    else:
        text = "The hands were given, and the take does not say whether they are calibrated. "
        text += _BANDS
    if take.former:
        text += f" They changed while the take was recorded:{html_list(_changes_of_hands(take), 'ul')}"
    return Section("Calibration", text)


def _changes_of_hands(take: Take) -> list[str]:
    """The hands that were tracked and their times, without steps from one size to the next."""
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
        _prepare_panel(panel, times, hand.status)
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


def _wrist_section(take: Take, hand: HandFigures, settings: PageSettings) -> Section:
    """Curves and range of motion of a wrist."""
    title, wrist = f"{hand.side.capitalize()} wrist", wrist_figures(take, hand, settings)
    if not wrist.measured.any():
        return Section(
            title,
            "Hand and forearm are never tracked together, or the axes of the forearm are unknown: "
            "<code>--neutral</code> gives them, as do landmarks (docs/angles.md).",
        )
    shown = np.flatnonzero(wrist.measured.any(axis=0))
    pronation = "that of the styloids against the epicondyles"
    if len(shown) < len(WRIST_NAMES):
        pronation = "unknown without markers at the elbow"
    text = (
        "ISB angles between forearm and third metacarpal (docs/angles.md): flexion and radial deviation "
        "count positive, extension and ulnar deviation negative. The band is one standard deviation (SD) to "
        "either side, without the uncertainty of the forearm's axes. SD constant: its part that is equal in "
        f"all frames. Pronation of the forearm is {pronation}."
    )
    table = [["angle [deg]", *RANGE, "median SD", "SD constant", "measured [%]"]]
    for number in shown.tolist():
        of = np.percentile(wrist.angles[wrist.measured[:, number], number], list(RANGE.values()))
        numbers = [*of, wrist.median_spreads()[number], wrist.constant[number]]
        share = percent(float(wrist.measured[:, number].mean()))
        table.append([WRIST_NAMES[number].replace("_", " "), *map(_cell, numbers), share])
    curves = picture((9.6, 2.6), _draw_wrist, take.times, hand, wrist)
    return Section(title, text, pictures=[(curves, _SHADES)], table=table)


def _draw_wrist(figure: Figure, times: Doubles, hand: HandFigures, wrist: WristFigures) -> None:
    panel = figure.subplots()
    _prepare_panel(panel, times, hand.status)
    panel.axhline(0.0, color=Paint.LINE, linewidth=0.8)
    shown = np.flatnonzero(wrist.measured.any(axis=0))
    names = [WRIST_NAMES[number].split("_", 1)[1].replace("_", " ") for number in shown.tolist()]
    _draw_curves(panel, times, names, wrist.angles[:, shown], wrist.spread[:, shown])
    panel.set_ylabel("wrist [deg]")
    panel.set_xlabel("time [s]")


def _range_section(title: str, take: Take, hand: HandFigures) -> Section:
    shares = "at its limits [%]", "measured [%]"
    table = [["joint [deg]", *RANGE, "median SD", "model's range", *shares, "longest gap [s]"]]
    for joint, (*first, limits, measured, gap) in zip(JOINTS, hand.joints().tolist(), strict=True):
        cells = [*map(_cell, first)]
        cells += [f"{joint.low_deg:g} to {joint.high_deg:g}", percent(limits) if limits > 0.0 else NOTHING]
        cells += [percent(measured), f"{gap / take.rate:.3f}" if gap else NOTHING]
        table.append([joint.name.replace("_", " "), *cells])
    text = (
        "An angle is measured in frames whose pose was fitted while a marker beyond the joint was seen, and "
        f"predicted in all others. {int(hand.fitted.sum()):,} frames have a fitted pose. The range is that "
        "of the measured frames; its percentiles ignore single wrong frames. SD: standard deviation of the "
        "angle. A gap is a run of frames without a measured angle, between the hand's first pose and its "
        "last. The limits of the model are soft by a few degrees; there a joint may bend further."
    )
    return Section(title, text, table=table)


def _cell(value: float, decimals: int = 1) -> str:
    """A number of a table; a dash for NaN."""
    return NOTHING if np.isnan(value) else f"{value:.{decimals}f}"


def _error_section(title: str, settings: Mapping[str, Any], hand: HandFigures) -> Section:
    """The standard deviation of each angle by its sources, and the cut-off of its filter."""
    errors = joint_errors(settings, hand)
    if np.isnan(errors).all():
        return Section(title, "Filter: none, each pose was fitted to the markers of its frame.")
    factors = zip(CHANGING["frame"], SOURCES, strict=True)
    *changing, palm = (f"{one:g} times {name}" for one, name in factors if one > 0.0)
    text = (
        "Filter: all poses were solved together, forward and backward in time, without a delay. It acts as a "
        "Butterworth filter of second order that runs forward and backward: at the cut-off an oscillation "
        "keeps half of its size. SD [deg]: standard deviation of the angle, the root of the sum of its five "
        "squared parts, each as root mean square over all frames. Gluing and person are constant errors; "
        "person: sizes and directions of bones, and gestures unlike other people's. Palm: the metacarpals of "
        "ring and little finger flex with these, which the model takes for motion of their MCP joints; zero "
        "in a flat hand. SEM: standard error of measurement of the angle in a frame between sessions of a "
        "person, with the glove put on again: the other four parts of hands that are calibrated in each "
        f"session, of other hands {' and '.join(changing)}, and {palm}. MDD: minimal detectable "
        "difference of two sessions, 1.96 times the root of two times the SEM; of the angle in a frame, its "
        "mean, its 5th or 95th percentile (peak), and its range of motion between these, each with its own "
        "SEM."
    )
    table = [["joint", "SD", *SOURCES, "SEM", *(f"MDD, {one}" for one in CHANGING), "cut-off [Hz]"]]
    for joint, cells in zip(JOINTS, errors.tolist(), strict=True):
        table.append([joint.name.replace("_", " "), *(f"{cell:.1f}" for cell in cells)])
    return Section(title, text, table=table)


def _markers_section(title: str, take: Take, hand: HandFigures) -> Section:
    header = ["marker", "seen [%]", "gaps", "longest [s]", "residual: median [mm]", "95th [mm]"]
    table = [[*header, "confidence: median [%]"]]
    for marker in hand.markers():
        longest = f"{marker.longest_gap / take.rate:.3f}" if marker.num_gaps else NOTHING
        residuals = [_cell(1e3 * one, 2) for one in (marker.median_residual, marker.high_residual)]
        first = [marker.name, percent(marker.seen), f"{marker.num_gaps:,}", longest]
        table.append([*first, *residuals, percent(marker.median_confidence)])
    drawn = picture((9.6, 1.0 + 0.17 * len(hand.marker_names)), _draw_presence, take.times, hand)
    text = (
        "Seen: the share of all frames in which a point has the marker's label. A gap is a run of frames "
        "without it, between the hand's first pose and its last. Residual: distance of the point from the "
        "pose's marker."
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
    edges = np.append(times[starts], _end_time(times))
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
    _prepare_panel(panel, times, hand.status)
    panel.plot(*decimated(times, 1e3 * hand.rms), color=Paint.BLUE, linewidth=1.1)
    panel.set_ylim(bottom=0.0)
    panel.set_ylabel("RMS [mm]")
    panel.set_xlabel("time [s]")


def _prepare_panel(panel: Axes, times: Float[np.ndarray, "T"], status: Int[np.ndarray, "T"]) -> None:
    """Set grid and limits of a panel, and shade the frames in which the hand is lost or coasts."""
    panel.grid(axis="y", color=Paint.BAND, linewidth=0.8)
    panel.set_xlim(times[0], _end_time(times))
    for state, color in ((COASTING, _COASTING_COLOR), (LOST, Paint.LINE)):
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
    edges = np.append(times, _end_time(times))
    runs = runs_of(np.logical_or.reduceat(flags, starts))
    return [(float(edges[starts[a]]), float(edges[ends[b]] - edges[starts[a]])) for a, b in runs]


def _bins(num_frames: int) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """First frame of each bin, and the frame after its last; one bin per frame of a short take."""
    width = 1 if num_frames <= 2 * _MOST_BINS else -(-num_frames // _MOST_BINS)
    starts = np.arange(0, num_frames, width)
    return starts, np.append(starts[1:], num_frames)


def _end_time(times: Float[np.ndarray, "T"]) -> float:
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
        "the take come first, then spans in which a label is probably wrong or missing, those with the most "
        "such frames first; the percentage is the least confidence in a point. "
        f"<code>{escape(command)}</code> lists the first of them, leads to their frames, and corrects labels."
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


def _cycles_section(side: Side, cycles: Cycles, settings: PageSettings) -> Section:
    """Mean and standard deviation of the angles over the cycles, as curves and in numbers."""
    title, joint = f"{side.capitalize()} hand: cycles", str(settings.cycles).replace("_", " ")
    text = f"A cycle lasts from one least angle of {joint} to the next, if it bends by half its range."
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
