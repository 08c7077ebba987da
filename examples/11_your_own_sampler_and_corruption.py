"""Make a training set with a pose sampler of your own, and train on it with a corruption of your own.

    python examples/11_your_own_sampler_and_corruption.py

Both are in own_ideas.py beside this script and are loaded by name, also by worker processes. The names are in
the settings of the set and of the run: neither is continued with another.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from handsim import HandSimError
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


def main() -> None:
    made = DatasetConfig(num_frames=2000, frames_per_hand=50, sampler="own_ideas:Pointing")
    config = TrainConfig(samples=10_000, corruption="own_ideas:hide_a_side", rig_share=0.2)
    config = replace(config, network=replace(config.network, width=16, gates=4, depth=2))
    with TemporaryDirectory() as name:
        folder = Path(name)
        generate_dataset(made, folder / "set", workers=1)
        try:
            generate_dataset(replace(made, sampler=None), folder / "set", workers=1)
        except HandSimError as error:
            print(str(error).replace(name, ""))
        train_labeler(Dataset(folder / "set"), config, folder / "run")
        labeler = load_labeler(folder / "run")
        markers = Dataset(folder / "set").rows()["markers"][-200:].astype(np.float64)  # (200, 19, 3) [m]
    figures = evaluate_labeler(labeler, markers, Corruption(0, 0), rng=np.random.default_rng(0)).figures
    print(f"{100 * figures['slot_accuracy']:.1f} % of slots right after {config.samples} clouds")


if __name__ == "__main__":
    main()
