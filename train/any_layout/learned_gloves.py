"""Labelers of gloves that the network for any layout has learned, kept in the user's cache folder.

A minute of training makes one. It is kept under a digest of all that decides it: the layout, the cameras, the
shipped weights and the version. The least recently used ones go when there are too many.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import json
import os
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from gloves.layout import MarkerLayout
from handsim._version import __version__
from handsim.errors import WeightsError
from handsim.files.atomic import atomic_write
from handsim.files.inputs import checksum
from handsim.space.cameras import CameraRig, as_rig
from train.any_layout.layout_labeler import SHIPPED, WEIGHTS, LayoutLabeler
from train.any_layout.layout_network import layout_loss
from train.config import TrainConfig, batch_recipe
from train.data.batches import draw_batch
from train.data.shards import row_dtype
from train.labelers.storage import LEARNED, learned_folder, learned_gloves
from train.simulation.scenes import sample_hands
from train.simulation.training_frames import FrameSource, GenerateSettings, simulate_frames
from train.threads import torch_threads

MOST: Final = 32
"""Labelers that are kept; one takes about four megabytes."""
NUM_CLOUDS: Final = 15_000
_BATCH: Final = 64
_PEAK_RATE, _WARM_UP = 2e-3, 20  # learning rate; steps until it is reached
_FRAMES_EACH: Final = 100  # of a person
_MOST_GRADIENT: Final = 1.0


def is_learned(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> bool:
    """Whether a glove was learned before."""
    return _file_of(layout, rig).exists()


def learned_labeler(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> LayoutLabeler:
    """The labeler of a glove, learned within a minute the first time and read within a second from then on.

    Args:
        rig: Cameras that see it while it is learned.

    Raises:
        LayoutError: A marker misses the skin.
    """
    file = _file_of(layout, rig)
    found = _read(file, layout)
    if found is not None:
        return found
    learned = fine_tuned_labeler(layout, rig)
    try:
        _write(file, learned)
    except OSError:
        return learned  # a cache that cannot be written costs time, no labels
    return _read(file, layout) or learned


def _file_of(layout: MarkerLayout, rig: CameraRig | str) -> Path:
    return learned_folder() / f"{_digest(layout, rig)}{LEARNED}"


@functools.lru_cache(maxsize=MOST)
def _digest(layout: MarkerLayout, rig: CameraRig | str) -> str:
    """Of all that decides a labeler."""
    decides = {
        "layout": dataclasses.asdict(layout),
        "rig": as_rig(rig).record(),
        "weights": checksum(SHIPPED / WEIGHTS),
        "version": __version__,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:32]


def _read(file: Path, layout: MarkerLayout) -> LayoutLabeler | None:
    """A kept labeler; None where there is none, or a damaged one, which is removed."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        stored = file.read_bytes()
    except OSError:
        return None
    try:
        labeler = LayoutLabeler.of_tensors(layout, load(stored))
        os.utime(file)
    except (OSError, SafetensorError, WeightsError):
        file.unlink(missing_ok=True)
        return None
    return labeler


def _write(file: Path, labeler: LayoutLabeler) -> None:
    from safetensors.numpy import save

    tensors: dict[str, NDArray[np.generic]] = labeler.tensors()
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_bytes(save(dict(tensors)))
    for old in learned_gloves()[MOST:]:
        old.unlink(missing_ok=True)


def fine_tuned_labeler(
    layout: MarkerLayout,
    rig: CameraRig | str = "figure5",
    *,
    num_clouds: int = NUM_CLOUDS,
    seed: int = 0,
) -> LayoutLabeler:
    """A labeler for any layout that has learned more of this one.

    Args:
        rig: Cameras that see the frames: a rig, its name or its file; the paper's when not given.
        num_clouds: Clouds to learn from, of two thirds as many frames.

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
    config = GenerateSettings()
    source = FrameSource(config, layout, rig)
    rows = np.zeros(num_frames, dtype=row_dtype(layout.num_markers))
    for first in range(0, num_frames, _FRAMES_EACH):
        models = sample_hands(config.population, rng=rng)
        simulate_frames(rows[first : first + _FRAMES_EACH], models, source, rng=rng)
    return rows
