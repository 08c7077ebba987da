"""The paper's network: VGG-style, from a depth image to the position of each marker.

Han et al. 2018, Table 1. Its filters are valid (no padding): 52 → 50 → 48, pool 24 → 22 → 20 → 18, pool 9.
The outputs are positions in the image's view frame (`train.labelers.cnn_labeler.ViewFrames`), in the
layout's marker order; labels come from matching them with the points (equation 1).

On a CPU the first filters are computed only where an image differs from its background. A depth image has
points in about 20 of its 2,704 pixels. Convolutions without padding keep the rest uniform, so that the
features of a layer are one background and the pixels that differ from it: 7 % of the first layer, 18 % of the
second, 55 % of the third. The results, batch statistics included, equal those of dense layers, with a third
of the multiplications.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Int32
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from handsim.kernels import kernel
from train.data.batches import Batch, Part
from train.labelers.cnn_labeler import NUM_MOMENTS, MeanHand, depth_images, random_views
from train.settings import CNNConfig, TrainSettings

_TAPS = 9  # weights of a 3x3 filter

_NUM_SPARSE: Final = 10  # layers up to the third filter, after which sparsity no longer helps


class SparseFeatures(NamedTuple):
    """Features of a batch of images with a uniform background."""

    pixels: Int32[np.ndarray, "B S S"]
    """Row of each pixel in `values`, -1 for background."""
    values: Float[Tensor, "P C"]
    """Features of the other pixels minus the background's."""
    background: Float[Tensor, "C"]

    def dense(self) -> Float[Tensor, "B C S S"]:
        """All pixels, with channels last in memory."""
        batch, size, _ = self.pixels.shape
        rows = torch.from_numpy(np.flatnonzero(self.pixels.ravel() >= 0))
        everywhere = self.background.expand(batch * size * size, -1)
        filled = everywhere.index_copy(0, rows, self.values + self.background)
        return filled.view(batch, size, size, -1).permute(0, 3, 1, 2)


def filter_sparse(images: Float[Tensor, "B 1 S S"], filters: Sequence[nn.Module]) -> SparseFeatures:
    """Features of images on the CPU whose background is 0.

    The filters are 3x3 convolutions without padding, each followed by its batch normalization, and ReLUs and
    2x2 max-poolings. Running statistics are updated as by the dense layers.
    """
    pictures = images[:, 0].numpy()
    there = pictures != 0.0
    pixels = np.where(there, np.cumsum(there, dtype=np.int32).reshape(there.shape) - 1, np.int32(-1))
    values = torch.from_numpy(pictures[there]).view(-1, 1)
    features = SparseFeatures(pixels, values, values.new_zeros(1))
    for layer in filters:
        if isinstance(layer, nn.Conv2d):
            features = _convolve(features, layer)
        elif isinstance(layer, nn.BatchNorm2d):
            features = _normalize(features, layer)
        elif isinstance(layer, nn.ReLU):
            active = functional.relu(features.values + features.background)
            background = functional.relu(features.background)
            features = SparseFeatures(features.pixels, active - background, background)
        else:
            assert isinstance(layer, nn.MaxPool2d)
            features = _pool(features)
    return features


def _convolve(features: SparseFeatures, layer: nn.Conv2d) -> SparseFeatures:
    """A 3x3 convolution without padding."""
    pixels, sources, targets = _connect(features.pixels, len(features.values))
    weight = layer.weight.permute(1, 2, 3, 0).reshape(layer.in_channels, -1)  # (C, taps x C')
    values = _Convolution.apply(  # type: ignore[no-untyped-call]
        features.values, weight, torch.from_numpy(sources), torch.from_numpy(targets)
    )
    assert layer.bias is not None
    return SparseFeatures(pixels, values, layer.bias + layer.weight.sum((2, 3)) @ features.background)


class _Convolution(torch.autograd.Function):
    """Multiply each input by the nine taps, then sum the products for each output."""

    @staticmethod
    def forward(
        context: Any,
        values: Float[Tensor, "P C"],
        weight: Float[Tensor, "C K"],
        sources: Int[Tensor, "Q T"],
        targets: Int[Tensor, "P T"],
    ) -> Float[Tensor, "Q D"]:
        count, channels = len(values), weight.shape[1] // _TAPS
        products = values.new_empty(count * _TAPS + 1, channels)
        torch.mm(values, weight, out=products[:-1].view(count, weight.shape[1]))
        products[-1] = 0.0  # contribution of the background
        context.save_for_backward(values, weight, targets)
        return functional.embedding_bag(sources, products, mode="sum")

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        values, weight, targets = context.saved_tensors
        (gradient,) = gradients
        padded = gradient.new_empty(len(gradient) + 1, gradient.shape[1])
        padded[:-1], padded[-1] = gradient, 0.0
        products = padded.index_select(0, targets.view(-1)).view(len(values), weight.shape[1])
        return products @ weight.t(), values.t() @ products, None, None


def _normalize(features: SparseFeatures, layer: nn.BatchNorm2d) -> SparseFeatures:
    """Batch normalization over all pixels, including the background."""
    pixels, values, background = features
    assert layer.running_mean is not None and layer.running_var is not None
    if layer.training:
        total = pixels.size
        offset = values.sum(0) / total  # mean relative to the background
        rest = (total - len(values)) / total
        variance = (values - offset).square().sum(0) / total + rest * offset.square()
        with torch.no_grad():
            assert layer.momentum is not None and layer.num_batches_tracked is not None
            layer.running_mean.lerp_(background + offset, layer.momentum)
            layer.running_var.lerp_(variance * (total / (total - 1)), layer.momentum)
            layer.num_batches_tracked += 1
    else:
        offset, variance = layer.running_mean - background, layer.running_var
    scale = layer.weight * torch.rsqrt(variance + layer.eps)
    # Batch statistics cancel the background, but several devices expect a zero gradient, not none.
    shift = layer.bias - offset * scale + 0.0 * background
    return SparseFeatures(pixels, values * scale, shift)


def _pool(features: SparseFeatures) -> SparseFeatures:
    """2x2 max-pooling."""
    pixels, sources = _pair(features.pixels, len(features.values))
    values = torch.cat([features.values, features.values.new_zeros(1, features.values.shape[1])])
    fours = values.index_select(0, torch.from_numpy(sources).view(-1)).view(len(sources), 4, values.shape[1])
    return SparseFeatures(pixels, fours.amax(1), features.background)


@kernel
def _connect(
    pixels: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Connect P inputs (B, S, S), -1 for background, of a 3x3 convolution with its outputs.

    Returns:
        Rows of the outputs (B, S - 2, S - 2), -1 for background; the products (row x 9 + tap) that each of
        the Q outputs sums (Q, 9), P x 9 for a product with the background; and the output to which each
        product contributes (P, 9), Q outside of the image.
    """
    batch, size = len(pixels), pixels.shape[1] - 2
    reached = np.full((batch, size, size), -1, np.int32)
    sources = np.full((min(batch * size * size, count * 9), 9), count * 9, np.int32)
    targets = np.full((count, 9), -1, np.int32)
    outputs = 0
    for image in range(batch):
        for row in range(size):
            for column in range(size):
                for tap in range(9):
                    source = pixels[image, row + tap // 3, column + tap % 3]
                    if source >= 0:
                        if reached[image, row, column] < 0:
                            reached[image, row, column] = outputs
                            outputs += 1
                        sources[outputs - 1, tap] = source * 9 + tap
                        targets[source, tap] = outputs - 1
    for source in range(count):
        for tap in range(9):
            if targets[source, tap] < 0:
                targets[source, tap] = outputs
    return reached, sources[:outputs], targets


@kernel
def _pair(pixels: NDArray[np.int32], count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Connect P inputs (B, S, S), -1 for background, of a 2x2 pooling with its outputs.

    Returns:
        Rows of the outputs (B, S / 2, S / 2), -1 for background, and the inputs (Q, 4) of each of the Q
        outputs, P for background.
    """
    batch, size = len(pixels), pixels.shape[1] // 2
    reached = np.full((batch, size, size), -1, np.int32)
    sources = np.full((min(count, batch * size * size), 4), count, np.int32)
    outputs = 0
    for image in range(batch):
        for row in range(size):
            for column in range(size):
                for part in range(4):
                    source = pixels[image, 2 * row + part // 2, 2 * column + part % 2]
                    if source >= 0:
                        if reached[image, row, column] < 0:
                            reached[image, row, column] = outputs
                            outputs += 1
                        sources[outputs - 1, part] = source
    return reached, sources[:outputs]


class DeepLabelCNN(nn.Module):
    """Positions of a layout's markers from sparse 52×52 depth images."""

    def __init__(self, config: CNNConfig) -> None:
        super().__init__()
        self.config = config
        self.mean_hand = _MeanHandBuffers(config.num_labels)
        self.features = nn.Sequential(
            *_filters(1, 64),
            *_filters(64, 64),
            nn.MaxPool2d(2),
            *_filters(64, 128),
            *_filters(128, 128),
            *_filters(128, 128),
            nn.MaxPool2d(2),
        )
        self.positions = nn.Sequential(
            nn.Flatten(),
            nn.Linear(128 * 9 * 9, 2048),
            nn.ReLU(inplace=True),
            nn.Linear(2048, config.num_labels * 3),
        )

    def forward(self, images: Float[Tensor, "B 1 52 52"]) -> Float[Tensor, "B M 3"]:
        """Positions of all markers in view units, including occluded ones."""
        if _computes_sparsely(images):
            layers = list(self.features)
            features = filter_sparse(images, layers[:_NUM_SPARSE]).dense()
            for layer in layers[_NUM_SPARSE:]:
                features = layer(features)
            positions: Tensor = self.positions(features)
        else:
            positions = self.positions(self.features(images.contiguous(memory_format=torch.channels_last)))
        return positions.view(-1, self.config.num_labels, 3)


class _MeanHandBuffers(nn.Module):
    """A `MeanHand` that is saved with the weights."""

    def __init__(self, num_labels: int) -> None:
        super().__init__()
        self.register_buffer("markers", torch.zeros(num_labels, 3))
        self.register_buffer("moments", torch.zeros(NUM_MOMENTS))
        self.register_buffer("precision", torch.zeros(NUM_MOMENTS, NUM_MOMENTS))

    def set(self, hand: MeanHand) -> None:
        for name, tensor in self.named_buffers():
            tensor.copy_(torch.from_numpy(getattr(hand, name)))

    def get(self) -> MeanHand:
        return MeanHand(*(tensor.double().cpu().numpy() for tensor in self.buffers()))


def _computes_sparsely(images: Tensor) -> bool:
    """Whether to use sparse filters: on a CPU, in 32 bits, except for exports."""
    return not (images.is_cuda or torch.is_autocast_enabled("cpu") or torch.jit.is_tracing())  # type: ignore[no-untyped-call, attr-defined]


def _filters(channels_in: int, channels_out: int) -> tuple[nn.Module, ...]:
    """Conv + BN + ReLU of Table 1."""
    return nn.Conv2d(channels_in, channels_out, 3), nn.BatchNorm2d(channels_out), nn.ReLU(inplace=True)


def cnn_loss(
    network: nn.Module,
    batch: Batch,
    device: torch.device,
    config: TrainSettings,
    *,
    rng: np.random.Generator,
    part: Part,
) -> Tensor:
    """Loss of a part of a batch, with a random view for each cloud (section 3.1 of the paper)."""
    points, present = batch.cloud.points, batch.cloud.present
    if config.cnn.views == "aligned":
        hand = network.mean_hand.get()  # type: ignore[operator, union-attr]
        views = hand.training_views(points, present, batch.markers, rng=rng)
    else:
        views = random_views(len(points), rng=rng)
    mine = part.of(batch)
    images, frames = depth_images(mine.cloud.points, mine.cloud.present, views[part.first :: part.count])
    targets = torch.from_numpy(frames.normalize(mine.markers).astype(np.float32)).to(device)
    seen = torch.from_numpy(images)[:, None].to(device)
    return mine.weights.clouds * functional.smooth_l1_loss(network(seen), targets, beta=config.knee)
