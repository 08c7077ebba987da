"""Batches for training: random rows, stretched and corrupted anew each time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.shape import SIDES
from train.data.augmentation import Cloud, Corruption, corrupt
from train.data.own_corruption import OwnCorruption, draw_cloud
from train.data.shards import MappedRows


class Weights(NamedTuple):
    """Factors of the losses of a part of a batch; the mean over all parts is then the loss of the batch."""

    points: float = 1.0
    """Of a mean over points."""
    clouds: float = 1.0
    """Of a mean over clouds."""


WHOLE: Final = Weights()
"""Of the whole batch."""


class Batch(NamedTuple):
    """Clouds and the markers behind them."""

    cloud: Cloud
    markers: Float[np.ndarray, "B M 3"]
    """True positions [m] of all markers, the lost ones too, in the clouds' frame: centered, not rotated."""
    weights: Weights = WHOLE


@dataclass(frozen=True, slots=True)
class Part:
    """Which clouds of every batch one of several processes learns from: every `count`-th from `first` on."""

    first: int = 0
    count: int = 1

    def of(self, batch: Batch) -> Batch:
        """These clouds of a batch; the whole batch where there is one part."""
        if self.count == 1:
            return batch
        mine = slice(self.first, None, self.count)
        cloud, total = batch.cloud, batch.cloud.present.sum()
        width = max(1, int(cloud.present[mine].sum(axis=1).max()))  # points come before padding
        part = Cloud(*(entry[mine, :width] for entry in cloud))
        share = len(part.present) / len(cloud.present)
        weights = Weights(self.count * float(part.present.sum() / total), self.count * share)
        return Batch(part, batch.markers[mine], weights)


def paper_corruption(num_markers: int) -> Corruption:
    """The paper's recipe for a layout: up to 5 draws of 19 markers, up to 3 of 13, up to two ghosts."""
    return Corruption(occlude=round(num_markers / 4), ghosts=2)


@dataclass(frozen=True, slots=True)
class BatchRecipe:
    """How a batch is drawn."""

    batch: int
    """Clouds."""
    corruption: Corruption | OwnCorruption | str
    """What is done to clean markers, or whose: a function or its name."""
    jitter: float = 0.0
    """Largest half width of the uniform noise on each coordinate [m]; every batch draws its own."""
    rig_share: float = 0.0
    """Share of batches that are what the simulated rig sees."""
    anisotropy: float = 0.0
    """Log standard deviation of the stretch of each hand along three random directions."""


def draw_batch(
    rows: NDArray[np.void] | MappedRows, recipe: BatchRecipe, *, rng: np.random.Generator
) -> Batch:
    """Random rows as corrupted clouds [m], centered; left hands are mirrored to right ones.

    Args:
        rows: Rows of a training set, see `train.data.shards.row_dtype`.
        recipe: Size of the batch, and how to corrupt it.
    """
    chosen = rows[rng.integers(len(rows), size=recipe.batch)]
    markers = chosen["markers"].astype(np.float64)
    center = markers.mean(axis=1, keepdims=True)
    stretch = _stretches(len(markers), recipe.anisotropy, rng)
    stretch = _mirrors(chosen["hand"]) @ stretch
    markers = (markers - center) @ stretch
    jitter = recipe.jitter * rng.uniform()
    if rng.random() < recipe.rig_share:
        observed = (chosen["observed"].astype(np.float64) - center) @ stretch
        ghosts = (chosen["ghosts"].astype(np.float64) - center) @ stretch
        corruption = Corruption(occlude=0, ghosts=0, jitter=jitter)
        return Batch(corrupt(observed, corruption, ghosts=ghosts, rng=rng), markers)
    own = recipe.corruption
    if isinstance(own, Corruption):
        own = dataclasses.replace(own, jitter=own.jitter + jitter)
    return Batch(draw_cloud(own, markers, rng=rng), markers)


def right_hands(
    rows: NDArray[np.void] | MappedRows, anisotropy: float, *, rng: np.random.Generator
) -> Float[np.ndarray, "B M 3"]:
    """All markers of each row [m], of left hands mirrored; each hand is stretched around its center."""
    markers = rows["markers"]
    centered = markers - markers.mean(axis=1, keepdims=True)
    return stretched(centered @ _mirrors(rows["hand"]), anisotropy, rng=rng)


def stretched(
    markers: Float[np.ndarray, "B M 3"], anisotropy: float, *, rng: np.random.Generator
) -> Float[np.ndarray, "B M 3"]:
    """Hands stretched at random around the origin, by this standard deviation of the logarithm."""
    return markers @ _stretches(len(markers), anisotropy, rng)


def _stretches(count: int, anisotropy: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Symmetric matrices (B, 3, 3) that stretch along random orthogonal directions."""
    axes, _ = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    factors = np.exp(anisotropy * rng.standard_normal((count, 1, 3)))
    stretches: NDArray[np.float64] = (axes * factors) @ axes.transpose(0, 2, 1)
    return stretches


def _mirrors(hand: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Matrices (B, 3, 3) that mirror left hands; the two hands of a person are in the order of `SIDES`."""
    mirrors = np.tile(np.eye(3), (len(hand), 1, 1))
    mirrors[hand % len(SIDES) == SIDES.index("left"), 0, 0] = -1.0
    return mirrors
