"""The paper's network: its layers as printed, its loss and its matching."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train.labelers.cnn_network import DeepLabelCNN, match_positions, position_loss
from train.labelers.depth_image import depth_images, view_rotations
from train.labelers.matching import GHOST


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DeepLabelCNN(19).eval()


def test_layers_are_those_of_table_1(network):
    """Each weighted or pooling layer's input, and each filter, as the table prints them."""
    inputs, filters = [], []
    for layer in network.modules():
        if isinstance(layer, torch.nn.Conv2d | torch.nn.MaxPool2d | torch.nn.Linear):
            layer.register_forward_pre_hook(lambda _, given: inputs.append(tuple(given[0].shape[1:])))
        if isinstance(layer, torch.nn.Conv2d | torch.nn.Linear):
            filters.append(tuple(layer.weight.shape))
    with torch.inference_mode():
        positions = network(torch.rand(2, 1, 52, 52))
    assert positions.shape == (2, 19, 3)
    assert inputs == [
        (1, 52, 52),
        (64, 50, 50),
        (64, 48, 48),
        (64, 24, 24),
        (128, 22, 22),
        (128, 20, 20),
        (128, 18, 18),
        (10368,),
        (2048,),
    ]
    assert filters == [
        (64, 1, 3, 3),
        (64, 64, 3, 3),
        (128, 64, 3, 3),
        (128, 128, 3, 3),
        (128, 128, 3, 3),
        (2048, 10368),
        (57, 2048),
    ]
    kinds = [type(layer).__name__ for layer in network.features]
    block = ["Conv2d", "BatchNorm2d", "ReLU"]
    assert kinds == [*block * 2, "MaxPool2d", *block * 3, "MaxPool2d"]
    assert [type(layer).__name__ for layer in network.positions] == ["Flatten", "Linear", "ReLU", "Linear"]


def test_parameters_add_up(network):
    """21.8 million: biases of all layers and two numbers a channel for batch normalization included."""
    weights = 64 * 9 + 64 * 64 * 9 + 64 * 128 * 9 + 2 * 128 * 128 * 9 + 10368 * 2048 + 2048 * 57
    biases = 64 + 64 + 128 + 128 + 128 + 2048 + 57
    normalization = 2 * (64 + 64 + 128 + 128 + 128)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == weights + biases + normalization == 21_760_121
    with torch.device("meta"):
        sparse = sum(parameter.numel() for parameter in DeepLabelCNN(13).parameters())
    assert count - sparse == 6 * 3 * (2048 + 1)


def test_loss_is_smooth_l1_over_present_markers():
    predicted = torch.zeros(1, 3, 3, requires_grad=True)
    targets = torch.tensor([[[0.5, 0.0, -0.5], [3.0, 0.0, 0.0], [torch.nan, torch.nan, torch.nan]]])
    loss = position_loss(predicted, targets, torch.tensor([[True, True, False]]))
    assert torch.isclose(loss, torch.tensor((0.125 + 0.125 + 2.5) / 6))
    loss.backward()
    assert torch.isfinite(predicted.grad).all()
    assert (predicted.grad[0, 2] == 0).all()
    assert position_loss(predicted, targets, torch.zeros(1, 3, dtype=torch.bool)) == 0


@given(seed=st.integers(0, 10_000), count=st.integers(0, 4), num_labels=st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_no_matching_is_cheaper(seed, count, num_labels):
    rng = np.random.default_rng(seed)
    predicted, points = rng.normal(size=(num_labels, 3)), rng.normal(size=(count, 3))
    reject = rng.uniform(0.5, 3.0)

    def cost(labels):
        held = [label for label in labels if label != GHOST]
        if len(set(held)) < len(held):
            return np.inf
        return sum(
            reject if label == GHOST else np.linalg.norm(point - predicted[label])
            for point, label in zip(points, labels, strict=True)
        )

    labels = match_positions(predicted, points, reject)
    assert labels.shape == (count,)
    assert np.isclose(
        cost(labels.tolist()), min(map(cost, itertools.product(range(-1, num_labels), repeat=count)))
    )


def test_matching_rejects_what_is_far_or_missing():
    predicted = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    points = np.array([[0.2, 0.016, 0], [0.1, 0.014, 0], [np.nan] * 3, [0.1, 0.001, 0]])
    assert match_positions(predicted, points).tolist() == [-1, -1, -1, 1]
    assert match_positions(predicted, points, reject=0.02).tolist() == [2, -1, -1, 1]


def test_matching_counts_distances_not_their_squares():
    """0 and 8.1 mm beat 4 and 5 mm, whose squares are the lesser."""
    predicted = np.array([[0.0, 0.0, 0.0], [0.004, 0.0, 0.0]])
    points = np.array([[0.004, 0.0, 0.0], [0.007, 0.004, 0.0]])
    assert match_positions(predicted, points).tolist() == [1, 0]


def test_network_learns_a_few_clouds_by_heart(rng):
    """Random clouds share nothing but their mean, so a loss this low is read off the images.

    One answer to all of them would take an eighth off the first loss at best.
    """
    points = rng.uniform(-0.1, 0.1, size=(8, 19, 3))
    present = np.ones((8, 19), dtype=bool)
    images, frames = depth_images(points, present, view_rotations(points, present, policy="random", rng=rng))
    inputs = torch.from_numpy(images)[:, None]
    targets = torch.from_numpy(frames.normalize(points)).float()
    torch.manual_seed(0)
    network = DeepLabelCNN(19)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-5)
    losses = []
    for _ in range(12):
        loss = position_loss(network(inputs), targets, torch.from_numpy(present))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 5
