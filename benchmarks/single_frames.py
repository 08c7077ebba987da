"""Labels of single frames of real hands: as captured, with drops, with ghosts, and with both.

    python -m benchmarks.single_frames DATA [--glove dense19] [--labeler RUN] [--every 1] [--save label]

DATA is a folder of labeled captures, such as the public Mocap_SIG18_Data. The same as four calls of
`handsim evaluate`. `--save label` keeps label_clean, label_drops, label_ghosts and label_both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.labeling_tables import measure_augmentations
from benchmarks.record import Figures, add_save, describe, save_figures
from gloves.captures.formats import find_captures, read_markers
from train.glove_labeler import load_labeler
from train.labeler_evaluation import Report

COLUMNS = (
    "slot, point, frame accuracy, occlusion and ghost precision / recall, macro F1, calibration error, "
    "error without the least sure"
)
NAMES = ("clean", "drops", "ghosts", "both")


def figures_of(report: Report, markers: tuple[str, ...], title: str) -> Figures:
    """The shares of a report [%], and its worst marker."""
    share = {name: 100 * value for name, value in report.figures.items()}
    row = [
        *(share[f"{name}_accuracy"] for name in ("slot", "point", "frame")),
        *([share[f"{name}_precision"], share[f"{name}_recall"]] for name in ("occlusion", "ghost")),
        *(share[name] for name in ("macro_f1", "calibration_error", "error_without_least_sure")),
    ]
    worst = report.slot_accuracy_by_marker.argmin()
    slots = 100 * report.slot_accuracy_by_marker[worst]
    return {
        "row": (f"{report.num_frames:,} frames, {title}: {COLUMNS} [%]", row),
        "worst_marker": ("the marker that is labeled worst, slots right [%]", [markers[worst], slots]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--glove", default="dense19")
    parser.add_argument("--labeler", type=Path)
    parser.add_argument("--every", type=int, default=1)
    add_save(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(describe("torch"))
    labeler = load_labeler(options.glove, options.labeler)
    markers = read_markers(find_captures([options.data]), labeler.marker_names)[:: options.every]
    print(f"[%]: {COLUMNS}")
    reports = measure_augmentations(labeler, markers, seed=0)
    for name, (test, report) in zip(NAMES, reports.items(), strict=True):
        figures = figures_of(report, labeler.marker_names, f"{options.glove}, {test}")
        row, (marker, slots) = (value for _, value in figures.values())
        print(
            f"{name}: {', '.join(map(str, np.round(np.hstack(row), 2)))}; worst {marker} {slots:.2f}",
            flush=True,
        )
        save_figures(options.save and f"{options.save}_{name}", figures)


if __name__ == "__main__":
    main()
