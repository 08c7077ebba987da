"""Batches of labeled clouds: what is in them, and that their sequence does not depend on workers."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from handsim.errors import ArgumentError, DatasetError
from tests.sentences import error_names
from train import CloudStream, Corruption, Dataset, generate_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    out = tmp_path_factory.mktemp("stream") / "set"
    alone = {"together": 0, "holding": 0}
    return generate_dataset(out, glove="tips8", num_frames=120, seed=2, workers=1, scenes=alone)


def test_a_clean_batch_is_the_markers_of_right_hands(dataset):
    points, present, labels = CloudStream(dataset, Corruption(0, 0), batch=16).batch(0)
    assert (points.dtype, present.dtype, labels.dtype) == (torch.float32, torch.bool, torch.int64)
    assert points.shape == (16, 8, 3) and present.all()
    assert (labels.sort(dim=1).values == torch.arange(8)).all()
    assert points.mean(dim=1).abs().max() < 1e-6 and points.abs().max() < 0.2, "[m], around the middle"
    markers = torch.empty_like(points).scatter_(1, labels[..., None].expand(-1, -1, 3), points)
    ordered = dataset.rows()["markers"].astype(np.float64)
    distances = np.linalg.norm(ordered[:, 0] - ordered[:, 5], axis=1)
    drawn = (markers[:, 0] - markers[:, 5]).norm(dim=1).numpy()
    assert np.abs(drawn[:, None] - distances).min(axis=1).max() < 1e-6, "no hand is stretched"


def test_drops_and_ghosts_are_drawn_and_padding_has_no_label(dataset):
    points, present, labels = CloudStream(dataset, Corruption(occlude=4, ghosts=2), batch=64).batch(3)
    assert (labels[~present] == -1).all() and (points[~present] == 0.0).all()
    ghosts = (present & (labels < 0)).sum(dim=1)
    assert set(ghosts.tolist()) == {0, 1, 2}
    assert ((labels >= 0).sum(dim=1) < 8).any()


@pytest.mark.parametrize("workers", [1, 2])
def test_the_sequence_is_the_same_with_any_number_of_workers(dataset, workers):
    stream = CloudStream(dataset, batch=8, seed=5)
    loader = DataLoader(stream, batch_size=None, num_workers=workers)
    alone, shared = list(islice(stream, 5)), list(islice(loader, 5))
    for one, other in zip(alone, shared, strict=True):
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))
    assert not torch.equal(alone[0][0], alone[1][0]), "every batch is another"
    assert torch.equal(next(iter(CloudStream(dataset, batch=8, seed=5, start=3)))[0], alone[3][0])


@pytest.mark.parametrize(
    ("workers", "method"),
    [(0, None), (1, "fork"), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)],
)
def test_ranks_share_the_sequence(dataset, workers, method, monkeypatch):
    stream, size = CloudStream(dataset, batch=8, seed=5), 2
    alone, shared = list(islice(stream, 8)), []
    monkeypatch.setenv("WORLD_SIZE", str(size))
    for rank in range(size):
        monkeypatch.setenv("RANK", str(rank))
        loader = DataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=method)
        shared.append(list(islice(loader, 4)))
    for number, one in enumerate(alone):
        other = shared[number % size][number // size]
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_a_corruption_of_ones_own_may_be_a_function(dataset):
    def every_second(markers, *, rng):
        lost = np.where(np.arange(markers.shape[1])[:, None] % 2, np.nan, markers)
        return lost, np.tile(np.arange(markers.shape[1]), (len(markers), 1))

    _, present, labels = CloudStream(dataset.path, every_second, batch=4).batch(0)
    assert present.all() and (labels.sort(dim=1).values == torch.arange(0, 8, 2)).all()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"dataset": 5}, "dataset is 5, expected a Dataset or the folder of one"),
        ({"corruption": 5}, "corruption is 5, expected a Corruption, a function"),
        ({"batch": 0}, "batch is 0, expected at least 1"),
        ({"batch": "many"}, "batch is 'many', expected a whole number"),
        ({"rig_share": 2.0}, "rig_share is 2, expected a number from 0 to 1"),
    ],
)
def test_mistakes_are_told(dataset, options, sentence):
    with error_names(ArgumentError, sentence):
        CloudStream(**{"dataset": dataset, **options})


def test_a_folder_that_is_no_set_is_told(tmp_path):
    with pytest.raises(DatasetError, match="expected a training set"):
        CloudStream(tmp_path)
