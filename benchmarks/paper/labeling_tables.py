"""Tables 3, 4 and 6 of the paper: labels of single frames, and gaps of captures, beside its figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import tyro
from jaxtyping import Bool

from benchmarks.held_out import held_out_markers
from benchmarks.paper.printed import TABLE3, TABLE4, TABLE6, TEST_SETS, GapCounts
from benchmarks.record import Figures, report
from gloves import Take
from gloves.captures.capture import run_lengths
from train import evaluate_labeler, load_labeler, simulate_take
from train.data.batches import paper_corruption
from train.simulation.scenes import KINDS

FIGURES: Final = {
    "slots": "slot_accuracy",
    "points": "point_accuracy",
    "frames": "frame_accuracy",
    "f1": "macro_f1",
    "o_ratio": "occlusion_ratio",
    "o_precision": "occlusion_precision",
    "o_recall": "occlusion_recall",
    "g_ratio": "ghost_ratio",
    "g_precision": "ghost_precision",
    "g_recall": "ghost_recall",
}
"""Rows of Tables 4 and 6, the paper's and ours."""
LabelerFile = Annotated[Path | None, tyro.conf.arg(help="Folder of a trained labeler, or an .onnx file.")]
SaveName = Annotated[str | None, tyro.conf.arg(help="Name of the file in benchmarks/figures.")]


def table3(glove: str = "dense19", seed: int = 0, save: SaveName = None) -> None:
    """Frames, gaps and ghosts of the simulated twins of the paper's captures.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        seed: Seed of the captures; 0 gives the twins, others give other captures of the same kinds.
        save: Name of the file in benchmarks/figures.
    """
    figures: Figures = {}
    for kind, take in simulate_takes(glove, seed).items():
        figures |= gap_figures(kind, take)
    report(save, figures)


def table4(labeler: LabelerFile = None, num_frames: int = 5000, seed: int = 0, save: SaveName = None) -> None:
    """A labeler of the dense layout on simulated test frames and on the twins of the paper's captures."""
    report(save, figures_of_tests("dense19", TABLE4, labeler, num_frames, seed))


def table6(labeler: LabelerFile = None, num_frames: int = 5000, seed: int = 0, save: SaveName = None) -> None:
    """A labeler of the sparse layout on simulated test frames and on the twins of the paper's captures."""
    report(save, figures_of_tests("sparse13", TABLE6, labeler, num_frames, seed))


LABELING_TABLES: Final[dict[str, Callable[..., None]]] = {
    "table3": table3,
    "table4": table4,
    "table6": table6,
}


def simulate_takes(glove: str, seed: int) -> dict[str, Take]:
    """The twins of the paper's four captures."""
    return {kind: simulate_take(kind=kind, glove=glove, seed=seed) for kind in KINDS}


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


def gap_figures(kind: str, take: Take) -> Figures:
    """Table 3's row of a twin, and gaps of its single markers."""
    present = take.markers_present()
    ghosts = int(((take.labels < 0) & np.isfinite(take.points[..., 0])).sum())
    ours = [*count_gaps(present), 100 * ghosts / present.size]
    paper = [*TABLE3[kind], 100 * TABLE4["ghost_ratio"][TEST_SETS.index(kind)]]
    share, lengths = 100 * (~present).mean(axis=0), run_lengths(~present)
    quantiles = np.quantile(lengths, [0.5, 0.9, 0.99]) if len(lengths) else np.full(3, np.nan)
    key = "single" if kind == "single-hand" else kind.rsplit("-", maxsplit=1)[-1]
    columns = "frames, gaps, AGL, AMF, ghosts / labels [%], each with the paper's"
    missing = "missing, mean, least and most marker [%]; gaps, median, p90, p99 [frames]"
    return {
        key: (f"Table 3, {kind}: {columns}", np.transpose([ours, paper])),
        f"gaps_{key}": (f"{kind}: {missing}", [share.mean(), share.min(), share.max(), *quantiles]),
    }


def figures_of_tests(
    glove: str, paper: Mapping[str, tuple[float, ...]], labeler: Path | None, num_frames: int, seed: int
) -> Figures:
    """Tables 4 and 6: a row a figure, the paper's beside ours where it has one."""
    network, rng = load_labeler(glove, labeler), np.random.default_rng(seed)
    markers = held_out_markers(glove, num_frames, seed=seed)
    reports = [evaluate_labeler(network, markers, paper_corruption(markers.shape[1]), rng=rng)]
    reports += [evaluate_labeler(network, [take]) for take in simulate_takes(glove, seed).values()]
    kept: Figures = {}
    for key, name in FIGURES.items():
        ours = [100 * one.figures[name] for one in reports]
        row = np.transpose([ours, 100 * np.array(paper[name])]) if name in paper else ours
        kept[key] = (
            f"{glove}, ours and the paper's [%], {', '.join(TEST_SETS)}: {name.replace('_', ' ')}",
            row,
        )
    return kept
