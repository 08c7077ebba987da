"""Training of the network for any layout: random layouts, a falling loss, and a run that goes on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from train.any_layout.layout_network import LayoutNetworkConfig
from train.any_layout.layout_training import LayoutBatches, LayoutTraining
from train.any_layout.skin_bank import sample_skin_bank

SMALL = LayoutNetworkConfig(width=32, gates=8, first_rounds=1, match_rounds=1)


@pytest.fixture(scope="module")
def bank():
    return sample_skin_bank(120, 4, rng=np.random.default_rng(0))


def test_batches_hold_layouts_of_one_size_and_their_clouds(bank):
    batches = LayoutBatches(bank, np.random.default_rng(1))
    for _ in range(5):
        cloud, layouts = batches.draw()
        groups, count = layouts.shape[:2]
        assert len(cloud.points) % groups == 0
        assert 5 <= count <= 30
        assert cloud.truth.max() < count
        assert (cloud.present & (cloud.truth >= 0)).sum(axis=1).min() >= 3
        assert layouts.max() <= 1.01 and layouts.min() >= 0.0


def test_a_run_that_was_stopped_goes_on_as_if_it_was_not(bank, tmp_path):
    drawn = [LayoutBatches(bank, np.random.default_rng(number)).draw() for number in range(4)]
    whole, first = LayoutTraining(100, SMALL), LayoutTraining(100, SMALL)
    losses = [whole.step(*batch)[0] for batch in drawn]
    for batch in drawn[:2]:
        first.step(*batch)
    first.save(tmp_path / "checkpoint.pt")
    torch.manual_seed(9)
    second = LayoutTraining(100, SMALL)
    second.restore(tmp_path / "checkpoint.pt")
    assert [second.step(*batch)[0] for batch in drawn[2:]] == pytest.approx(losses[2:], rel=1e-5)
    assert second.done == 4


def test_the_loss_falls(bank):
    batches, training = LayoutBatches(bank, np.random.default_rng(2)), LayoutTraining(30, SMALL)
    batch = batches.draw()
    losses = [training.step(*batch)[0] for _ in range(12)]
    assert losses[-1] < losses[0]
