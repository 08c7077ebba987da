"""The network for any layout: what must not matter does not, and layouts in a batch do not meet."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train.any_layout.layout_network import LayoutNetwork, LayoutNetworkConfig, distance_features, layout_loss

CONFIG = LayoutNetworkConfig(width=32, gates=8, first_rounds=1, match_rounds=2)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return LayoutNetwork(CONFIG).double().eval()


def cloud(seed: int, count: int = 7) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.08, 0.08, size=(1, count, 3)))


def layout(seed: int, count: int = 5) -> torch.Tensor:
    """Mean features of a layout of markers that scatter around their places."""
    rng = np.random.default_rng([7, seed])
    poses = rng.uniform(-0.08, 0.08, size=(count, 3)) + 0.005 * rng.normal(size=(20, count, 3))
    return distance_features(torch.from_numpy(poses), CONFIG).mean(0, keepdim=True)


def run(network, points, layouts):
    with torch.inference_mode():
        return network(points, torch.ones(points.shape[:2], dtype=torch.bool), layouts)


def same(before, after) -> None:
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-6)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_turning_moving_and_mirroring_change_nothing(network, seed):
    points = cloud(seed)
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))  # reflections among them
    moved = points @ torch.from_numpy(rotation) + torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    for before, after in zip(
        run(network, points, layout(seed)), run(network, moved, layout(seed)), strict=True
    ):
        same(before, after)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_the_order_of_points_and_of_markers_only_reorders(network, seed):
    points, known, rng = cloud(seed), layout(seed), np.random.default_rng(seed)
    of_points, of_markers = rng.permutation(7), rng.permutation(5)
    before = run(network, points, known)[-1]
    after = run(network, points[:, of_points], known[:, of_markers][:, :, of_markers])[-1]
    same(
        (
            before.points[:, of_points][..., [*of_markers, 5]],
            before.labels[:, of_markers][..., [*of_points, 7]],
        ),
        after,
    )


def test_padding_changes_nothing(network):
    points = cloud(1)
    padded = torch.cat([points, torch.full((1, 4, 3), 0.5, dtype=torch.float64)], dim=1)
    with torch.inference_mode():
        scores = network(padded, torch.arange(11)[None] < 7, layout(1))[-1]
    alone = run(network, points, layout(1))[-1]
    same((scores.points[:, :7], scores.labels[..., [*range(7), 11]]), alone)


def test_layouts_of_a_batch_do_not_meet(network):
    points = torch.cat([cloud(seed) for seed in range(4)])
    both = run(network, points, torch.cat([layout(0), layout(1)]))[-1]
    first, second = run(network, points[:2], layout(0))[-1], run(network, points[2:], layout(1))[-1]
    same(both, (torch.cat([first.points, second.points]), torch.cat([first.labels, second.labels])))


def test_scores_are_probabilities_and_the_loss_falls_with_the_truth(network):
    found = run(network, cloud(3), layout(3))
    for scores in found:
        for table in scores:
            torch.testing.assert_close(table.exp().sum(-1), torch.ones_like(table[..., 0]))
    present = torch.ones(1, 7, dtype=torch.bool)
    best = found[-1].points.argmax(-1)
    likely = torch.where(best == 5, -1, best)
    worst = found[-1].points[..., :-1].argmin(-1)
    assert layout_loss(found, likely, present) < layout_loss(found, worst, present)
