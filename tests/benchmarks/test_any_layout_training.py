"""The training of the network for any layout, and its places on the skin."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.any_layout_training import LayoutBatches, LayoutTraining, sample_skin_bank
from train.labelers.networks import LayoutNetworkConfig


@pytest.fixture(scope="module")
def bank():
    return sample_skin_bank(70, 3, rng=np.random.default_rng(0))


def test_places_are_apart_and_many_bones_have_some(bank):
    apart = bank.mean_distances()
    assert (apart[~np.eye(70, dtype=bool)] > 0.002).all()
    assert len({place.bone for place in bank.places}) > 10
    assert len({place.name for place in bank.places}) == 70


def test_positions_are_those_of_hands(bank):
    assert bank.positions.shape[1:] == (70, 3)
    assert bank.positions.dtype == np.float16
    spans = np.ptp(bank.positions.astype(np.float64), axis=1).max(axis=1)
    assert (spans > 0.05).all() and (spans < 0.30).all()
    np.testing.assert_allclose(bank.positions.astype(np.float64).mean(axis=1), 0.0, atol=1e-3)


def test_mean_distances_are_those_of_the_positions(bank):
    positions = bank.positions.astype(np.float64)
    expected = np.linalg.norm(positions[:, 4] - positions[:, 9], axis=1).mean()
    assert bank.mean_distances(10_000)[4, 9] == pytest.approx(expected, abs=1e-5)


SMALL = LayoutNetworkConfig(width=32, gates=8, first_rounds=1, match_rounds=1)


@pytest.fixture(scope="module")
def small_bank():
    return sample_skin_bank(120, 4, rng=np.random.default_rng(0))


def test_batches_hold_layouts_of_one_size_and_their_clouds(small_bank):
    batches = LayoutBatches(small_bank, np.random.default_rng(1))
    for _ in range(5):
        cloud, layouts = batches.draw()
        groups, count = layouts.shape[:2]
        assert len(cloud.points) % groups == 0
        assert 5 <= count <= 30
        assert cloud.truth.max() < count
        assert (cloud.present & (cloud.truth >= 0)).sum(axis=1).min() >= 3
        assert layouts.max() <= 1.01 and layouts.min() >= 0.0


def test_the_loss_falls(small_bank):
    batches, training = LayoutBatches(small_bank, np.random.default_rng(2)), LayoutTraining(30, SMALL)
    batch = batches.draw()
    losses = [training.step(*batch)[0] for _ in range(12)]
    assert losses[-1] < losses[0]
