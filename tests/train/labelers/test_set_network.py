"""The network: what must not matter does not, and its outputs are probabilities."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train.config import SetLabelerConfig
from train.labelers.set_network import SetLabeler, labeling_loss


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return SetLabeler(SetLabelerConfig(num_labels=5, width=32, gates=8, depth=2)).double().eval()


def cloud(seed: int, count: int = 7) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.08, 0.08, size=(1, count, 3)))


def run(network, points):
    with torch.inference_mode():
        return network(points, torch.ones(points.shape[:2], dtype=torch.bool))


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_turning_moving_and_mirroring_change_nothing(network, seed):
    points = cloud(seed)
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))  # reflections among them
    moved = points @ torch.from_numpy(rotation) + torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    for before, after in zip(run(network, points), run(network, moved), strict=True):
        torch.testing.assert_close(before, after, atol=1e-6, rtol=1e-6)


@given(seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_order_only_reorders(network, seed):
    points = cloud(seed)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(7))
    before, after = run(network, points), run(network, points[:, order])
    torch.testing.assert_close(before.points[:, order], after.points)
    torch.testing.assert_close(before.labels[..., [*order.tolist(), 7]], after.labels)


def test_padding_changes_nothing(network):
    points = cloud(1)
    padded = torch.cat([points, torch.full((1, 4, 3), 0.5, dtype=torch.float64)], dim=1)
    present = torch.arange(11)[None] < 7
    with torch.inference_mode():
        scores = network(padded, present)
    alone = run(network, points)
    torch.testing.assert_close(scores.points[:, :7], alone.points)
    torch.testing.assert_close(scores.labels[..., [*range(7), 11]], alone.labels)


def test_outputs_are_log_probabilities(network):
    scores = run(network, cloud(2))
    assert scores.points.shape == (1, 7, 6)
    assert scores.labels.shape == (1, 5, 8)
    torch.testing.assert_close(scores.points.exp().sum(-1), torch.ones(1, 7, dtype=torch.float64))
    torch.testing.assert_close(scores.labels.exp().sum(-1), torch.ones(1, 5, dtype=torch.float64))


def test_loss_is_least_at_the_truth():
    truth, present = torch.tensor([[0, 2, -1]]), torch.ones(1, 3, dtype=torch.bool)

    def loss_of(by_point, by_label):
        from train.labelers.set_network import LabelScores

        points, labels = torch.full((1, 3, 4), -20.0), torch.full((1, 3, 4), -20.0)
        points[0, range(3), by_point] = 0.0
        labels[0, range(3), by_label] = 0.0
        return float(labeling_loss(LabelScores(points, labels), truth, present))

    right = loss_of([0, 2, 3], [0, 3, 1])  # marker 1 is occluded, point 2 a ghost
    assert right == pytest.approx(0.0)
    assert loss_of([0, 1, 3], [0, 3, 1]) > 5.0
    assert loss_of([0, 2, 3], [0, 2, 1]) > 5.0
