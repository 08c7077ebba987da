"""The page on a take: angles, range of motion, markers, residuals, frames to look at."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Final, get_args

import numpy as np

from gloves.takes.take import Take
from handsim.app.page import Section, write_page
from handsim.files.outputs import check_ending, written_together
from handsim.hand.shape import JOINTS
from track.config import Size
from track.reports import take_plots
from track.reports.hand_figures import RANGE, HandFigures, hand_figures
from track.reports.take_tables import table_paths, tables_of, write_table
from track.take_summary import SuspectSpan, find_suspect_spans, summarize, suspicions
from track.user import MEASURED
from train.evaluation import percent
from train.reports.plot_style import picture

_MOST_DOUBTS: Final = 100  # rows; with more a take is not worth reading line by line
_NOTHING: Final = "-"
_SHADES: Final = "Gray: the hand is lost and has no pose. Orange: it coasts, its pose is predicted."
_UNCALIBRATED: Final = (
    "Joint angles of such hands are typically 5 to 7 degrees off in the mean, those of calibrated hands 1 to "
    "2 (simulated captures, whose truth is known); the bands say how much for each joint. "
)
_CALIBRATE: Final = (
    "A capture of half a minute in which every joint moves and the thumb touches each fingertip tells more: "
    "<code>handsim calibrate minute.c3d --out user.json</code>, then <code>handsim track ... --shape "
    "user.json</code>."
)


def write_take_page(out: str | Path, take: Take, *, source: str = "take.npz") -> tuple[Path, ...]:
    """Write the page (.html) on a take and its tables beside it, all or none, as `handsim report` does.

    Args:
        out: The page, an .html file, whole in itself.
        take: A take of `track_capture` or `simulate_take`.
        source: The take's file, which the page names; angles are in [deg] there, residuals in [mm].

    Returns:
        The page, and the tables of frames, joints, markers and doubtful frames (.csv).

    Raises:
        ArgumentError: The page's name does not end in .html.
        OSError: A file cannot be written.
    """
    out = Path(out)
    check_ending(out, ".html")
    hands, doubts = hand_figures(take), find_suspect_spans(take, most=None)
    sections = [_summary_section(take), _calibration_section(take)]
    for hand in hands:
        sections += _hand_sections(take, hand)
    sections.append(_doubts_section(take, doubts, source))
    tables = table_paths(out)
    with written_together():
        write_page(out, sections, title=f"Take {Path(source).name}", lead=_lead(take))
        for path, table in zip(tables, tables_of(take, hands, doubts), strict=True):
            write_table(path, table)
    return out, *tables


def _lead(take: Take) -> str:
    """Of what the take is, and how long."""
    settings = take.settings
    glove = settings.get("glove", take.hands[0].layout.name)
    parts = [f"capture {settings['capture']}"] if "capture" in settings else []
    parts += [f"glove {glove}", f"hands {' and '.join(take.sides)}", _user(take)]
    end = f"{take.num_frames:,} frames, {take.num_frames / take.rate:.1f} s at {take.rate:.4g} Hz."
    first = ", ".join(part for part in parts if part)
    return f"{first[0].upper()}{first[1:]}; {end}"


def _user(take: Take) -> str:
    """Whose hands they are, in words."""
    notes = str(take.settings.get("user", ""))
    _, is_measured, size = notes.partition(MEASURED)
    if is_measured:
        return f"size measured in the capture, {size}"
    return f"size {notes}" if notes in get_args(Size) else notes


def _summary_section(take: Take) -> Section:
    told = suspicions(take) if take.made_by_tracker else []
    items = "".join(f"<li>{escape(line[0].upper() + line[1:])}</li>" for line in summarize(take))
    kind = (
        "Found: the frame in which a hand is initialized. Tracked: its pose follows from the frame before. "
        "Coasting: for up to a tenth of a second its pose is predicted. Lost: it has no pose."
        if take.made_by_tracker
        else "The take is not of a tracker: its poses and labels are what was simulated or given."
    )
    return Section("The take", f"{kind}<ul>{items}</ul>", notes=told)


def _calibration_section(take: Take) -> Section:
    """Whether the hands are calibrated, and what that means for the angles; HTML."""
    notes = str(take.settings.get("user", ""))
    if not take.made_by_tracker:
        text = "The hands are those that the take was made with: there is nothing to calibrate."
    elif notes.startswith(MEASURED):
        text = "The hands are not calibrated: their size and proportions were measured in the capture. "
        text += _UNCALIBRATED + _CALIBRATE
    elif notes in get_args(Size):
        text = (
            f"The hands are not calibrated: they are the mean hands of size {notes}, in a glove as designed. "
        )
        text += _UNCALIBRATED + _CALIBRATE
    elif notes:
        text = f"The hands are a user's ({escape(notes)}), as calibrated or given."
    else:
        text = "The hands were given, and the take does not say whether they are calibrated. "
        text += "If they are not: " + _UNCALIBRATED[0].lower() + _UNCALIBRATED[1:]
    return Section("Calibration", text)


def _hand_sections(take: Take, hand: HandFigures) -> list[Section]:
    side = hand.side.capitalize()
    if not hand.fitted.any():
        return [Section(f"{side} hand", "It has no pose in any frame.")]
    return [
        _angles_section(take, hand),
        _range_section(hand),
        _markers_section(take, hand),
        _residuals_section(take, hand),
    ]


def _angles_section(take: Take, hand: HandFigures) -> Section:
    drawn = picture(take_plots.ANGLES_SIZE, partial(take_plots.draw_angles, times=take.times, hand=hand))
    text = (
        "Zero is the flat hand. Flexion counts positive towards the palm, extension negative. Abduction "
        "counts positive towards the thumb; for the thumb itself away from the palm."
    )
    if hand.angle_spread is not None:
        text += " The band is one standard deviation to either side."
    return Section(f"{hand.side.capitalize()} hand: joint angles", text, pictures=[(drawn, _SHADES)])


def _range_section(hand: HandFigures) -> Section:
    table = [["joint [deg]", *RANGE, "range of the model", "usual spread"]]
    spreads = hand.usual_spreads()
    for joint, row, spread in zip(JOINTS, hand.range_of_motion(), spreads, strict=True):
        cells = [f"{value:.1f}" for value in row]
        usual = _NOTHING if np.isnan(spread) else f"{spread:.1f}"
        table.append([joint.name.replace("_", " "), *cells, f"{joint.low:g} to {joint.high:g}", usual])
    text = (
        f"Over the {int(hand.fitted.sum()):,} frames whose pose was fitted to points; 5th and 95th are "
        "percentiles, which a single wrong frame does not move. Spread: the median standard deviation of the "
        "angle, from what is not known of the hand, hidden markers and noise."
    )
    return Section(f"{hand.side.capitalize()} hand: range of motion", text, table=table)


def _markers_section(take: Take, hand: HandFigures) -> Section:
    header = ["marker", "seen [%]", "gaps", "longest [s]", "residual: median [mm]", "95th [mm]"]
    table = [[*header, "confidence: median [%]"]]
    for marker in hand.markers():
        table.append(
            [
                marker.name,
                percent(marker.seen),
                f"{marker.num_gaps:,}",
                f"{marker.longest_gap / take.rate:.3f}" if marker.num_gaps else _NOTHING,
                _millimeters(marker.median_residual),
                _millimeters(marker.high_residual),
                percent(marker.median_confidence),
            ]
        )
    size = take_plots.presence_size(len(hand.marker_names))
    drawn = picture(size, partial(take_plots.draw_presence, times=take.times, hand=hand))
    text = (
        "Seen: the share of all frames in which a point has the marker's label. A gap is between two frames "
        "that have it. Residual: how far the point is from the marker of the pose."
    )
    caption = "Blue where the marker was seen; pale where it was seen in some of the frames of a column."
    return Section(f"{hand.side.capitalize()} hand: markers", text, pictures=[(drawn, caption)], table=table)


def _residuals_section(take: Take, hand: HandFigures) -> Section:
    drawn = picture(
        take_plots.RESIDUALS_SIZE, partial(take_plots.draw_residuals, times=take.times, hand=hand)
    )
    rms = hand.rms[np.isfinite(hand.rms)]
    if not len(rms):
        return Section(f"{hand.side.capitalize()} hand: residuals", "None of its markers has a point.")
    text = (
        "RMS distance of the labeled points of each frame from the pose's markers: median "
        f"{1e3 * np.median(rms):.2f} mm, 95th percentile {1e3 * np.percentile(rms, 95.0):.2f} mm."
    )
    return Section(f"{hand.side.capitalize()} hand: residuals", text, pictures=[(drawn, _SHADES)])


def _doubts_section(take: Take, doubts: Sequence[SuspectSpan], source: str) -> Section:
    command = f"handsim view {shlex.quote(source)}"
    if not doubts:
        return Section("Doubtful frames", "No label is probably wrong or missing.")
    table = [["frames", "start [s]", "end [s]", "of", "why", "to look at", "in"]]
    for doubt in doubts[:_MOST_DOUBTS]:
        frames = f"{doubt.first}" if doubt.first == doubt.last else f"{doubt.first} to {doubt.last}"
        start, end, worst = (f"{take.times[one]:.3f}" for one in (doubt.first, doubt.last, doubt.worst))
        look = f"frame {doubt.worst}, {worst} s"
        table.append([frames, start, end, doubt.of, doubt.why, look, f"{command} --time {worst}"])
    text = (
        "Spans in which a label is probably wrong or a marker lacks its own, those with the most such frames "
        "first; the percentage is the least confidence in a point. "
        f"<code>{escape(command)}</code> lists the first of them too; a click leads there, "
        "and a wrong label can be corrected."
    )
    more = f"These are the first {_MOST_DOUBTS} of {len(doubts):,}; the table beside the page has all."
    notes = [more] if len(doubts) > _MOST_DOUBTS else []
    return Section("Doubtful frames", text, table=table, notes=notes)


def _millimeters(meters: float) -> str:
    return _NOTHING if np.isnan(meters) else f"{1e3 * meters:.2f}"
