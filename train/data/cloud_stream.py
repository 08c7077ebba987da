"""Endless batches of labeled clouds from a training set, for users' own networks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from handsim._checks import check_count, check_number
from handsim._process import SharedStream, with_own_numerics
from train.data.batches import BatchRecipe, Corruption, OwnCorruption, check_corruption, draw_batch
from train.data.shards import Dataset, load_dataset


class CloudStream(SharedStream, IterableDataset[tuple[Tensor, Tensor, Tensor]]):
    """Clouds of points of one hand, each corrupted anew, in endless batches.

    An item is a batch: points (B, N, 3) [m], float32, relative to the center of the hand's markers, 0 in
    padding; which of them are present (B, N), bool; and the marker of each (B, N), int64, -1 for a ghost.
    Left hands are mirrored to right ones. N is that of the fullest cloud.

    For `torch.utils.data.DataLoader(stream, batch_size=None, num_workers=...)`. Batch number n depends only
    on the set, the settings, the seed and n, and workers share the numbers: the sequence is the same for any
    number of workers. So do the ranks of torch.distributed, or those that torchrun, srun or mpirun state: of
    two, one has the even batches. Each pass begins at batch `start` again.

    Args:
        dataset: The training set, or its folder.
        corruption: Corruption of clean markers: a `Corruption`, or a function of your own
            `(markers, *, rng) -> (points, labels)`, its `module:name` or its entry point.
        batch: Number of clouds in a batch, B.
        seed: Seed of all randomness.
        rig_share: Share of batches, 0 to 1, seen by the set's simulated cameras instead; the shipped labelers
            learn from half of each.
        anisotropy: Log standard deviation of the stretch of each hand along three random directions.
        start: Number of the first batch.

    Raises:
        ArgumentError: An argument is of another type or out of range.
        DatasetError: There is no such set, or it is damaged.
    """

    def __init__(
        self,
        dataset: Dataset | str | Path,
        corruption: Corruption | OwnCorruption | str = Corruption(),  # noqa: B008 - it is frozen
        *,
        batch: int = 64,
        seed: int = 0,
        rig_share: float = 0.0,
        anisotropy: float = 0.0,
        start: int = 0,
    ) -> None:
        self.dataset = load_dataset(dataset)
        for name, value, least in (("batch", batch, 1), ("seed", seed, 0), ("start", start, 0)):
            check_count(name, value, least)
        check_number("rig_share", rig_share, 0.0, 1.0)
        check_number("anisotropy", anisotropy, 0.0, 1.0)
        if not isinstance(corruption, Corruption):
            check_corruption(corruption, len(self.dataset.marker_names))
        self.recipe = BatchRecipe(batch, corruption, rig_share=rig_share, anisotropy=anisotropy)
        self.seed, self.start = seed, start

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        first, step = self.share()
        for number in count(self.start + first, step):
            yield self.batch(number)

    @with_own_numerics
    def batch(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Points (B, N, 3) [m], presence (B, N) and labels (B, N) of a batch."""
        rng = np.random.default_rng((self.seed, number))
        cloud = draw_batch(self.dataset.mapped_rows(), self.recipe, rng=rng).cloud
        return (
            torch.from_numpy(cloud.points.astype(np.float32)),
            torch.from_numpy(cloud.present),
            torch.from_numpy(np.where(cloud.present, cloud.truth, -1)),
        )
