"""The report page of a layout's score: advice, captures, labels with confusions, markers and joints."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from handsim.hand.shape import DIGITS, JOINTS
from handsim.pages import NOTHING, Paint, Section, color_bar, color_scale, html_list, picture, write_sections
from track.gloves.glove_score import METHODS, NOISE, LayoutScore, Trial
from train.evaluation import percent, percent_between
from train.reports.hand_plot import HAND_CAPTION, FlatHand, Mistake, flat_hand, hand_picture, mistakes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCALE_END_DEG: Final = 15.0  # [deg] end of the color scale
_TRIALS_TEXT: Final = (
    "A capture is wrong throughout if some marker is right in fewer than half of its frames; other captures "
    "count with the probability of other labels that the take itself states. Shares of right slots (mean, "
    "worst capture) and of completely right frames in short simulated captures of several people, as by "
    "`handsim label` and `handsim track`. Joints: root mean square error over all joints of measured but "
    "uncalibrated hands; the section on joints is on calibrated ones."
)
_MOST_PAIRS: Final = 5  # number of listed pairs of similar labels


def write_glove_page(path: Path, score: LayoutScore) -> None:
    """Write the page on a layout's score."""
    layout, nothing = score.layout, "No figure is beyond its threshold."
    sections = [
        *([_captures_section(score)] if score.trials else []),
        Section("What to do", html_list(score.advice) if score.advice else nothing),
        _labels_section(score),
        _markers_section(score),
        _joints_section(score),
    ]
    network = "a labeler trained on it"
    if not score.is_trained:
        network = "the network for any layout, after a minute of learning this one"
    lead = (
        f"{layout.num_markers} markers of {1e3 * layout.radius:.1f} mm, on {score.observed.num_frames:,} "
        f"frames of {score.seen_by}. Points were labeled by {network}."
    )
    write_sections(path, sections, title=f"Layout {layout.name}", lead=lead)


def trial_rows(trials: Mapping[str, Trial], layout: MarkerLayout) -> list[list[str]]:
    """Table of the simulated captures of each kind of work, header first."""
    rows = [
        ["work", "wrong captures [%]", *(f"{name}: slots, worst, frames [%]" for name in METHODS),
         "worst marker", "joints [deg]", "size off [mm]"]
    ]  # fmt: skip
    for work, trial in trials.items():
        rights = [
            f"{percent(trial.share(name))}, {percent(trial.least(name))}, {100 * trial.frames[name]:.0f}"
            for name in METHODS
        ]
        worst = f"{layout.names[trial.worst]} ({100 * trial.right[trial.worst]:.0f} %)"
        rows.append(
            [
                work,
                f"{100 * trial.wrong:.0f}",
                *rights,
                worst,
                f"{trial.joint_error:.1f}",
                f"{1e3 * trial.size_error:.1f}",
            ]
        )
    return rows


def wrong_line(score: LayoutScore) -> str:
    """A sentence: the probability that labels are wrong throughout a capture, and the most similar labels."""
    share, ends = score.wrong
    between = " to ".join(f"{100 * end:.0f}" for end in ends)
    count = sum(len(trial.captures) for trial in score.trials.values())
    likeliest = [f"{one.words} ({100 * one.probability:.1f} %)" for one in score.alternatives[:_MOST_PAIRS]]
    return (
        f"labels are wrong throughout a capture with a probability of {100 * share:.0f} % ({between}), "
        f"from {count} captures; most similar: {', '.join(likeliest) or 'no other labels fit nearly as well'}"
    )


def _captures_section(score: LayoutScore) -> Section:
    """The captures of each kind of work, with the most similar labels on the hand."""
    text = escape(wrong_line(score))
    right = np.mean([trial.right for trial in score.trials.values()], axis=0)
    arrows = [
        Mistake(first, second, round(1e6 * one.probability), one.probability)
        for one in score.alternatives
        if len(one.markers) < score.layout.num_markers
        for first, second in itertools.pairwise(one.markers)
    ]
    caption = f"{HAND_CAPTION}Arrows join markers whose labels may be exchanged, wider for the likelier ones."
    drawn = [(hand_picture(score.layout, right, arrows), caption)] if arrows else []
    table = trial_rows(score.trials, score.layout)
    return Section("Captures", f"{text[0].upper()}{text[1:]}. {_TRIALS_TEXT}", table=table, pictures=drawn)


def _labels_section(score: LayoutScore) -> Section:
    columns = (score.observed, score.corrupted, score.clean)
    table = [["labels [%]", "as the rig sees them", "the paper's drops and ghosts", "every marker seen"]]
    for title, name in (("slots right", "slot_accuracy"), ("whole frames right", "frame_accuracy")):
        shares = (percent_between(report.figures[name], report.interval(name)) for report in columns)
        table.append([title, *shares])
    accuracy, arrows = score.observed.slot_accuracy_by_marker, mistakes(score.observed.confusion)
    caption = f"{HAND_CAPTION}Arrows lead from true to given labels, wider for more points."
    people = score.observed.num_groups
    over = f" Intervals of 95 % are over {people} people." if people > 1 else ""
    text = f"Labels of single frames, without tracking.{over}"
    drawn = hand_picture(score.layout, accuracy, arrows)
    return Section("Labels", text, table=table, pictures=[(drawn, caption)])


def _markers_section(score: LayoutScore) -> Section:
    names, accuracy = score.layout.names, score.observed.slot_accuracy_by_marker
    worst = {mistake.truth: mistake for mistake in reversed(mistakes(score.observed.confusion, 200))}
    table = [["marker", "seen [%]", "slots right [%]", "taken for", "of its points [%]"]]
    for number, name in enumerate(names):
        mistake = worst.get(number)
        taken = (names[mistake.called], percent(mistake.share)) if mistake else (NOTHING, NOTHING)
        shares = percent(score.seen[number]), percent(accuracy[number])
        table.append([name, *shares, *taken])
    text = "Seen: share of frames in which the marker has a point."
    return Section("Markers", text, table=table)


def _joints_section(score: LayoutScore) -> Section:
    caption = "Markers are small rings; disks show the standard deviation of the worst angle there [deg]."
    table = [["joints [deg]", "abduction", "first flexion", "second flexion", "last flexion"]]
    degrees = np.rad2deg(score.joints)
    rows = zip(DIGITS, degrees.reshape(len(DIGITS), -1), strict=True)
    table += [[digit, *(f"{one:.1f}" for one in row)] for digit, row in rows]
    text = (
        "Standard deviation of each joint angle in single frames, from markers within "
        f"{1e3 * NOISE:g} mm of a calibrated hand's and from the limits of the joints. Tracking does "
        "better, by the hand's motion and the prior of joint angles."
    )
    drawn = picture((8.4, 6.4), _draw_joints, flat_hand(score.layout), degrees)
    return Section("Joints", text, table=table, pictures=[(drawn, caption)])


def _draw_joints(figure: Figure, hand: FlatHand, degrees: Float[np.ndarray, "20"]) -> None:
    """Draw a disk at each bone's proximal end, colored by the worst joint's standard deviation."""
    panel = figure.subplots()
    panel.set_axis_off()
    panel.set_aspect("equal")
    hand.draw(panel, bone_width=2.5, zorder=1)
    panel.plot(*hand.markers.T, "o", color=Paint.SOFT, markersize=5.0, markerfacecolor=Paint.CARD, zorder=2)
    colors = color_scale(_SCALE_END_DEG, 0.0)
    for bone in sorted({joint.bone for joint in JOINTS}):
        worst = max(degrees[number] for number, joint in enumerate(JOINTS) if joint.bone == bone)
        place, color = hand.bones[bone - 1][0], colors.to_rgba(worst)
        panel.plot(*place, "o", markersize=15.0, color=color, markeredgecolor=Paint.INK, zorder=3)
        panel.annotate(
            f"{worst:.0f}", place, fontsize=7.5, ha="center", va="center_baseline", color=Paint.INK, zorder=4
        )
    told = "standard deviation of the worst joint [deg]"
    color_bar(figure, colors, told, ax=panel, shrink=0.6, extend="max")
