"""Held-out test frames: people and poses that no training set holds."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from gloves import load_layout
from handsim import load_rig
from train import GenerateSettings
from train.data.shards import row_dtype
from train.simulation.training_frames import FrameSource, sample_hands, simulate_frames

_SPAWN_KEY: Final = 2**32 - 1  # a shard number that no training set reaches


def held_out_markers(glove: str, num_frames: int, *, seed: int) -> Float[np.ndarray, "T M 3"]:
    """True markers of random people's hands [m], drawn as training sets draw them but from other randomness.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        num_frames: Number of frames T; another person every 128 frames.
        seed: Seed of the people and poses.
    """
    config = GenerateSettings(glove=glove, num_frames=num_frames, seed=seed)
    layout, rig = load_layout(glove), load_rig(config.rig)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
    rows = np.zeros(num_frames, dtype=row_dtype(layout.num_markers))
    source = FrameSource(config, layout, rig)
    for first in range(0, num_frames, config.frames_per_hand):
        block = rows[first : first + config.frames_per_hand]
        simulate_frames(block, sample_hands(config.population, rng=rng), source, rng=rng)
    markers: Float[np.ndarray, "T M 3"] = rows["markers"].astype(np.float64)
    return markers
