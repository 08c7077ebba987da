"""The network for any layout, fine-tuned on one: a minute of simulated frames and gradient steps.

The network knows a layout it has never seen by its distances alone, and it errs where fingers have their
markers at like places. A few hundred steps on frames of that layout take back most of these errors.
"""

from __future__ import annotations

import copy
from typing import Final

import numpy as np
import torch

from gloves.layout import MarkerLayout
from handsim.space.cameras import CameraRig, as_rig
from train.any_layout.layout_labeler import LayoutLabeler
from train.any_layout.layout_network import layout_loss
from train.config import TrainConfig, batch_recipe
from train.data.batches import draw_batch
from train.data.shards import row_dtype
from train.simulation.dataset_config import DatasetConfig
from train.simulation.people import sample_hands
from train.simulation.training_frames import simulate_frames
from train.threads import torch_threads

NUM_CLOUDS: Final = 15_000
_BATCH: Final = 64
_PEAK_RATE, _WARM_UP = 2e-3, 20  # learning rate; steps until it is reached
_FRAMES_EACH: Final = 100  # of a person
_MOST_GRADIENT: Final = 1.0


def fine_tuned_labeler(
    layout: MarkerLayout,
    rig: CameraRig | str = "figure5",
    *,
    num_clouds: int = NUM_CLOUDS,
    seed: int = 0,
) -> LayoutLabeler:
    """A labeler for any layout that has learned more of this one.

    Args:
        layout: The glove.
        rig: Cameras that see the frames: a rig, its name or its file; the paper's when not given.
        num_clouds: Clouds to learn from, of two thirds as many frames.
        seed: Of all randomness.

    Raises:
        LayoutError: A marker misses the skin.
    """
    rng = np.random.default_rng(seed)
    labeler = LayoutLabeler.at_once(layout, seed=seed)
    rows = _simulated_rows(layout, as_rig(rig), 2 * num_clouds // 3, rng)
    network = copy.deepcopy(labeler.network).train()
    recipe = batch_recipe(TrainConfig(batch=_BATCH), layout.num_markers)
    optimizer = torch.optim.AdamW(network.parameters(), lr=_PEAK_RATE, weight_decay=1e-4, fused=True)
    steps = -(-num_clouds // _BATCH)
    with torch_threads(1):
        for step in range(steps):
            rate = min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1.0 + np.cos(np.pi * step / steps))
            for group in optimizer.param_groups:
                group["lr"] = float(_PEAK_RATE * rate)
            cloud = draw_batch(rows, recipe, rng=rng).cloud
            points, present = (
                torch.from_numpy(cloud.points.astype(np.float32)),
                torch.from_numpy(cloud.present),
            )
            loss = layout_loss(
                network(points, present, labeler.distances), torch.from_numpy(cloud.truth), present
            )
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(network.parameters(), _MOST_GRADIENT)
            optimizer.step()
    labeler.network = network.eval()
    return labeler


def _simulated_rows(
    layout: MarkerLayout, rig: CameraRig, num_frames: int, rng: np.random.Generator
) -> np.ndarray:
    """Frames as a training set has them, see `train.data.shards.row_dtype`."""
    config = DatasetConfig()
    rows = np.zeros(num_frames, dtype=row_dtype(layout.num_markers))
    for first in range(0, num_frames, _FRAMES_EACH):
        models = sample_hands(config.population, rng=rng)
        simulate_frames(rows[first : first + _FRAMES_EACH], models, layout, rig, config, rng=rng)
    return rows
