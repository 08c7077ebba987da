"""The page of a layout's score: advice, figures, the hand with confusions, and its joints."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from handsim.app.page import Section, write_page
from handsim.hand.shape import DIGITS, JOINTS
from track.glove_advice.joint_spread import NOISE
from track.glove_advice.layout_score import LayoutScore
from track.glove_advice.trials import METHODS, Trial
from train.evaluation import percent
from train.reports import hand_plot
from train.reports.flat_hand import FlatHand, flat_hand
from train.reports.plot_style import BAND, BLUE, CARD, INK, LINE, PALE, SOFT, WARM, picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_NOTHING: Final = "-"
SIZE: Final = (8.4, 6.4)
"""Of the picture [inch]."""
_MOST: Final = 15.0  # [deg], the end of the colors' scale
_DOT: Final = 15.0  # [points]
_MARKER: Final = 5.0


def write_score_page(path: Path, score: LayoutScore) -> None:
    """Write the page: one HTML file with its pictures inside."""
    layout, frames = score.layout, score.observed.num_frames
    sections = [
        _advice_section(score),
        *([_trials_section(score)] if score.trials else []),
        _labels_section(score),
        _markers_section(score),
        _joints_section(score),
    ]
    network = (
        "a labeler trained on it"
        if score.is_trained
        else "the network for any layout, after a minute of learning this one"
    )
    lead = (
        f"{layout.num_markers} markers of {1e3 * layout.radius:.1f} mm, on {frames:,} frames of "
        f"{score.seen_by}. "
        f"Points were labeled by {network}."
    )
    write_page(path, sections, title=f"Layout {layout.name}", lead=lead)


def _advice_section(score: LayoutScore) -> Section:
    sentences = score.advice
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    text = f"<ol>{items}</ol>" if sentences else "Nothing stands out: no marker is in anybody's way."
    return Section("What to do", text)


def trial_rows(trials: Mapping[str, Trial], layout: MarkerLayout) -> list[list[str]]:
    """What became of simulated captures of each kind of work, the header first."""
    rows = [
        ["work", "label: slots, frames [%]", "track: slots, frames [%]", "worst marker", "joints [deg]",
         "size off [mm]"]
    ]  # fmt: skip
    for work, trial in trials.items():
        joints = np.rad2deg(np.sqrt(np.mean(trial.joints**2)))
        rights = [f"{percent(trial.share(name))}, {100 * trial.frames[name]:.0f}" for name in METHODS]
        worst = f"{layout.names[trial.worst]} ({100 * trial.right[trial.worst]:.0f} %)"
        rows.append([work, *rights, worst, f"{joints:.1f}", f"{1e3 * trial.size_error:.1f}"])
    return rows


def _trials_section(score: LayoutScore) -> Section:
    text = (
        "Short captures of several people, simulated, then labeled and tracked as `handsim label` and "
        "`handsim track` do, the size of the hands measured and nothing calibrated: slots and whole frames "
        "that are right. Joints: root mean square error of all, of uncalibrated hands; the section on joints "
        "is about calibrated ones."
    )
    return Section("Captures", text, table=trial_rows(score.trials, score.layout))


def _labels_section(score: LayoutScore) -> Section:
    columns = (score.observed, score.clean, score.corrupted)
    table = [["labels [%]", "as the rig sees them", "every marker seen", "the paper's drops and ghosts"]]
    table += [
        [title, *(percent(report.figures[name]) for report in columns)]
        for title, name in (("slots right", "slot_accuracy"), ("whole frames right", "frame_accuracy"))
    ]
    arrows = hand_plot.mistakes(score.observed.confusion)
    draw = partial(
        hand_plot.draw_hand, hand=flat_hand(score.layout), names=score.layout.names,
        accuracy=score.observed.slot_accuracy_by_marker, arrows=arrows,
    )  # fmt: skip
    caption = (
        "A right hand of size M at rest, from the back; rings are markers that look to the palm's side. "
        "Arrows lead from what points are to what they are called, wider the more often."
    )
    text = f"Left and right are told apart in {percent(score.sides_right)} % of the frames."
    drawn = picture(hand_plot.HAND_SIZE, draw)
    return Section("Labels", text, table=table, pictures=[(drawn, caption)])


def _markers_section(score: LayoutScore) -> Section:
    names = score.layout.names
    worst = {
        mistake.truth: mistake for mistake in reversed(hand_plot.mistakes(score.observed.confusion, 200))
    }
    lost = np.rad2deg((score.joints_without - score.joints).max(axis=1))
    table = [["marker", "seen [%]", "slots right [%]", "taken for", "of its points [%]", "joints lose [deg]"]]
    for number, name in enumerate(names):
        mistake = worst.get(number)
        table.append(
            [
                name,
                percent(score.seen[number]),
                percent(score.observed.slot_accuracy_by_marker[number]),
                names[mistake.called] if mistake else _NOTHING,
                percent(mistake.share) if mistake else _NOTHING,
                f"{lost[number]:.1f}",
            ]
        )
    text = (
        "Seen: the marker becomes a point. Joints lose: by how much the worst-hit joint is known less well "
        "without it."
    )
    near = [
        f"{names[first]} and {names[second]}: {percent(score.near[first, second])} %"
        for first, second in _nearest_pairs(score.near)
    ]
    notes = [f"Pairs that touch or nearly do, in shares of the frames: {'; '.join(near)}."] if near else []
    return Section("Markers", text, table=table, notes=notes)


def _nearest_pairs(near: Float[np.ndarray, "M M"], most: int = 5) -> list[tuple[int, int]]:
    upper = np.triu(near)
    order = np.argsort(-upper, axis=None, kind="stable")[:most]
    pairs = zip(*np.unravel_index(order, upper.shape), strict=True)
    return [(int(first), int(second)) for first, second in pairs if upper[first, second] > 0.0]


def _joints_section(score: LayoutScore) -> Section:
    draw = partial(draw_joints, hand=flat_hand(score.layout), joints=score.joints)
    caption = (
        "Markers are small rings, joints disks: the standard deviation of the worst angle there, in degrees."
    )
    kinds = ("abduction", "first flexion", "second flexion", "last flexion")
    table = [["joints [deg]", *kinds]]
    degrees = np.rad2deg(score.joints).reshape(len(DIGITS), -1)
    table += [[digit, *(f"{one:.1f}" for one in row)] for digit, row in zip(DIGITS, degrees, strict=True)]
    text = (
        "Standard deviation of each joint's angle, from the information that the markers give the solver "
        f"frame by frame where they lie within {1e3 * NOISE:g} mm of a calibrated hand's, and from the "
        "limits of the joints. Tracking knows more: what the hand did before, and what hands usually do."
    )
    return Section("Joints", text, table=table, pictures=[(picture(SIZE, draw), caption)])


def draw_joints(figure: Figure, hand: FlatHand, joints: Float[np.ndarray, "20"]) -> None:
    """Draw a disk at each bone's near end: the worst joint there, in degrees.

    Args:
        figure: Where to draw, of `SIZE`.
        joints: Standard deviation of each joint [rad].
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    panel = figure.subplots()
    panel.set_axis_off()
    panel.set_aspect("equal")
    outline = Path.make_compound_path(*(Path(loop, closed=True) for loop in hand.outlines))
    panel.add_patch(PathPatch(outline, facecolor=BAND, edgecolor=LINE, linewidth=1.0))
    for bone in hand.bones:
        panel.plot(*bone.T, color=LINE, linewidth=2.5, solid_capstyle="round", zorder=1)
    panel.plot(*hand.markers.T, "o", color=SOFT, markersize=_MARKER, markerfacecolor=CARD, zorder=2)
    colors, norm = (
        LinearSegmentedColormap.from_list("spread", [BLUE, PALE, "#d9a441", WARM]),
        Normalize(0, _MOST),
    )
    degrees = np.rad2deg(joints)
    for bone in sorted({joint.bone for joint in JOINTS}):
        worst = max(degrees[number] for number, joint in enumerate(JOINTS) if joint.bone == bone)
        x, y = hand.bones[bone - 1][0]
        panel.plot(x, y, "o", markersize=_DOT, color=colors(norm(worst)), markeredgecolor=INK, zorder=3)
        panel.annotate(
            f"{worst:.0f}", (x, y), fontsize=7.5, ha="center", va="center_baseline", color=INK, zorder=4
        )
    bar = figure.colorbar(ScalarMappable(norm, colors), ax=panel, shrink=0.6, extend="max")
    bar.set_label("standard deviation of the worst joint [deg]")
    bar.outline.set_visible(False)
