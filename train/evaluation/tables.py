"""Tables of labeling: the paper's tests for our labelers, with its figures beside ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from rich.table import Table

from train.data.augmentation import Corruption
from train.data.batches import paper_corruption
from train.evaluation.labeler_evaluation import Report, evaluate_labeler
from train.evaluation.paper import AUGMENTATIONS, TABLE2, TEST_SETS
from train.labelers.protocol import Labeler
from train.simulation.room_settings import KINDS
from train.simulation.takes import simulate_take

if TYPE_CHECKING:
    from gloves.takes.take import Take


FIGURES: Final = {
    "slot_accuracy": "Accuracy (slots)",
    "point_accuracy": "Accuracy (points)",
    "frame_accuracy": "Frames all right",
    "macro_f1": "Macro F1",
    "occlusion_ratio": "O ratio",
    "occlusion_precision": "O precision",
    "occlusion_recall": "O recall",
    "ghost_ratio": "G ratio",
    "ghost_precision": "G precision",
    "ghost_recall": "G recall",
}
"""Rows of Tables 4 and 6, the paper's and ours."""


def augmentations(num_markers: int) -> dict[str, Corruption]:
    """The four test sets of Table 2 for a layout, see `train.data.batches.paper_corruption`."""
    most = paper_corruption(num_markers)
    drawn = ((0, 0), (most.occlude, 0), (0, most.ghosts), (most.occlude, most.ghosts))
    return {name: Corruption(*pair) for name, pair in zip(AUGMENTATIONS, drawn, strict=True)}


def measure_augmentations(
    labeler: Labeler, markers: Float[np.ndarray, "T M 3"], *, seed: int
) -> dict[str, Report]:
    """Table 2's column of one network: the markers [m] as they are, with drops, with ghosts, with both."""
    return {
        name: evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(seed))
        for name, corruption in augmentations(markers.shape[1]).items()
    }


def simulate_takes(glove: str, seed: int, done: Callable[[], None]) -> dict[str, Take]:
    """The twins of the paper's four captures."""
    takes: dict[str, Take] = {}
    for kind in KINDS:
        takes[kind] = simulate_take(kind=kind, glove=glove, seed=seed)
        done()
    return takes


def measure_tests(
    labeler: Labeler,
    stills: Mapping[str, Float[np.ndarray, "T M 3"]],
    takes: Mapping[str, Take],
    *,
    seed: int,
) -> dict[str, Report]:
    """Tables 4 and 6 for one labeler.

    Args:
        labeler: The labeler to evaluate.
        stills: Sets of true markers [m] that get the paper's corruption, by name.
        takes: Simulated captures, by name.
        seed: Seed of the corruption.
    """
    recipe = paper_corruption(len(labeler.marker_names))
    reports = {
        name: evaluate_labeler(labeler, markers, recipe, rng=np.random.default_rng(seed))
        for name, markers in stills.items()
    }
    return reports | {name: evaluate_labeler(labeler, [take]) for name, take in takes.items()}


def print_table2(nets: Mapping[str, Mapping[str, Report]], *, title: str) -> Table:
    """Slot accuracy of networks (columns) on test sets (rows), the paper's in brackets."""
    table = Table(title=title)
    table.add_column("test \\ net", no_wrap=True)
    for name in nets:
        table.add_column(name, justify="right")
    for test in AUGMENTATIONS:
        paper = dict(zip(AUGMENTATIONS, TABLE2[test], strict=True))
        table.add_row(
            test,
            *(_cell(reports[test].figures["slot_accuracy"], paper[net]) for net, reports in nets.items()),
        )
    return table


def print_tests(
    reports: Mapping[str, Report], paper: Mapping[str, tuple[float, ...]], *, title: str
) -> Table:
    """Figures (rows) by test set (columns), the paper's in brackets where it has one."""
    table = Table(title=title)
    table.add_column("[%]", no_wrap=True)
    for test in reports:
        table.add_column(test, justify="right")
    for figure, words in FIGURES.items():
        printed = dict(zip(TEST_SETS, paper[figure], strict=True)) if figure in paper else {}
        cells = (_cell(report.figures[figure], printed.get(test)) for test, report in reports.items())
        table.add_row(words, *cells)
    return table


def _cell(ours: float, paper: float | None) -> str:
    percent = "-" if np.isnan(ours) else f"{100 * ours:.2f}"
    return percent if paper is None else f"{percent} ({100 * paper:.2f})"
