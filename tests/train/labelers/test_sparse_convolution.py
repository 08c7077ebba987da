"""The sparse filters give what torch's dense layers give, in training and after it."""

from __future__ import annotations

import copy

import pytest
import torch

from train.config import CNNConfig
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.sparse_convolution import filter_sparse


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
