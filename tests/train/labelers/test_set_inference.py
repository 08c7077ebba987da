"""The set labeler in numpy against the same network in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.held_out import held_out_markers
from train import SetLabelerConfig, load_labeler
from train.labelers.networks import SetLabeler
from train.labelers.protocol import pad_clouds
from train.labelers.set_inference import TrainedSetLabeler, weight_shapes
from train.labelers.storage import load_network


def compiled(network: SetLabeler) -> TrainedSetLabeler:
    return TrainedSetLabeler(network.config, network.numpy_weights(), None, ())


@pytest.mark.parametrize("config", [SetLabelerConfig(), SetLabelerConfig(depth=2, gates=8, num_labels=7)])
def test_weights_have_the_networks_names_and_shapes(config):
    state = SetLabeler(config).state_dict()
    assert weight_shapes(config) == {name: tuple(one.shape) for name, one in state.items()}


def compare(network: SetLabeler, points: np.ndarray) -> None:
    with torch.inference_mode():
        expected = network(*(torch.from_numpy(part) for part in pad_clouds([points])))
    for mine, theirs in zip(compiled(network).scores(points), expected, strict=True):
        np.testing.assert_allclose(mine, theirs[0].numpy(), atol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 7, 19, 60])
def test_shipped_weights_give_the_same_scores_anywhere(count, rng):
    network, _ = load_network("dense19")
    compare(network.eval(), rng.uniform(-0.1, 0.1, (count, 3)) + [1.0, -2.0, 5.0])


def test_a_network_of_any_size_gives_the_same_scores(rng):
    torch.manual_seed(0)
    config = SetLabelerConfig(num_labels=7, width=24, gates=3, depth=2, num_distances=9, reach=0.3)
    compare(SetLabeler(config).eval(), rng.uniform(-0.1, 0.1, (11, 3)))


def test_huge_scores_do_not_overflow(rng):
    network = SetLabeler(SetLabelerConfig(num_labels=5, depth=1))
    with torch.no_grad():
        for weight in network.parameters():
            weight.mul_(30.0)
    with np.errstate(over="raise", invalid="raise"):
        for scores in compiled(network.eval()).scores(rng.uniform(-0.1, 0.1, (9, 3))):
            assert np.isfinite(scores).all()


def test_a_hand_alone_is_labeled_like_a_hand_in_a_batch():
    labeler = load_labeler("dense19")
    assert isinstance(labeler, TrainedSetLabeler)
    hands = list(held_out_markers("dense19", 20, seed=3))
    for alone, together in zip(
        [labeler.label_frames([hand])[0] for hand in hands], labeler.label_frames(hands), strict=True
    ):
        np.testing.assert_array_equal(alone.labels, together.labels)
        np.testing.assert_allclose(alone.confidence, together.confidence, atol=1e-4)
