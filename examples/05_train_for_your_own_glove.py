"""Train a labeler for a glove of ten markers that a TOML file describes.

    python examples/05_train_for_your_own_glove.py

The labeler is measured on people that it was not trained on. Training set and network are small, so that
this takes twenty seconds; `handsim generate` and `handsim train` make a better one (docs/labeling.md).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from train import (
    Corruption,
    Dataset,
    DatasetConfig,
    TrainConfig,
    evaluate_labeler,
    generate_dataset,
    load_labeler,
    train_labeler,
)

GLOVE = str(Path(__file__).parent / "ten_markers.toml")


def main() -> None:
    config = TrainConfig(samples=25_000)
    config = replace(config, network=replace(config.network, width=32, gates=8, depth=3))
    with TemporaryDirectory() as name:
        folder = Path(name)
        for part, frames, seed in (("train", 4000, 0), ("test", 500, 1)):
            settings = DatasetConfig(glove=GLOVE, num_frames=frames, seed=seed, frames_per_hand=60)
            generate_dataset(settings, folder / part, workers=1)
        train_labeler(Dataset(folder / "train"), config, folder / "run")
        labeler = load_labeler(folder / "run")
        markers = Dataset(folder / "test").rows()["markers"].astype(np.float64)  # (500, 10, 3) [m]
    for corruption in (Corruption(occlude=0, ghosts=0), Corruption(occlude=2, ghosts=2)):
        report = evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))
        share = 100 * report.figures["slot_accuracy"]
        print(f"occlude {corruption.occlude}, ghosts {corruption.ghosts}: {share:.1f} % of slots right")


if __name__ == "__main__":
    main()
