"""The demo's steps of this package: generate frames, label them, and show the figures."""

from __future__ import annotations

import os
import platform
import time
from importlib import metadata
from typing import Any, Final

import numpy as np

from handsim import __version__
from handsim.app.page import Section
from handsim.cli.demo_run import GLOVE, DemoRun
from handsim.files.json_files import load_json, save_json
from handsim.hand.model import HandModel
from handsim.hand.records import HAND_DTYPE, pack_hand
from train.data.augmentation import Corruption, corrupt
from train.data.shards import Dataset
from train.evaluation.labeler_evaluation import evaluate_labeler
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler
from train.simulation.dataset_config import DatasetConfig
from train.simulation.generation import generate_dataset

_DROPS, _GHOSTS = 5, 2  # the paper's corruption (Han et al. 2018, section 5)
_TIMED: Final = 1024  # frames that are labeled at once to time the labeler
_CANDIDATES: Final = 400  # frames among which the shown one is chosen

# The figures on the page, and the ratio that is zero where there was nothing to find.
_SHOWN: Final = {
    "slot_accuracy": "",
    "point_accuracy": "",
    "occlusion_precision": "occlusion_ratio",
    "occlusion_recall": "occlusion_ratio",
    "ghost_precision": "ghost_ratio",
    "ghost_recall": "ghost_ratio",
}


def generate_and_label(run: DemoRun) -> None:
    """Generate a small training set, label it clean and corrupted, and keep one labeled frame."""
    labeler = load_labeler(GLOVE)  # first, so that a missing labeler is reported before any work
    config = DatasetConfig(glove=GLOVE, num_frames=run.num_frames, seed=run.seed)
    start = time.perf_counter()
    generate_dataset(
        config, run.dataset, progress=lambda done, total: run.report(f"generating frames: {done} of {total}")
    )
    seconds = time.perf_counter() - start
    dataset = Dataset(run.dataset)
    rows = dataset.rows()
    markers = rows["markers"].astype(np.float64)
    columns = {}
    for title, corruption in (("clean", Corruption(0, 0)), ("occluded", Corruption(_DROPS, _GHOSTS))):
        run.report(f"labeling {run.num_frames} frames, {title}")
        rng = np.random.default_rng(run.seed)
        figures = evaluate_labeler(labeler, markers, corruption, rng=rng).figures
        columns[title] = {name: None if np.isnan(value) else float(value) for name, value in figures.items()}
    run.report("timing the labeler")
    clouds = list(markers[:_TIMED])
    start = time.perf_counter()
    labeler.label_frames(clouds)
    labeled = len(clouds) / (time.perf_counter() - start)
    save_json(
        run.figures,
        {"columns": columns, "generated_per_second": run.num_frames / seconds, "labeled_per_second": labeled},
    )
    _keep_frame(run, dataset, rows, labeler)


def _keep_frame(run: DemoRun, dataset: Dataset, rows: np.ndarray, labeler: Labeler) -> None:
    """Write one frame with ghosts and its labels for the drawing step."""
    number = _clear_frame(rows)
    row = rows[number]
    cloud = corrupt(
        row["observed"][None].astype(np.float64),
        Corruption(0, _GHOSTS),
        ghosts=row["ghosts"][None].astype(np.float64),
        rng=np.random.default_rng(run.seed),
    )
    present = cloud.present[0]
    points = cloud.points[0][present]
    np.savez(
        run.labeled_frame,
        points=points,
        labels=labeler.label_frames([points])[0].labels,
        truth=cloud.truth[0][present],
        seen=np.isfinite(row["observed"][:, 0]),
        qpos=row["qpos"].astype(np.float64),
        hand=np.array(pack_hand(dataset.hands(0)[int(row["hand"])]), dtype=HAND_DTYPE),
    )


def _clear_frame(rows: np.ndarray) -> int:
    """An early frame with hidden markers, whose seen markers lie well apart when viewed from the back."""
    best, widest = 0, -1.0
    model = HandModel.named("M")
    for number in range(min(_CANDIDATES, len(rows))):
        row = rows[number]
        seen = np.isfinite(row["observed"][:, 0])
        if not 0.7 * len(seen) <= seen.sum() < len(seen):
            continue
        wrist = model.forward_kinematics(row["qpos"][None].astype(np.float64))[0, 0, :3, :3]
        flat = row["markers"][seen] @ wrist[:, :2]
        distances = np.linalg.norm(flat[:, None] - flat, axis=-1) + np.eye(len(flat))
        if distances.min() > widest:
            best, widest = number, float(distances.min())
    return best


def figures_section(run: DemoRun) -> Section:
    """The figures of this run as a table, with speeds and versions."""
    stored = load_json(run.figures)
    versions = ", ".join(
        f"{package} {metadata.version(package)}"
        for package in ("mujoco", "numpy", "torch", "pyrender-maintained")
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Section(
        "Figures of this run",
        f"{run.num_frames} freshly generated frames (seed {run.seed}) of random people, none of whom is in "
        f"the training set. Occluded: 0 to {_DROPS} markers dropped and 0 to {_GHOSTS} ghosts per frame.",
        table=_table(stored["columns"]),
        notes=[
            f"generated {stored['generated_per_second']:,.0f} frames/s (start included), "
            f"labeled {stored['labeled_per_second']:,.0f} frames/s, on {cores} CPU cores",
            f"handsim {__version__}, Python {platform.python_version()}, {versions}.",
        ],
    )


def _table(columns: dict[str, dict[str, Any]]) -> list[list[str]]:
    """Header and rows in percent; a dash where there was nothing to find."""
    table = [["", *(f"{title} [%]" for title in columns)]]
    for name, ratio in _SHOWN.items():
        cells = ("-" if ratio and not one[ratio] else f"{100 * one[name]:.2f}" for one in columns.values())
        table.append([name.replace("_", " ").capitalize(), *cells])
    return table
