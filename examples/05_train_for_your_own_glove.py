"""A glove of ten markers, nothing but a TOML file, and a labeler for it.

    python examples/05_train_for_your_own_glove.py

A small training set and a small network, to be done in half a minute; `handsim generate` and `handsim train`
do the same at full size (benchmarks/new_layout.py times them).
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from train.config import SetLabelerConfig, TrainConfig
from train.data.shards import Dataset
from train.evaluation.tables import measure_augmentations
from train.labelers.storage import load_labeler
from train.loop import train_labeler
from train.simulation.dataset_config import DatasetConfig
from train.simulation.generation import generate_dataset
from train.simulation.held_out import held_out_markers

GLOVE = str(Path(__file__).parent / "ten_markers.toml")


def main() -> None:
    network = SetLabelerConfig(width=32, gates=8, depth=3)
    with tempfile.TemporaryDirectory() as folder:
        data, run = Path(folder) / "data", Path(folder) / "run"
        generate_dataset(DatasetConfig(glove=GLOVE, num_frames=6000, frames_per_hand=60), data, workers=1)
        train_labeler(Dataset(data), TrainConfig(samples=40_000, network=network), run)
        labeler = load_labeler(run)
    strangers = held_out_markers(GLOVE, 500, seed=0)  # (500, 10, 3)
    for test, report in measure_augmentations(labeler, strangers, seed=0).items():
        print(f"{test}: {100 * report.figures['slot_accuracy']:.1f} % of slots right")


if __name__ == "__main__":
    main()
