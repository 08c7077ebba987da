"""Label points that say nothing of themselves with the labeler that comes with the package.

    python examples/03_label_a_capture.py

A simulated take is generated, corrupted as in the paper (markers dropped, ghosts added, order shuffled),
labeled frame by frame, and counted.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from train.data.augmentation import Corruption
from train.data.shards import Dataset
from train.evaluation.labeler_evaluation import evaluate_labeler
from train.labelers.storage import load_labeler
from train.simulation.dataset_config import DatasetConfig
from train.simulation.generation import generate_dataset


def main() -> None:
    labeler = load_labeler("dense19")
    with tempfile.TemporaryDirectory() as folder:
        generate_dataset(DatasetConfig(num_frames=1000, seed=42), Path(folder) / "set", workers=1)
        markers = Dataset(Path(folder) / "set").rows()["markers"].astype(np.float64)  # (1000, 19, 3)
    for corruption in (Corruption(occlude=0, ghosts=0), Corruption(occlude=5, ghosts=2)):
        report = evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))
        share = 100 * report.figures["slot_accuracy"]
        print(f"occlude {corruption.occlude}, ghosts {corruption.ghosts}: {share:.2f} % of slots right")


if __name__ == "__main__":
    main()
