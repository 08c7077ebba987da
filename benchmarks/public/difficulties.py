"""What makes a capture of the benchmark easy, medium or hard, and which captures a benchmark has.

Everything here decides the bytes of the data: a change needs another version.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from gloves import OpticsConfig
from gloves.optics.ghosts import StrayConfig
from train.simulation.room import RoomConfig
from train.simulation.scenes import KINDS, SimulatedKind

BENCHMARK: Final = "handsim-benchmark-1"
"""Name and version, which results are reported with."""
GLOVE: Final = "dense19"
"""Marker layout of all captures."""
BENCHMARK_KINDS: Final[tuple[SimulatedKind, ...]] = (*KINDS, "real-like")
"""What the hands do."""
_SEED: Final = 20_261_123


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Cameras, optics and speed of a capture."""

    rig: str
    """A shipped camera rig."""
    room: RoomConfig
    """Noise, losses, stray reflections and mirror images."""
    speed: int
    """Times that hands move as fast; those of real-like captures are twice as fast always."""


DIFFICULTIES: Final[dict[str, Difficulty]] = {
    "easy": Difficulty(
        "figure5",
        RoomConfig(OpticsConfig(dropout=0.0, min_rays_to_start=2), StrayConfig(number=0.0), reflectance=0.0),
        speed=1,
    ),
    "medium": Difficulty(
        "figure5",
        RoomConfig(
            OpticsConfig(
                blob_loss=0.03, dropout=0.15, dropout_length=2.0, dropout_cameras=6, min_rays_to_start=2
            ),
            StrayConfig(number=3.0),
            reflectance=0.5,
        ),
        speed=1,
    ),
    "hard": Difficulty(
        "eight",
        RoomConfig(
            OpticsConfig(
                blob_loss=0.05, dropout=0.05, dropout_length=4.0, dropout_cameras=3, min_rays_to_start=2
            ),
            StrayConfig(number=12.0),
            reflectance=1.0,
        ),
        speed=2,
    ),
}
"""The difficulties by name; README.md has them as a table."""


@dataclass(frozen=True, slots=True)
class PlannedCapture:
    """One capture of a benchmark."""

    kind: SimulatedKind
    difficulty: str
    """One of `DIFFICULTIES`."""
    person: int
    """Counts the people of this kind from 1; the difficulties share them, and what they do."""
    num_frames: int

    @property
    def name(self) -> str:
        """The name of its files."""
        return f"{self.kind}-{self.difficulty}-{self.person}"

    @property
    def seeds(self) -> dict[str, tuple[int, ...]]:
        """Of people and their motion, and of what cameras see: a seed, and numbers that are mixed into it."""
        kind, difficulty = BENCHMARK_KINDS.index(self.kind), list(DIFFICULTIES).index(self.difficulty)
        motion = (_SEED, kind, self.person)
        return {"motion": motion, "optics": (*motion, difficulty)}

    def rng(self, name: str) -> np.random.Generator:
        """A new source of the randomness that one of `seeds` is for."""
        seed, *numbers = self.seeds[name]
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(numbers)))


@dataclass(frozen=True, slots=True)
class Plan:
    """The captures of a benchmark of one size."""

    size: str
    """Its name."""
    people: int
    """Captures of each kind and difficulty."""
    num_frames: int
    """Frames of each capture."""
    kinds: tuple[SimulatedKind, ...] = BENCHMARK_KINDS
    difficulties: tuple[str, ...] = tuple(DIFFICULTIES)

    @property
    def captures(self) -> tuple[PlannedCapture, ...]:
        """All captures in order."""
        return tuple(
            PlannedCapture(kind, difficulty, person, self.num_frames)
            for kind in self.kinds
            for difficulty in self.difficulties
            for person in range(1, self.people + 1)
        )


SIZES: Final[dict[str, Plan]] = {
    "small": Plan("small", people=1, num_frames=900),
    "full": Plan("full", people=3, num_frames=1800),
}
"""The published sizes; results name theirs."""
