"""Random drops or the simulated rig? The same labeler trained on each, tested on twins and on real captures.

    handsim generate --glove dense19 --num-frames 400000 --seed 7 --out SET
    handsim train SET --rig-share 0 --samples 700000 --out DROPS
    handsim train SET --rig-share 1 --samples 700000 --out RIG
    python benchmarks/ablation.py --runs DROPS RIG [--captures FOLDER]

Prints one table a figure: test sets down, labelers across. FOLDER holds labeled captures; without it only
the simulated twins are tested.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro
from machine import describe

from gloves.captures.collection import find_captures, read_markers
from train.data.augmentation import Corruption
from train.evaluation.labeler_evaluation import Report, evaluate_labeler, evaluate_takes
from train.labelers.storage import load_labeler
from train.simulation.room_settings import KINDS
from train.simulation.takes import TakeConfig, simulate_take

FIGURES = {
    "slot_accuracy": "slot accuracy",
    "frame_accuracy": "frame accuracy",
    "occlusion_precision": "occlusion precision",
    "occlusion_recall": "occlusion recall",
    "ghost_precision": "ghost precision",
    "ghost_recall": "ghost recall",
}


def main(runs: tuple[str, ...], captures: Path | None = None) -> None:
    labelers = {run: load_labeler(Path(run) if Path(run).is_dir() else run) for run in runs}
    tests: dict[str, dict[str, Report]] = {}
    for kind in KINDS:
        take = simulate_take(TakeConfig(kind=kind))
        tests[kind] = {run: evaluate_takes(labeler, [take]) for run, labeler in labelers.items()}
    if captures is not None:
        markers = read_markers(find_captures([captures]), next(iter(labelers.values())).marker_names)
        for name, corruption in (
            ("real, clean", Corruption(0, 0)),
            ("real, 5 drops, 2 ghosts", Corruption()),
        ):
            tests[name] = {
                run: evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))
                for run, labeler in labelers.items()
            }
    print(describe("torch"))
    for key, name in FIGURES.items():
        print(f"\n| {name} [%] | " + " | ".join(Path(run).name for run in runs) + " |")
        print("|---" * (len(runs) + 1) + "|")
        for test, reports in tests.items():
            print(
                f"| {test} | " + " | ".join(f"{100 * reports[run].figures[key]:.2f}" for run in runs) + " |"
            )


if __name__ == "__main__":
    tyro.cli(main)
