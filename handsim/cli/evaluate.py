"""The command `handsim evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from handsim.app.messages import print_line, print_table
from handsim.app.output import place_of
from handsim.errors import ArgumentError, CaptureError
from handsim.files.inputs import check_there
from handsim.files.outputs import check_outputs, save_json
from train.settings import EvaluateSettings

if TYPE_CHECKING:
    from train.evaluation import LabelingReport


def evaluate(
    captures: Annotated[tuple[str, ...], tyro.conf.Positional],
    settings: Annotated[EvaluateSettings, tyro.conf.arg(name="")],
    *,
    glove: str | None = None,
    labeler: str | None = None,
    truth: Path | None = None,
    json: Path | None = None,
    threads: int = 1,
) -> None:
    """Measure a labeler on labeled captures, corrupted as in the paper; or labels against a simulated truth.

    Args:
        captures: Labeled .trc, .c3d, .csv or .tsv files, folders searched for them, the .truth.npz of takes,
            or training sets, also as s3://bucket/prefix, which without drops and ghosts are counted as their
            rig saw them. Each hand of a capture of two, with columns right:ThumbTip and so on, is counted by
            itself.
        settings: What is evaluated.
        glove: Marker layout: a shipped name or the path of a .toml file; when not given that of a take, or
            dense19.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
        truth: The .truth.npz of a simulated take. Labels that a capture of it already has, or a tracked take
            .npz, are counted against it; no glove and no labeler are used.
        json: File for the figures.
        threads: Threads of the labeler; more than one helps a large network on an idle machine.
    """
    from gloves.takes.take import load_take
    from train.evaluation import evaluate_labeler, evaluate_labels, print_figures
    from train.labelers.protocol import label_on
    from train.labelers.storage import load_labeler

    check_outputs((*captures, glove, labeler, truth), [json])
    for capture in captures:
        if isinstance(place := place_of(capture), Path):  # An object store is read later.
            check_there(place, error=CaptureError)
    if truth is None:
        if glove is None and captures and Path(captures[0]).suffix.lower() == ".npz":
            glove = load_take(captures[0]).settings.get("glove")
        glove = glove or "dense19"
        label_on(threads)
        report = evaluate_labeler(load_labeler(glove, labeler), captures, settings=settings)
        found: dict[str, Any] = {"glove": glove, **settings.record()}
    elif len(captures) != 1 or (glove, labeler, threads, settings) != (None, None, 1, EvaluateSettings()):
        raise ArgumentError(
            f"--truth is given with {len(captures)} captures, expected one and none of --glove, --labeler, "
            "--threads, --occlude, --ghosts, --every and --seed: a capture's labels are counted as they are"
        )
    else:
        report = evaluate_labels(captures[0], truth)
        found = {"truth": str(truth)}
    by_marker = dict(zip(report.marker_names, map(float, report.slot_accuracy_by_marker), strict=True))
    found |= {"frames": report.num_frames, "figures": report.figures, "numbers": report.numbers}
    found["slot_accuracy_by_marker"] = by_marker
    hard = f", occlude {settings.occlude}, ghosts {settings.ghosts}"
    hard = hard if settings.occlude or settings.ghosts else ""
    what = "hands in frames" if truth is None else "frames"
    found["intervals"] = intervals = report.intervals()
    print_figures({"share": report.figures}, intervals, title=f"{report.num_frames} {what}{hard}")
    if intervals:
        print_line(f"in brackets: 95 % intervals over {report.num_groups} {report.grouped_by}")
    if truth is not None:
        found |= _against_truth(report)
    if json is not None:
        save_json(json, found)
    worst = [name for name in sorted(by_marker, key=by_marker.__getitem__)[:3] if by_marker[name] < 1.0]
    if worst:
        print_line("worst markers: " + ", ".join(f"{name} {100 * by_marker[name]:.2f} %" for name in worst))


def _against_truth(report: LabelingReport) -> dict[str, Any]:
    """Print the share of right slots of all markers and of each, and return their intervals."""
    from train.evaluation import percent

    rows = [["marker", "slots right [%]", "95 % interval"]]
    intervals: dict[str, tuple[float, float] | None] = {}
    shares = [report.figures["slot_accuracy"], *report.slot_accuracy_by_marker]
    for index, name in enumerate(("all", *report.marker_names)):
        interval = report.interval(marker=index - 1 if index else None)
        between = "-" if interval is None else " to ".join(map(percent, interval))
        rows.append([name, percent(float(shares[index])), between])
        intervals[name] = interval
    print_table(rows)
    alone = [report.numbers[f"points_of_{one}_alone"] for one in ("truth", "capture")]
    if any(alone):
        print_line(f"{alone[0]} points only in the truth, {alone[1]} only in the capture")
    return {"slot_accuracy_interval": intervals.pop("all"), "slot_accuracy_interval_by_marker": intervals}
