"""Augmentation of clean rows for training: jitter, occlusion, ghosts and a shuffled order.

Some batches keep what the simulated rig sees of them; the others get the corruption of the paper (Han et al.
2018, section 3.3): zero to five draws of markers to drop, zero to two ghosts anywhere in the sample's box.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim._checks import check_number, check_rng, check_type, shown_value
from handsim.errors import ArgumentError

_MOST: Final = 100  # points to add to a cloud or drop from it


@dataclass(frozen=True, slots=True)
class Corruption:
    """The paper's corruption, as it is drawn for training and for tests.

    Raises:
        ArgumentError: A number is of another type or out of range.
    """

    occlude: int = 5
    """Most draws of a marker to drop; drawn with replacement, as the paper's occlusion ratio implies."""
    ghosts: int = 2
    """Most ghosts added, uniform in the sample's box grown by `margin`."""
    jitter: float = 0.0
    """Half width of the uniform noise on each coordinate [m]."""
    margin: float = 0.1
    """Growth of the box [share of its sides]."""

    def __post_init__(self) -> None:
        for name in ("occlude", "ghosts"):
            check_type(name, getattr(self, name), (int, np.integer), "a whole number")
            check_number(name, getattr(self, name), 0, _MOST)
        check_number("jitter", self.jitter, 0.0, 0.1)
        check_number("margin", self.margin, 0.0, 10.0)


class Cloud(NamedTuple):
    """Clouds of points, padded to one length, in random order."""

    points: Float[np.ndarray, "B N 3"]
    """[m]; 0 in padding."""
    present: Bool[np.ndarray, "B N"]
    """False in padding."""
    truth: Int[np.ndarray, "B N"]
    """Marker of each point, -1 for a ghost."""


def corrupt(
    markers: Float[np.ndarray, "B M 3"],
    corruption: Corruption,
    *,
    ghosts: Float[np.ndarray, "B G 3"] | None = None,
    rng: np.random.Generator,
) -> Cloud:
    """Corrupted, shuffled clouds (B, N) of clean markers (B, M).

    Args:
        markers: Marker positions (B, M, 3) [m]; NaN where a marker is missing already.
        corruption: How much is drawn at random on top.
        ghosts: Ghosts that the rig sees (B, G, 3) [m], NaN where there is none.
        rng: Source of all randomness.

    Returns:
        Points (B, N, 3) [m], which of them are there (B, N), and the marker of each (B, N), -1 for a ghost.

    Raises:
        ArgumentError: An argument is of another type or shape.
    """
    check_type("corruption", corruption, Corruption, "a Corruption")
    check_rng(rng)
    if not isinstance(markers, np.ndarray) or markers.ndim != 3 or markers.shape[2] != 3:
        raise ArgumentError(f"markers is {shown_value(markers)}, expected an array (B, M, 3) [m]")
    batch, count = markers.shape[:2]
    present = np.isfinite(markers).all(-1)
    positions = markers + rng.uniform(-corruption.jitter, corruption.jitter, markers.shape)
    present &= ~_draw_drops(batch, count, corruption.occlude, rng)
    drawn = _draw_ghosts(positions, np.isfinite(markers).all(-1), corruption, rng)
    parts = [positions, drawn] if ghosts is None else [positions, drawn, ghosts]
    points = np.concatenate(parts, axis=1)
    present = np.concatenate([present, *(np.isfinite(part).all(-1) for part in parts[1:])], axis=1)
    truth = np.full(present.shape, -1)
    truth[:, :count] = np.arange(count)
    return shuffled(points, present, truth, rng=rng)


def shuffled(
    points: Float[np.ndarray, "B N 3"],
    present: Bool[np.ndarray, "B N"],
    truth: Int[np.ndarray, "B N"],
    *,
    rng: np.random.Generator,
) -> Cloud:
    """The points [m] that are there in random order, with as little padding as the fullest cloud needs."""
    order = rng.random(present.shape).argsort(axis=1)
    order = np.take_along_axis(
        order, np.take_along_axis(~present, order, 1).argsort(axis=1, kind="stable"), 1
    )
    width = max(1, int(present.sum(1).max()))
    order = order[:, :width]
    present = np.take_along_axis(present, order, 1)
    points = np.where(present[..., None], np.take_along_axis(points, order[..., None], 1), 0.0)
    return Cloud(points, present, np.take_along_axis(truth, order, 1))


def _draw_drops(batch: int, count: int, most: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Markers to drop (B, M): zero to `most` draws with replacement per row."""
    dropped = np.zeros((batch, count), dtype=bool)
    if most:
        num_draws = rng.integers(0, most + 1, size=batch)
        draws = rng.integers(0, count, size=(batch, most))
        taken = np.arange(most) < num_draws[:, None]
        rows = np.broadcast_to(np.arange(batch)[:, None], draws.shape)
        dropped[rows[taken], draws[taken]] = True
    return dropped


def _draw_ghosts(
    positions: NDArray[np.float64], known: NDArray[np.bool_], corruption: Corruption, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Zero to `ghosts` points uniform in each sample's box, NaN where none."""
    batch, most = len(positions), corruption.ghosts
    low = np.where(known[..., None], positions, np.inf).min(1)
    high = np.where(known[..., None], positions, -np.inf).max(1)
    side = np.where(np.isfinite(high - low), high - low, np.nan)
    uniform = rng.uniform(-corruption.margin / 2, 1 + corruption.margin / 2, size=(batch, most, 3))
    ghosts: NDArray[np.float64] = low[:, None] + uniform * side[:, None]
    num_ghosts = rng.integers(0, most + 1, size=batch)
    ghosts[np.arange(most) >= num_ghosts[:, None]] = np.nan
    return ghosts
