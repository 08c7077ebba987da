"""A training run with a very small network."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from train import SetLabelerConfig, TrainSettings
from train.data.shards import row_dtype
from train.fabric import start_fabric
from train.loop import TrainingState


@cache
def state(folder: Path) -> TrainingState:
    """The state of a run before its first step; one for each folder of its curves."""
    network = SetLabelerConfig(num_labels=4, width=8, gates=2, depth=1, num_distances=4)
    config = TrainSettings(network=network, batch=1, samples=4)
    return TrainingState(config, start_fabric(config, folder), np.zeros(2, dtype=row_dtype(4)))
