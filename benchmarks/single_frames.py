"""Labels of single frames of real hands: as captured, with drops, with ghosts, and with both.

    python -m benchmarks.single_frames DATA [--glove dense19] [--labeler RUN] [--every 1] [--command]
        [--save label]

DATA is a folder of labeled captures, such as the public Mocap_SIG18_Data. The same as four calls of
`handsim evaluate`. With --command the labels are those of `handsim label`, which is given the same frames as
captures of 4,096 in random order, and measures the hands in each. `--save label` keeps label_clean,
label_drops, label_ghosts and label_both.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.labeling_tables import measure_augmentations
from benchmarks.record import Figures, add_save, describe, save_figures
from gloves import Capture
from gloves.captures.formats import find_captures, read_markers
from track import label_capture
from train import Labeler, Labeling, LabelingReport, load_labeler

COLUMNS = (
    "slot, point, frame accuracy, occlusion and ghost precision / recall, macro F1, calibration error, "
    "error without the least sure"
)
NAMES = ("clean", "drops", "ghosts", "both")
RATE = 120.0  # [Hz] of a capture of frames in no order, which nothing depends on


class CommandLabeler:
    """`handsim label` as a labeler of one hand's frames; right or left, a marker counts as the same."""

    def __init__(self, glove: str, labeler: Labeler) -> None:
        self._glove, self._labeler = glove, labeler
        self.marker_names = labeler.marker_names

    def label_frames(self, frames: Sequence[np.ndarray]) -> list[Labeling]:
        """Labels of frames that are one capture, in random order."""
        points = np.full((len(frames), max(map(len, frames)), 3), np.nan)
        for row, cloud in zip(points, frames, strict=True):
            row[: len(cloud)] = cloud
        names = tuple(f"*{column}" for column in range(points.shape[1]))
        order = np.random.default_rng(0).permutation(len(frames))
        take = label_capture(Capture(names, points[order], RATE), glove=self._glove, labeler=self._labeler)
        labels = np.where(take.labels >= 0, take.labels % len(self.marker_names), -1)
        return [
            Labeling(labels[row, : len(cloud)], take.confidence[row, : len(cloud)])
            for row, cloud in zip(np.argsort(order), frames, strict=True)
        ]


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
    parser.add_argument("--command", action="store_true", help="label through `handsim label`")
    add_save(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(describe("torch"))
    labeler: Labeler = load_labeler(options.glove, options.labeler)
    markers = read_markers(find_captures([options.data]), labeler.marker_names)[:: options.every]
    if options.command:
        labeler = CommandLabeler(options.glove, labeler)
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
