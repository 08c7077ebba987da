"""The paper's tables of labeling, with its figures beside ours."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final, NamedTuple, Self

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from benchmarks.held_out import held_out_markers
from benchmarks.paper.printed import AUGMENTATIONS, TABLE2, TABLE3, TABLE4, TABLE6, TEST_SETS, GapCounts
from benchmarks.people import read_markers
from benchmarks.record import Figures, number_table, save_figures
from gloves import Take
from gloves.captures.capture import run_lengths
from gloves.captures.formats import find_captures
from handsim import HandSimError
from handsim.app.messages import progress_bar
from train import (
    Corruption,
    Dataset,
    Labeler,
    LabelingReport,
    evaluate_labeler,
    load_labeler,
    simulate_take,
    train_labeler,
)
from train.data.batches import paper_corruption
from train.labelers.storage import shipped_labelers
from train.settings import usual_settings
from train.simulation.scenes import KINDS

# Median and p90 of real finger markers' gaps [frames]; docs/room.md.
PUBLISHED_GAPS: Final = "3-4", "24-43"
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
_KEYS: Final = dict(
    zip(
        FIGURES,
        "slots points frames f1 o_ratio o_precision o_recall g_ratio g_precision g_recall".split(),
        strict=True,
    )
)


def table2(
    data: Annotated[Path, tyro.conf.Positional],
    out: Path,
    *,
    samples: int = 300_000,
    num_frames: int = 5000,
    captures: tuple[Path, ...] = (),
    seed: int = 0,
    save: str | None = None,
) -> None:
    """Train the set labeler with and without random drops and ghosts, and test each network with and without.

    Args:
        data: Training set that handsim generate wrote.
        out: Folder for the runs; the same command continues where it was stopped.
        samples: Clouds that each network is trained on (the paper: 12.8 million).
        num_frames: Test frames of people and poses that are not in the training set.
        captures: Labeled captures or folders of them, for a second table.
        seed: Seed of the training, the test frames and their corruption.
        save: Name under which the last table's figures are kept in benchmarks/figures, such as table2.
    """
    dataset = Dataset(data)
    names, glove = dataset.marker_names, str(dataset.manifest.config["glove"])
    tests = {"held-out simulated frames": held_out_markers(glove, num_frames, seed=seed)}
    if captures:
        files = find_captures(captures)
        tests[f"{len(files)} captures"] = read_markers(files, names)
    runs = {name: out / f"set-{name}" for name in AUGMENTATIONS}
    for name, run in runs.items():
        _train_augmentation(dataset, name, run, samples, seed)
    for title, markers in tests.items():
        nets = {
            name: measure_augmentations(load_labeler(glove, run), markers, seed=seed)
            for name, run in runs.items()
        }
        Console().print(print_table2(nets, title=f"Table 2, set: {title}, ours (the paper's) [%]"))
        save_figures(save, _table2_figures(nets, f"Table 2, set, {title}"))


def _train_augmentation(dataset: Dataset, name: str, run: Path, samples: int, seed: int) -> None:
    drawn = augmentations(len(dataset.marker_names))[name]
    usual = dataclasses.replace(usual_settings("set"), samples=samples, seed=seed, rig_share=0.0)
    config = dataclasses.replace(usual, occlude=drawn.occlude, ghosts=drawn.ghosts)
    with progress_bar("samples") as bar:
        train_labeler(dataset, run, config, progress=bar, on_step=lambda step: bar.step(f"{name}, {step}"))


def table3(glove: str = "dense19", seed: int = 0, save: str | None = None) -> None:
    """Frames, gaps and ghosts of the simulated twins of the paper's captures.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        seed: Seed of the captures; 0 gives the twins, others give other captures of the same kinds.
        save: Name under which the figures are kept in benchmarks/figures, such as table3.
    """
    takes = _simulate(glove, seed)
    measures = {kind: TakeMeasures.of(kind, take) for kind, take in takes.items()}
    Console().print(_table3(measures))
    Console().print(_by_marker(measures))
    save_figures(save, _table3_figures(measures))


@dataclasses.dataclass(frozen=True, slots=True)
class TestConfig:
    """Settings of Tables 4 and 6."""

    labelers: tuple[str, ...] = ()
    """Shipped names, folders of trained labelers, or exported .onnx files; the layout's when not given."""
    num_frames: int = 5000
    """Test frames of people and poses that are in no training set, with the paper's recipe."""
    seed: int = 0
    """Seed of the test frames, the takes and the recipe; 0 gives the twins."""
    save: str | None = None
    """Name under which the last labeler's figures are kept in benchmarks/figures, such as table4."""


_Config = Annotated[TestConfig, tyro.conf.arg(name="")]


def table4(config: _Config) -> None:
    """Labelers of the dense layout on simulated test frames and on the twins of the paper's captures.

    Args:
        config: Settings of the measurement.
    """
    _print_tests("Table 4", "dense19", TABLE4, config)


def table6(config: _Config) -> None:
    """Labelers of the sparse layout on simulated test frames and on the twins of the paper's captures.

    Args:
        config: Settings of the measurement.
    """
    _print_tests("Table 6", "sparse13", TABLE6, config)


LABELING_TABLES: Final[dict[str, Callable[..., None]]] = {
    "table2": table2,
    "table3": table3,
    "table4": table4,
    "table6": table6,
}


def _print_tests(table: str, glove: str, paper: Mapping[str, tuple[float, ...]], config: TestConfig) -> None:
    if config.num_frames < 1:
        raise HandSimError(f"num_frames is {config.num_frames}, expected at least 1")
    found = {
        name: load_labeler(glove, name if name in shipped_labelers() else Path(name))
        for name in config.labelers or (glove,)
    }
    stills = {"synthetic": held_out_markers(glove, config.num_frames, seed=config.seed)}
    takes = _simulate(glove, config.seed)
    for name, labeler in found.items():
        reports = measure_tests(labeler, stills, takes, seed=config.seed)
        Console().print(print_tests(reports, paper, title=f"{table}, {name}: ours (the paper's)"))
        save_figures(config.save, _tests_figures(reports, paper, f"{table}, {name}"))


def _simulate(glove: str, seed: int) -> dict[str, Take]:
    with progress_bar("captures") as bar:
        bar(0, len(KINDS))
        return simulate_takes(glove, seed, bar.advance)


class TakeMeasures(NamedTuple):
    """What Table 3 and the table of markers tell of one take."""

    pairs: list[list[float]]
    """Frames, gaps, AGL, AMF, ghosts / labels [%]: ours and the paper's."""
    missing: list[float]
    """Share of the frames in which a marker is missing, mean, least and most of the markers [%]; median, p90
    and p99 of the gaps [frames]."""

    @classmethod
    def of(cls, kind: str, take: Take) -> Self:
        """Those of the twin of one of the paper's captures."""
        present, paper = take.markers_present(), TABLE3[kind]
        ours = count_gaps(present)
        ghosts = int(((take.labels < 0) & np.isfinite(take.points[..., 0])).sum())
        pairs: list[list[float]] = [
            [ours.frames, paper.frames],
            [ours.gaps, paper.gaps],
            [ours.average_length, paper.average_length],
            [ours.average_missing, paper.average_missing],
            [100 * ghosts / present.size, 100 * TABLE4["ghost_ratio"][TEST_SETS.index(kind)]],
        ]
        share, lengths = 100 * (~present).mean(axis=0), run_lengths(~present)
        quantiles = np.quantile(lengths, [0.5, 0.9, 0.99]) if len(lengths) else np.full(3, np.nan)
        return cls(pairs, [share.mean(), share.min(), share.max(), *quantiles])


def count_gaps(present: Bool[np.ndarray, "T M"]) -> GapCounts:
    """Table 3's figures of a capture with M expected markers."""
    missing = ~present
    lacking = np.any(missing, axis=1)
    lengths = run_lengths(lacking[:, None])
    gaps = len(lengths)
    return GapCounts(
        frames=len(present),
        gaps=gaps,
        average_length=float(lengths.mean()) if gaps else float("nan"),
        average_missing=float(missing.sum() / lacking.sum()) if gaps else float("nan"),
    )


def _table3(measures: Mapping[str, TakeMeasures]) -> Table:
    columns = ("#Frame", "#Gap", "AGL", "AMF", "ghosts / labels")
    table = number_table("Table 3: ours, and the paper's in brackets", ["Test set"], columns)
    for kind, one in measures.items():
        forms = ("{:.0f}", "{:.0f}", "{:.2f}", "{:.2f}", "{:.2f} %")
        cells = (
            f"{form.format(ours)} ({form.format(paper)})"
            for form, (ours, paper) in zip(forms, one.pairs, strict=True)
        )
        table.add_row(kind, *cells)
    return table


def _table3_figures(measures: Mapping[str, TakeMeasures]) -> Figures:
    """The figures of Table 3."""
    kept: Figures = {}
    columns = "frames, gaps, AGL, AMF, ghosts / labels [%], each with the paper's"
    missing_columns = "missing, mean, least and most marker [%]; gaps, median, p90, p99 [frames]"
    for kind, one in measures.items():
        key = "single" if kind == "single-hand" else kind.split("-")[-1]
        kept[key] = f"Table 3, {kind}: {columns}", one.pairs
        kept[f"gaps_{key}"] = f"{kind}: {missing_columns}", one.missing
    return kept


def _table2_figures(nets: Mapping[str, Mapping[str, LabelingReport]], title: str) -> Figures:
    """The figures of Table 2: a row a test set, ours and the paper's of each network."""
    kept: Figures = {}
    for key, test in zip(("base", "o", "g", "og"), AUGMENTATIONS, strict=True):
        ours = [100 * reports[test].figures["slot_accuracy"] for reports in nets.values()]
        row = [[one, 100 * paper] for one, paper in zip(ours, TABLE2[test], strict=True)]
        kept[key] = f"{title}: {test}, ours and the paper's [%], networks trained on {', '.join(nets)}", row
    return kept


def _tests_figures(
    reports: Mapping[str, LabelingReport], paper: Mapping[str, tuple[float, ...]], title: str
) -> Figures:
    """The figures of Tables 4 and 6: a row a figure, the paper's beside where it has one."""
    kept: Figures = {}
    for figure, words in FIGURES.items():
        printed = dict(zip(TEST_SETS, paper[figure], strict=True)) if figure in paper else {}
        ours = {test: 100 * report.figures[figure] for test, report in reports.items()}
        row = [[one, 100 * printed[test]] if test in printed else one for test, one in ours.items()]
        kept[_KEYS[figure]] = f"{title}, ours and the paper's [%], {', '.join(reports)}: {words}", row
    return kept


def _by_marker(measures: Mapping[str, TakeMeasures]) -> Table:
    columns = ("mean", "least", "most", "median gap", "p90", "p99 [frames]")
    table = number_table("Missing share and gap lengths per marker", ["Test set"], columns)
    for kind, one in measures.items():
        shares, gaps = one.missing[:3], one.missing[3:]
        table.add_row(kind, *(f"{value:.2f} %" for value in shares), *(f"{value:.0f}" for value in gaps))
    table.add_row("real finger markers", "2.6-4.9 %", "0.2 %", "12.4 %", *PUBLISHED_GAPS, "320-340")
    return table


def augmentations(num_markers: int) -> dict[str, Corruption]:
    """The four test sets of Table 2 for a layout, see `train.data.batches.paper_corruption`."""
    most = paper_corruption(num_markers)
    drawn = ((0, 0), (most.occlude, 0), (0, most.ghosts), (most.occlude, most.ghosts))
    return {name: Corruption(*pair) for name, pair in zip(AUGMENTATIONS, drawn, strict=True)}


def measure_augmentations(
    labeler: Labeler, markers: Float[np.ndarray, "T M 3"], *, seed: int
) -> dict[str, LabelingReport]:
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
) -> dict[str, LabelingReport]:
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


def print_table2(nets: Mapping[str, Mapping[str, LabelingReport]], *, title: str) -> Table:
    """Slot accuracy of networks (columns) on test sets (rows), the paper's in brackets."""
    table = number_table(title, ["test \\ net"], nets)
    for test in AUGMENTATIONS:
        paper = dict(zip(AUGMENTATIONS, TABLE2[test], strict=True))
        table.add_row(
            test,
            *(_cell(reports[test].figures["slot_accuracy"], paper[net]) for net, reports in nets.items()),
        )
    return table


def print_tests(
    reports: Mapping[str, LabelingReport], paper: Mapping[str, tuple[float, ...]], *, title: str
) -> Table:
    """Figures (rows) by test set (columns), the paper's in brackets where it has one."""
    table = number_table(title, ["[%]"], reports)
    for figure, words in FIGURES.items():
        printed = dict(zip(TEST_SETS, paper[figure], strict=True)) if figure in paper else {}
        cells = (_cell(report.figures[figure], printed.get(test)) for test, report in reports.items())
        table.add_row(words, *cells)
    return table


def _cell(ours: float, paper: float | None) -> str:
    percent = "-" if np.isnan(ours) else f"{100 * ours:.2f}"
    return percent if paper is None else f"{percent} ({100 * paper:.2f})"
