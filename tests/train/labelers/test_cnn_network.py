"""The paper's network, dense and sparse."""

from __future__ import annotations

import copy
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train import CNNConfig
from train.labelers.cnn_labeler import depth_images, random_views
from train.labelers.cnn_network import DeepLabelCNN, filter_sparse
from train.labelers.matching import GHOST, match_distances


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DeepLabelCNN(CNNConfig()).eval()


def test_layers_are_those_of_table_1(network):
    """Each weighted or pooling layer's input, and each filter, as the table prints them."""
    inputs, filters = [], []
    for layer in network.modules():
        if isinstance(layer, torch.nn.Conv2d | torch.nn.MaxPool2d | torch.nn.Linear):
            layer.register_forward_pre_hook(lambda _, given: inputs.append(tuple(given[0].shape[1:])))
        if isinstance(layer, torch.nn.Conv2d | torch.nn.Linear):
            filters.append(tuple(layer.weight.shape))
    with torch.inference_mode():
        images = torch.rand(2, 1, 52, 52)
        assert network.positions(network.features(images)).shape == (2, 57)
        assert network(images).shape == (2, 19, 3)
    assert inputs[:9] == [
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

    labels = match_distances(np.linalg.norm(points[:, None] - predicted, axis=-1), reject)
    assert labels.shape == (count,)
    assert np.isclose(
        cost(labels.tolist()), min(map(cost, itertools.product(range(-1, num_labels), repeat=count)))
    )


def test_network_learns_a_few_clouds_by_heart(rng):
    """Random clouds share nothing but their mean, so a loss this low is read off the images.

    One answer to all of them would take an eighth off the first loss at best.
    """
    points = rng.uniform(-0.1, 0.1, size=(8, 19, 3))
    present = np.ones((8, 19), dtype=bool)
    images, frames = depth_images(points, present, random_views(8, rng=rng))
    inputs = torch.from_numpy(images)[:, None]
    targets = torch.from_numpy(frames.normalize(points)).float()
    torch.manual_seed(0)
    network = DeepLabelCNN(CNNConfig())
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-5)
    losses = []
    for _ in range(12):
        loss = torch.nn.functional.smooth_l1_loss(network(inputs), targets)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 5


def images_of(rng, batch, points, size=52):
    images = torch.zeros(batch, 1, size, size, dtype=torch.float64)
    for image in images:
        rows, columns = rng.integers(size, size=(2, points))
        image[0, rows, columns] = torch.from_numpy(rng.uniform(0.1, 1.0, size=points))
    return images


@pytest.fixture(params=[0, 1, 19, 400], ids=lambda points: f"{points} points")
def images(request, rng):
    """Images with points anywhere, at the border too; 400 fill most of the later layers."""
    return images_of(rng, 3, request.param)


@pytest.fixture
def filters():
    """Double precision, with weights of all layers that batch normalization does not hide."""
    torch.manual_seed(0)
    layers = DeepLabelCNN(CNNConfig()).double().features[:10]
    for layer in layers:
        if isinstance(layer, torch.nn.BatchNorm2d):
            for tensor in (layer.weight.data, layer.bias.data, layer.running_mean, layer.running_var):
                tensor.copy_(torch.rand_like(tensor) + 0.5)
    return layers


@pytest.mark.parametrize("training", [True, False])
def test_values_gradients_and_statistics_are_the_dense_ones(filters, images, training):
    dense = copy.deepcopy(filters).train(training)
    filters.train(training)
    expected = dense(images)
    found = filter_sparse(images, list(filters)).dense()
    assert found.shape == (3, 128, 22, 22)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)
    weight = torch.rand_like(expected)
    (expected * weight).sum().backward()
    (found * weight).sum().backward()
    for (name, a), b in zip(filters.named_parameters(), dense.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-6, atol=1e-5, msg=name)
    for a, b in zip(filters.buffers(), dense.buffers(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def test_only_what_differs_from_the_background_is_computed(filters, rng):
    features = filter_sparse(images_of(rng, 2, 1), list(filters.eval()))
    assert features.pixels.shape == (2, 22, 22)
    assert 0 < len(features.values) <= 2 * 36  # a point reaches 5x5 pixels, pooled 3x3, then 5x5


def test_the_network_takes_the_sparse_road_unless_it_is_traced(rng):
    torch.manual_seed(0)
    network = DeepLabelCNN(CNNConfig()).eval()
    images = images_of(rng, 2, 19).float()
    with torch.inference_mode():
        found = network(images)
        traced = torch.jit.trace(network, (images,))
        torch.testing.assert_close(found, traced(images), rtol=1e-4, atol=1e-5)
