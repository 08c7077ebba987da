"""The networks: what leaves their scores unchanged, what they learn, where they compute."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.held_out import held_out_markers
from train import CNNConfig, Corruption, SetLabelerConfig, corrupt, load_labeler
from train.labelers import networks
from train.labelers.networks import (
    LabelScores,
    LayoutNetwork,
    LayoutNetworkConfig,
    SetLabeler,
    distance_features,
    labeler_of,
    labeling_loss,
    layout_loss,
    new_network,
)

CONFIG = LayoutNetworkConfig(width=32, gates=8, first_rounds=1, match_rounds=2)
NAMES = tuple(f"m{number}" for number in range(19))


@pytest.fixture(scope="module", params=["one layout", "any layout"])
def run(request):
    """Scores of five labels that a network gives to points, or to those that are present."""
    torch.manual_seed(0)
    one = request.param == "one layout"
    config = SetLabelerConfig(num_labels=5, width=32, gates=8, depth=2) if one else CONFIG
    network = (SetLabeler if one else LayoutNetwork)(config).double().eval()

    def scores(points, present=None, known=None) -> LabelScores:
        if present is None:
            present = torch.ones(points.shape[:2], dtype=torch.bool)
        with torch.inference_mode():
            if one:
                return network(points, present)
            return network(points, present, layout(1) if known is None else known)[-1]

    return scores


def cloud(seed: int, count: int = 7) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.08, 0.08, size=(1, count, 3)))


def layout(seed: int, count: int = 5) -> torch.Tensor:
    """Mean features of a layout of markers that scatter around their places."""
    rng = np.random.default_rng([7, seed])
    poses = rng.uniform(-0.08, 0.08, size=(count, 3)) + 0.005 * rng.normal(size=(20, count, 3))
    return distance_features(torch.from_numpy(poses), CONFIG).mean(0, keepdim=True)


def same(before, after) -> None:
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-6)


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_turning_moving_and_mirroring_change_nothing(run, seed):
    points = cloud(seed)
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))  # reflections among them
    moved = points @ torch.from_numpy(rotation) + torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    same(run(points), run(moved))


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_order_only_reorders(run, seed):
    points, order = cloud(seed), np.random.default_rng(seed).permutation(7)
    before = run(points)
    same((before.points[:, order], before.labels[..., [*order, 7]]), run(points[:, order]))


def test_padding_changes_nothing(run):
    points = cloud(1)
    padded = torch.cat([points, torch.full((1, 4, 3), 0.5, dtype=torch.float64)], dim=1)
    scores = run(padded, torch.arange(11)[None] < 7)
    same((scores.points[:, :7], scores.labels[..., [*range(7), 11]]), run(points))


def test_outputs_are_log_probabilities(run):
    scores = run(cloud(2))
    assert scores.points.shape == (1, 7, 6)
    assert scores.labels.shape == (1, 5, 8)
    for table in scores:
        torch.testing.assert_close(table.exp().sum(-1), torch.ones_like(table[..., 0]))


@pytest.mark.parametrize("run", ["any layout"], indirect=True)
def test_the_order_of_markers_only_reorders(run):
    points, known, order = cloud(4), layout(4), np.random.default_rng(4).permutation(5)
    before, after = run(points, known=known), run(points, known=known[:, order][:, :, order])
    same((before.points[..., [*order, 5]], before.labels[:, order]), after)


@pytest.mark.parametrize("run", ["any layout"], indirect=True)
def test_layouts_of_a_batch_do_not_meet(run):
    points = torch.cat([cloud(seed) for seed in range(4)])
    both = run(points, known=torch.cat([layout(0), layout(1)]))
    parts = run(points[:2], known=layout(0)), run(points[2:], known=layout(1))
    same(both, [torch.cat(tables) for tables in zip(*parts, strict=True)])


def test_loss_is_least_at_the_truth():
    truth, present = torch.tensor([[0, 2, -1]]), torch.ones(1, 3, dtype=torch.bool)

    def loss_of(by_point, by_label):
        points, labels = torch.full((1, 3, 4), -20.0), torch.full((1, 3, 4), -20.0)
        points[0, range(3), by_point] = 0.0
        labels[0, range(3), by_label] = 0.0
        return float(labeling_loss(LabelScores(points, labels), truth, present))

    right = loss_of([0, 2, 3], [0, 3, 1])  # marker 1 is occluded, point 2 a ghost
    assert right == pytest.approx(0.0)
    assert loss_of([0, 1, 3], [0, 3, 1]) > 5.0
    assert loss_of([0, 2, 3], [0, 2, 1]) > 5.0


@pytest.mark.parametrize("run", ["any layout"], indirect=True)
def test_the_loss_of_any_layout_falls_with_the_truth(run):
    found, present = run(cloud(3), known=layout(3)), torch.ones(1, 7, dtype=torch.bool)
    best = found.points.argmax(-1)
    likely = torch.where(best == 5, -1, best)
    worst = found.points[..., :-1].argmin(-1)
    assert layout_loss([found], likely, present) < layout_loss([found], worst, present)


@pytest.fixture(scope="module")
def clouds():
    cloud = corrupt(held_out_markers("dense19", 60, seed=0), Corruption(), rng=np.random.default_rng(0))
    return [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]


def same_labels(batched, single):
    different = sum((one.labels != two.labels).any() for one, two in zip(batched, single, strict=True))
    off = max(np.abs(one.confidence - two.confidence).max() for one, two in zip(batched, single, strict=True))
    return different == 0 and off < 1e-3


def test_batches_give_the_labels_of_clouds_alone(clouds):
    labeler = load_labeler("dense19")
    assert same_labels(labeler.label_frames(clouds), [labeler.label_frames([one])[0] for one in clouds])


def test_a_copy_on_another_device_gives_the_same(clouds, monkeypatch):
    expected = drawn_cnn().label_frames(clouds[:8])
    other = torch.device("cpu", 0)  # which is another name than that of the network's device
    monkeypatch.setattr(networks, "batch_device", lambda: other)
    assert same_labels(drawn_cnn().label_frames(clouds[:8]), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_the_labels_of_the_cpu(clouds, monkeypatch):
    on_gpu = drawn_cnn().label_frames(clouds)
    monkeypatch.setattr(networks, "batch_device", lambda: torch.device("cpu"))
    assert same_labels(on_gpu, drawn_cnn().label_frames(clouds))


def drawn_cnn():
    torch.manual_seed(0)
    return labeler_of(new_network(CNNConfig()), NAMES)
