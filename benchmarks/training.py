"""How many images a second the paper's network learns from, against the floor of its multiplications.

python -m benchmarks.training [--steps 6] [--threads 2]
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import describe
from train.config import batch_recipe, default_config
from train.data.batches import draw_batch
from train.data.shards import Dataset
from train.devices.fabric_start import start_fabric
from train.labelers.cnn_network import DeepLabelCNN, position_loss
from train.labelers.depth_image import depth_images
from train.simulation.dataset_config import DatasetConfig
from train.simulation.generation import make_dataset
from train.training_state import TrainingState

# Multiplications of Table 1's layers for one image: outputs x filter, and the two linear layers.
LAYERS = {
    "filter 1": 50 * 50 * 64 * 9,
    "filter 2": 48 * 48 * 64 * 64 * 9,
    "filter 3": 22 * 22 * 128 * 64 * 9,
    "filter 4": 20 * 20 * 128 * 128 * 9,
    "filter 5": 18 * 18 * 128 * 128 * 9,
    "linear 1": 10368 * 2048,
    "linear 2": 2048 * 57,
}
PASSES = 3  # forward, and backward to the inputs and to the weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(describe("torch"), f"{options.threads} threads", sep="; ")
    config = dataclasses.replace(default_config("cnn"), precision="32")
    with tempfile.TemporaryDirectory() as folder:
        make_dataset(DatasetConfig(num_frames=2000), Path(folder) / "set")
        rows = Dataset(Path(folder) / "set").rows()
        state = TrainingState(config, start_fabric(config, Path(folder)), rows)
        rng = np.random.default_rng(0)
        recipe = batch_recipe(config, rows["markers"].shape[1])
        batch = draw_batch(rows, recipe, rng=rng)
        points, present = batch.cloud.points, batch.cloud.present
        hand = state.network.mean_hand.get()
        views = hand.training_views(points, present, batch.markers, rng=rng)
        images, frames = depth_images(points, present, views)
        targets = torch.from_numpy(frames.normalize(batch.markers)).float()
        runs = {
            "whole steps": lambda: state.step(draw_batch(rows, recipe, rng=rng), rng=rng),
            "network alone": lambda: learn(state.network, torch.from_numpy(images)[:, None], targets),
            "network alone, all filters dense": lambda: learn(
                dense(state.network), torch.from_numpy(images)[:, None], targets
            ),
        }
        rates = {name: config.batch / fastest(run, options.steps) for name, run in runs.items()}
    rates["floor: all multiplications as one large product"] = product_rate() / (
        sum(LAYERS.values()) * PASSES
    )
    floor = list(rates.values())[-1]
    print("images a second                                     of the floor")
    for name, rate in rates.items():
        print(f"{name:48} {rate:8.1f} {100 * rate / floor:8.0f} %")


def dense(network: DeepLabelCNN) -> Callable[[torch.Tensor], torch.Tensor]:
    """The same layers, all of them torch's own."""
    return lambda images: network.positions(
        network.features(images.contiguous(memory_format=torch.channels_last))
    )


def learn(
    network: Callable[[torch.Tensor], torch.Tensor], images: torch.Tensor, targets: torch.Tensor
) -> None:
    """Forward and backward."""
    position_loss(network(images).view(targets.shape), targets).backward()


def fastest(run: Callable[[], object], count: int) -> float:
    """Seconds of the fastest of a few runs, after one to warm up."""
    run()
    times = []
    for _ in range(count):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def product_rate() -> float:
    """Multiplications a second of a product of two large matrices."""
    a, b = torch.rand(2048, 2048), torch.rand(2048, 2048)
    return 2048**3 / fastest(lambda: a @ b, 5)


if __name__ == "__main__":
    main()
