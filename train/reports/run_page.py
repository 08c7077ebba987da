"""The page of a training run, with its curves and confusions, and the model card."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Int

from gloves.layout import MarkerLayout, stored_layout
from handsim.files.outputs import write_text
from handsim.pages import NOTHING, Paint, Section, annotate, color_bar, picture, write_sections
from train.evaluation import (
    BINS,
    LEAST_SURE,
    SEEN,
    History,
    LabelingReport,
    Reliability,
    percent,
    percent_between,
    reliability,
)
from train.labelers.storage import GLOVE
from train.reports.hand_plot import HAND_CAPTION, hand_picture, mistakes, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE: Final = "report.html"
MODEL_CARD: Final = "README.md"
UNKNOWN_LICENSE: Final = "unknown"
"""License in the card of weights whose owner has named none, as hubs of models call it."""
_COLUMN_WORDS: Final = {SEEN: SEEN, "clean": "where every marker is seen"}
_KIND_WORDS: Final = {"set": "A set labeler", "cnn": "The network of Han et al. 2018"}
_MIN_SHARE: Final = 0.01  # [%] lower end of the confusions' color scale
_MAX_WRITTEN: Final = 30  # largest number of classes for which cells have room for numbers

_CARD_FIGURES: Final = {
    "slot_accuracy": "labels and gaps that are right",
    "point_accuracy": "points labeled right",
    "frame_accuracy": "frames without a mistake",
}


def write_run_page(out: Path, card: dict[str, Any], history: History, report: LabelingReport) -> Path:
    """Write the page of a run and return its path; the report is on frames with the paper's corruption."""
    layout = stored_layout(card["dataset"]["layout"])
    caption = (
        "Mean loss since the previous point; slot accuracy on the same held-out frames each time, with the "
        "paper's recipe and the running mean of the weights; learning rate."
    )
    curves = picture((9.6, 5.6), draw_curves, history)
    size = confusion_size(layout.num_markers + 1)
    confusion = picture(size, draw_confusion, layout.names, report.confusion)
    wrong = int((~report.right).sum())
    mistaken = f"{wrong:,} of {report.right.size:,} points have a wrong label."
    shares = (
        "Rows are true labels, columns given labels; the last row and column are ghosts. The shares of a row "
        "add up to 100 %. The color scale is logarithmic; blank cells are mistakes that never happened."
    )
    bins = reliability(report.confidences, report.right)
    drawn = picture((6.4, 6.0), draw_reliability, bins, report.figures["calibration_error"])
    sure = "How well the confidence of labels agrees with the share of right labels."
    binned = (
        "Points in fifteen bins of confidence: the share of right labels, and the number of points. On the "
        "gray line confidence and share are equal; orange lines are the differences."
    )
    sections = [
        _figures_section(card, report),
        Section("The run", "The course of training.", pictures=[(curves, caption)]),
        Section("Confusions", mistaken, pictures=[(confusion, shares)]),
        _hand_section(layout, report),
        Section("Confidence", sure, pictures=[(drawn, binned)]),
    ]
    path = out / PAGE
    write_sections(path, sections, title=f"Labeler {out.resolve().name}", lead=_lead(card, layout))
    return path


def _lead(card: dict[str, Any], layout: MarkerLayout) -> str:
    """Settings of the run and its main figures, in words."""
    train = card["train"]
    shown = [
        f"{_figure_text(card, name, 'slot_accuracy')} % of the slots are right "
        f"{_COLUMN_WORDS.get(name, f'with the paper recipe ({name})')}"
        for name, column in card["held_out_simulated"].items()
    ]
    average = f", weights averaged with decay {train['average']:g}" if train["average"] else ""
    return (
        f"{_KIND_WORDS[train['labeler']]} for glove {layout.name} ({layout.num_markers} markers), trained on "
        f"{train['samples']:,} clouds of a set of {card['dataset']['num_frames']:,} simulated frames, in "
        f"batches of {train['batch']}: {100 * train['rig_share']:g} % of them as the simulated rig saw them, "
        f"the others through random drops and ghosts. Optimizer {train['optimizer']}, learning rate from "
        f"{train['learning_rate']:g}, schedule {train['schedule']}{average}, seed {train['seed']}. On "
        f"{held_out_people(card)}, {', '.join(shown[:-1])}, and {shown[-1]}."
    )


def held_out_people(card: dict[str, Any]) -> str:
    """Description of the frames behind the figures of a card."""
    count = card.get("held_out_people")
    if count is None:
        return "held-out frames"
    if count == 0:
        return "held-out frames of the only person of the set, who was seen in training"
    return f"frames of {count} {'person' if count == 1 else 'people'} whom training did not see"


def _figure_text(card: dict[str, Any], column: str, name: str) -> str:
    """A figure of a column in percent, with its interval over people if there is one."""
    interval = card.get("held_out_intervals", {}).get(column, {}).get(name)
    return percent_between(card["held_out_simulated"][column][name], interval)


def _figures_section(card: dict[str, Any], report: LabelingReport) -> Section:
    """Table of all figures."""
    columns = card["held_out_simulated"]
    (recipe,) = set(columns) - {SEEN, "clean"}
    table = [["figure [%]", *columns]]
    table += [
        [name.replace("_", " "), *(_figure_text(card, column, name) for column in columns)]
        for name in columns[recipe]
    ]
    text = (
        f"On {report.num_frames:,} {held_out_people(card)}. The pictures below show the figures with the "
        f"paper's recipe: {recipe} at most, drawn at random. Intervals of 95 % are over people."
    )
    notes = [
        f"The last line is the share of points labeled wrongly without the {100 * LEAST_SURE:g} % that the "
        f"labeler is least sure of; with them it is {percent(1.0 - columns[recipe]['point_accuracy'])} %."
    ]
    return Section("In figures", text, table=table, notes=notes)


def draw_curves(figure: Figure, history: History) -> None:
    """Draw loss, held-out accuracy if known, and learning rate over the samples."""
    from matplotlib.ticker import LogFormatter

    done, losses, rates = np.array(history.losses, dtype=np.float64).reshape(-1, 3).T
    single = "o" if len(done) == 1 else None
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=(2.6, 1.5, 0.9))
    upper.plot(done, losses, color=Paint.BLUE, linewidth=1.6, marker=single)
    upper.set_yscale("log")
    for axis in (upper.yaxis.set_major_formatter, upper.yaxis.set_minor_formatter):
        axis(LogFormatter(minor_thresholds=(2.0, 0.5)))
    upper.set_ylabel("loss")
    if history.accuracies:
        seen, _, accuracy = np.array(history.accuracies, dtype=np.float64).T
        middle.plot(seen, 100.0 * accuracy, "o-", color=Paint.WARM, linewidth=1.6, markersize=4.5)
        last = 100.0 * accuracy[-1]
        annotate(
            middle, f"{last:.2f}", (seen[-1], last), (0, -12), ha="right", color=Paint.WARM, weight="bold"
        )
    middle.set_ylabel("held-out slots\nright [%]")
    middle.margins(y=0.2)
    lower.plot(done, rates, color=Paint.SOFT, linewidth=1.4, marker=single)
    lower.set(xlabel="samples", ylabel="learning\nrate", xlim=(0.0, None), ylim=(0.0, None))
    lower.xaxis.set_major_formatter("{x:,.0f}")
    for panel in (upper, middle, lower):
        panel.grid(axis="y", which="major", color=Paint.BAND, linewidth=0.8)
    figure.align_ylabels()


def confusion_size(num_classes: int) -> tuple[float, float]:
    """Width and height [inch] of a confusion matrix with readable names."""
    side = 1.6 + num_classes * float(np.clip(8.4 / num_classes, 0.15, 0.36))
    return side + 0.9, side


def draw_confusion(figure: Figure, names: Sequence[str], confusion: Int[np.ndarray, "M+1 M+1"]) -> None:
    """Draw the shares of each row's points: mistakes in color, the diagonal as numbers."""
    from matplotlib.colors import LogNorm

    classes = [*map(short, names), "ghost"]
    places = np.arange(len(classes))
    with np.errstate(invalid="ignore"):  # Rows without points are NaN.
        shares = 100.0 * confusion / confusion.sum(axis=1, keepdims=True)
    wrong = np.where(np.eye(len(classes), dtype=np.bool_) | (shares == 0.0), np.nan, shares)
    # From the decade below the rarest mistake to the most frequent one.
    rarest, most = np.nanmin(wrong, initial=1.0), np.nanmax(wrong, initial=10.0)
    norm = LogNorm(max(_MIN_SHARE, 10.0 ** np.ceil(np.log10(rarest) - 1.0)), most, clip=True)
    panel: Axes = figure.subplots()
    for place, right in enumerate(shares.diagonal()):
        low, high = place - 0.5, place + 0.5
        panel.fill([low, high, high, low], [low, low, high, high], color=Paint.BAND, linewidth=0)
        if len(classes) <= _MAX_WRITTEN and np.isfinite(right):
            panel.annotate(f"{right:.1f}" if right < 99.95 else "100", (place, place), ha="center",
                           va="center", fontsize=6.0, color=Paint.SOFT)  # fmt: skip
    edges = np.arange(len(classes) + 1) - 0.5
    shades = panel.pcolormesh(edges, edges, np.ma.masked_invalid(wrong), cmap="Oranges", norm=norm)
    panel.hlines(edges, edges[0], edges[-1], color=Paint.BAND, linewidth=0.5)
    panel.vlines(edges, edges[0], edges[-1], color=Paint.BAND, linewidth=0.5)
    small = 8.0 if len(classes) <= _MAX_WRITTEN else 6.5
    panel.set_xticks(places, classes, rotation=90, fontsize=small, color=Paint.INK, parse_math=False)
    panel.set_yticks(places, classes, fontsize=small, color=Paint.INK, parse_math=False)
    panel.set(xlim=(edges[0], edges[-1]), ylim=(edges[-1], edges[0]), aspect="equal")
    panel.set(xlabel="given label", ylabel="true label")
    panel.tick_params(length=0)
    panel.spines[:].set_visible(False)
    bar = color_bar(
        figure, shades, "share of the row's points [%]", ax=panel, pad=0.02, aspect=40, shrink=0.8
    )
    bar.yaxis.set_major_formatter("{x:g}")


def _hand_section(layout: MarkerLayout, report: LabelingReport) -> Section:
    """Accuracies and confusions on a drawing of the hand."""
    arrows, names = mistakes(report.confusion), layout.names
    drawn = hand_picture(layout, report.slot_accuracy_by_marker, arrows)
    caption, table = "No marker was taken for another.", []
    if arrows:
        caption = f"Arrows lead from true to given labels: the {len(arrows)} most frequent "
        caption += "confusions, wider for more points."
        table = [["marker", "taken for", "points", "of its points [%]"]]
    for arrow in arrows:
        pair = names[arrow.truth], names[arrow.called]
        table.append([*pair, f"{arrow.points:,}", percent(arrow.share)])
    text = _hand_text(layout, report)
    return Section("On the hand", text, pictures=[(drawn, HAND_CAPTION + caption)], table=table)


def _hand_text(layout: MarkerLayout, report: LabelingReport) -> str:
    """The worst markers, and figures on occluded markers and ghosts, as HTML."""
    order = np.argsort(report.slot_accuracy_by_marker, kind="stable")[:3]
    worst = ", ".join(
        f"{escape(layout.names[marker])} {percent(report.slot_accuracy_by_marker[marker])} %"
        for marker in order
    )
    figures, confusion = report.figures, report.confusion
    markers, ghosts = confusion[:-1].sum(), confusion[-1].sum()
    lost = percent(confusion[:-1, -1].sum() / markers) if markers else NOTHING
    named = percent(confusion[-1, :-1].sum() / ghosts) if ghosts else NOTHING
    return (
        f"Least often right: {worst} of their slots. Of all slots {percent(figures['occlusion_ratio'])} % "
        f"had no point; the labeler found {percent(figures['occlusion_recall'])} % of those. There were "
        f"{percent(figures['ghost_ratio'])} ghosts for a hundred slots: {named} % of them were taken for "
        f"markers, and {lost} % of the markers' points for ghosts."
    )


def draw_reliability(figure: Figure, bins: Reliability, error: float) -> None:
    """Draw the share of right labels by confidence, and below it the number of points."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.0, 1.0))
    there = bins.count > 0
    upper.plot([0.0, 100.0], [0.0, 100.0], color=Paint.LINE, linewidth=1.4, zorder=1)
    confidence, right = 100.0 * bins.confidence[there], 100.0 * bins.right[there]
    upper.vlines(confidence, confidence, right, color=Paint.WARM, linewidth=2.0, zorder=2)
    upper.plot(confidence, right, "o-", color=Paint.BLUE, markersize=5.0, linewidth=1.4, zorder=3)
    upper.set(ylim=(-3.0, 103.0), ylabel="points right [%]")
    upper.set_title(f"expected calibration error {100.0 * error:.2f} %", loc="left", color=Paint.WARM)
    edges = np.linspace(0.0, 100.0, BINS + 1)
    lower.stairs(np.maximum(bins.count, 0.5), edges, fill=True, color=Paint.PALE, baseline=0.5)
    lower.set(yscale="log", ylim=(0.5, 2.0 * max(1, int(bins.count.max()))), xlim=(0.0, 100.5))
    lower.set(xlabel="confidence [%]", ylabel="points")
    figure.align_ylabels()


def write_model_card(out: Path, card: dict[str, Any]) -> Path:
    """Write the README of a run's folder and return its path; one with a license is not replaced."""
    path = out / MODEL_CARD
    if path.is_file() and f"license: {UNKNOWN_LICENSE}" not in path.read_text("utf-8", "replace"):
        return path
    write_text(path, model_card(card))
    return path


def model_card(card: dict[str, Any]) -> str:
    """Text of the README for hubs of models: YAML, data, figures, use and limits."""
    dataset, columns = card["dataset"], card["held_out_simulated"]
    figures = [f"| | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    figures += [
        f"| {words} | {' | '.join(_figure_text(card, column, name) for column in columns)} |"
        for name, words in _CARD_FIGURES.items()
    ]
    template = Path(__file__).with_name("model_card.md").read_text("utf-8")
    return template.format(
        license=card["license"],
        layout=dataset["layout"]["name"],
        glove=GLOVE,
        kind=_KIND_WORDS[card["train"]["labeler"]],
        version=card["handsim"],
        count=len(card["marker_names"]),
        markers=", ".join(card["marker_names"]),
        trained_on=card["trained_on"],
        num_frames=dataset["num_frames"],
        seed=dataset["seed"],
        samples=card["train"]["samples"],
        people=held_out_people(card),
        figures="\n".join(figures),
    )
