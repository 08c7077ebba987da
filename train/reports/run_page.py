"""The page of a training run: figures, curves, confusions and reliability."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from gloves.layout import MarkerLayout, stored_layout
from handsim.app.page import Section, write_page
from train.evaluation import LEAST_SURE, History, LabelingReport, percent, reliability
from train.reports import hand_plot as _hand_plot
from train.reports import run_plots as _run_plots
from train.reports.flat_hand import flat_hand
from train.reports.plot_style import picture

PAGE: Final = "report.html"
_KINDS: Final = {"set": "Set labeler", "cnn": "The paper's network"}


def write_run_page(out: Path, card: dict[str, Any], history: History, report: LabelingReport) -> Path:
    """Write the page of a run: one HTML file with its pictures inside, complete or not at all; its path.

    The report is of held-out frames with the paper's corruption.
    """
    layout = stored_layout(card["dataset"]["layout"])
    sections = [
        _figures_section(card, report),
        _curves_section(history),
        _confusion_section(layout, report),
        _hand_section(layout, report),
        _reliability_section(report),
    ]
    path = out / PAGE
    write_page(path, sections, title=f"Labeler {out.resolve().name}", lead=_lead(card, layout))
    return path


def _lead(card: dict[str, Any], layout: MarkerLayout) -> str:
    """The run's settings and its two most telling figures, in words."""
    train = card["train"]
    clean, (recipe, corrupted) = _columns(card)
    average = f", weights averaged with decay {train['average']:g}" if train["average"] else ""
    return (
        f"{_KINDS[train['labeler']]} for glove {layout.name} ({layout.num_markers} markers), trained on "
        f"{train['samples']:,} clouds of a set of {card['dataset']['num_frames']:,} simulated frames, in "
        f"batches of {train['batch']}: {100 * train['rig_share']:g} % of them as the simulated rig saw them, "
        f"the others through random drops and ghosts. Optimizer {train['optimizer']}, learning rate from "
        f"{train['learning_rate']:g}, schedule {train['schedule']}{average}, seed {train['seed']}. On "
        f"held-out frames {percent(clean['slot_accuracy'])} % of the slots are right when every marker is "
        f"seen, and {percent(corrupted['slot_accuracy'])} % with the paper's recipe ({recipe})."
    )


def _columns(card: dict[str, Any]) -> tuple[dict[str, float], tuple[str, dict[str, float]]]:
    """Held-out figures without corruption, and the paper's recipe with those under it."""
    columns = dict(card["held_out_simulated"])
    clean = columns.pop("clean")
    ((recipe, corrupted),) = columns.items()
    return clean, (recipe, corrupted)


def _figures_section(card: dict[str, Any], report: LabelingReport) -> Section:
    clean, (recipe, corrupted) = _columns(card)
    table = [["figure [%]", "clean", recipe]]
    table += [[name.replace("_", " "), percent(clean[name]), percent(corrupted[name])] for name in corrupted]
    text = (
        f"On {report.num_frames:,} frames that training never saw, as they are and with the paper's recipe: "
        f"{recipe} at most, drawn at random. The pictures below show the latter."
    )
    notes = [
        f"The last line is the share of points labeled wrongly without the {100 * LEAST_SURE:g} % that the "
        f"labeler is least sure of; with them it is {percent(1.0 - corrupted['point_accuracy'])} %."
    ]
    return Section("In figures", text, table=table, notes=notes)


def _curves_section(history: History) -> Section:
    drawn = picture((9.6, 5.6), partial(_run_plots.draw_curves, history=history))
    caption = (
        "Mean loss since the point before; slot accuracy on the same few held-out frames each time, with the "
        "paper's recipe and the running mean of the weights; learning rate."
    )
    return Section(
        "The run", "How it went over the clouds that the network saw.", pictures=[(drawn, caption)]
    )


def _confusion_section(layout: MarkerLayout, report: LabelingReport) -> Section:
    draw = partial(_run_plots.draw_confusion, names=layout.names, confusion=report.confusion)
    drawn = picture(_run_plots.confusion_size(layout.num_markers + 1), draw)
    caption = (
        "A row holds the points of one marker, the last one ghosts; a column, what they were called. A row's "
        "shares add up to 100 %. The colors' scale is logarithmic; blank cells are mistakes never made."
    )
    wrong = int((~report.right).sum())
    text = f"{wrong:,} of {report.right.size:,} points were called something else than they are."
    return Section("What is taken for what", text, pictures=[(drawn, caption)])


def _hand_section(layout: MarkerLayout, report: LabelingReport) -> Section:
    arrows = _hand_plot.mistakes(report.confusion)
    draw = partial(
        _hand_plot.draw_hand, hand=flat_hand(layout), names=layout.names,
        accuracy=report.slot_accuracy_by_marker, arrows=arrows,
    )  # fmt: skip
    drawn = picture(_hand_plot.HAND_SIZE, draw)
    caption = (
        "A right hand of size M at rest, from the back; rings are markers that look to the palm's side. "
        + (
            f"Arrows lead from what points are to what they were called: the {len(arrows)} most frequent "
            "pairs, wider the more often."
            if arrows
            else "No marker was taken for another."
        )
    )
    names = layout.names
    table = [["marker", "taken for", "points", "of its points [%]"]] if arrows else []
    table += [
        [names[arrow.truth], names[arrow.called], f"{arrow.points:,}", percent(arrow.share)]
        for arrow in arrows
    ]
    return Section("On the hand", _hand_text(layout, report), pictures=[(drawn, caption)], table=table)


def _hand_text(layout: MarkerLayout, report: LabelingReport) -> str:
    """The markers most often wrong, and what became of hidden markers and ghosts; HTML."""
    order = np.argsort(report.slot_accuracy_by_marker, kind="stable")[:3]
    worst = ", ".join(
        f"{escape(layout.names[marker])} {percent(report.slot_accuracy_by_marker[marker])} %"
        for marker in order
    )
    figures, confusion = report.figures, report.confusion
    markers, ghosts = confusion[:-1].sum(), confusion[-1].sum()
    lost = percent(confusion[:-1, -1].sum() / markers) if markers else "-"
    named = percent(confusion[-1, :-1].sum() / ghosts) if ghosts else "-"
    return (
        f"Least often right: {worst} of their slots. Of all slots {percent(figures['occlusion_ratio'])} % "
        f"had no point; the labeler found {percent(figures['occlusion_recall'])} % of those. There were "
        f"{percent(figures['ghost_ratio'])} ghosts for a hundred slots: {named} % of them were taken for "
        f"markers, and {lost} % of the markers' points for ghosts."
    )


def _reliability_section(report: LabelingReport) -> Section:
    bins = reliability(report.confidences, report.right)
    error = report.figures["calibration_error"]
    drawn = picture((6.4, 6.0), partial(_run_plots.draw_reliability, bins=bins, error=error))
    caption = (
        "Points in fifteen bins of confidence: how many of each bin are right, and how many there are. On "
        "the gray line they would be right as often as the labeler says; orange is what they miss it by."
    )
    text = "Whether the confidence that comes with every label can be taken at its word."
    return Section("How sure to believe it", text, pictures=[(drawn, caption)])
