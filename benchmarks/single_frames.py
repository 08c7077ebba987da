"""Labels of single frames of real hands: as captured, with drops, with ghosts, and with both.

    python -m benchmarks.single_frames DATA [--glove dense19] [--labeler RUN] [--every 1] [--save label]

DATA is a folder of labeled captures, such as the public Mocap_SIG18_Data. The same as four calls of
`handsim evaluate`. `--save label` keeps label_clean,
label_drops, label_ghosts and label_both.
"""

from __future__ import annotations

from pathlib import Path

import torch

from benchmarks.record import Figures, describe, report, run
from train import LabelingReport, evaluate_labeler, load_labeler
from train.data.batches import paper_corruption

COLUMNS = (
    "slot, point, frame accuracy, occlusion and ghost precision / recall, macro F1, calibration error, "
    "error without the least sure"
)
TESTS = {"clean": (0, 0), "drops": (1, 0), "ghosts": (0, 1), "both": (1, 1)}
"""Whether markers are dropped and ghosts added."""


def figures_of(report: LabelingReport, markers: tuple[str, ...], title: str) -> Figures:
    """The shares of a report [%], and its worst marker."""
    share = {name: 100 * value for name, value in report.figures.items()}
    row = [
        *(share[f"{name}_accuracy"] for name in ("slot", "point", "frame")),
        *([share[f"{name}_precision"], share[f"{name}_recall"]] for name in ("occlusion", "ghost")),
        *(share[name] for name in ("macro_f1", "calibration_error", "error_without_least_sure")),
    ]
    worst = report.slot_accuracy_by_marker.argmin()
    slots = 100 * report.slot_accuracy_by_marker[worst]
    between = {name: [100 * end for end in ends] for name, ends in report.intervals().items()}
    return {
        "intervals": (
            f"95 % intervals over {report.num_groups} {report.grouped_by}: slot, point, frame accuracy [%]",
            list(between.values()),
        ),
        "row": (f"{report.num_frames:,} frames, {title}: {COLUMNS} [%]", row),
        "worst_marker": ("the marker that is labeled worst, slots right [%]", [markers[worst], slots]),
    }


def main(
    data: Path, glove: str = "dense19", labeler: Path | None = None, every: int = 1, save: str | None = None
) -> None:
    torch.set_num_threads(1)
    print(describe("torch"))
    network = load_labeler(glove, labeler)
    paper = paper_corruption(len(network.marker_names))
    print(f"[%]: {COLUMNS}")
    for name, (dropped, added) in TESTS.items():
        occlude, ghosts = dropped * paper.occlude, added * paper.ghosts
        found = evaluate_labeler(network, data, occlude=occlude, ghosts=ghosts, every=every)
        title = f"{glove}, occlude {occlude}, ghosts {ghosts}"
        report(save and f"{save}_{name}", figures_of(found, network.marker_names, title))


if __name__ == "__main__":
    run(main, __doc__)
