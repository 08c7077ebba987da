"""Settings of the labeler and its training; free of torch, so that a command's help is quick."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SetLabelerConfig:
    """Size of the network."""

    num_labels: int = 19
    width: int = 64
    """Channels of a point."""
    gates: int = 16
    """Message channels share a gate in groups: this many groups."""
    depth: int = 5
    """Rounds of messages."""
    num_distances: int = 24
    """Gaussian bumps a distance is spread over."""
    reach: float = 0.24
    """Largest distance [m] that has a bump of its own; a hand's markers span about this much."""


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """How a labeler is trained; the defaults made the shipped weights."""

    samples: int = 2_000_000
    """Clouds to learn from; rows come round again, corrupted anew each time."""
    batch: int = 256
    learning_rate: float = 2e-3
    """Peak; warms up over the first hundredth and falls to zero as a half cosine."""
    weight_decay: float = 0.01
    average: float = 0.999
    """Decay of the running mean of the weights, which is what is kept."""
    jitter: float = 0.0035
    """Largest half width of the uniform noise on each coordinate [m]; each batch draws its own."""
    rig_share: float = 0.5
    """Share of batches that are what the simulated rig saw; the others go through the paper's recipe."""
    anisotropy: float = 0.06
    """Stretch of each hand along three random directions, log standard deviation."""
    seed: int = 0
    network: SetLabelerConfig = dataclasses.field(default_factory=SetLabelerConfig)
