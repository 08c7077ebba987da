"""The paper's network: VGG-style, from a depth image to the position of each marker.

Han et al. 2018, Table 1. Its filters are valid (no padding): 52 → 50 → 48, pool 24 → 22 → 20 → 18, pool 9.
The outputs are positions in the image's view frame (`train.labelers.depth_image.ViewFrames`), in the
layout's marker order; labels come from matching them with the points (equation 1).
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from train.config import CNNConfig, TrainConfig
from train.data.batches import Batch, Part
from train.labelers.depth_image import depth_images
from train.labelers.sparse_convolution import filter_sparse
from train.labelers.views import NUM_MOMENTS, MeanHand, random_views

_SPARSE: Final = 10  # layers up to the third filter, which leave a large part of an image uniform


class DeepLabelCNN(nn.Module):
    """Positions of a layout's markers from sparse 52×52 depth images.

    Args:
        config: Markers of the layout, and how the network is used.
    """

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
        """Marker positions in view units, those of occluded markers too."""
        if _computes_sparsely(images):
            layers = list(self.features)
            features = filter_sparse(images, layers[:_SPARSE]).dense()
            for layer in layers[_SPARSE:]:
                features = layer(features)
            positions: Tensor = self.positions(features)
        else:
            positions = self.positions(self.features(images.contiguous(memory_format=torch.channels_last)))
        return positions.view(-1, self.config.num_labels, 3)


class _MeanHandBuffers(nn.Module):
    """A mean hand (`train.labelers.views.MeanHand`) that is saved with the weights."""

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
    """Whether images are filtered where they are not background: on a CPU, in 32 bits, not while exported."""
    return not (images.is_cuda or torch.is_autocast_enabled("cpu") or torch.jit.is_tracing())  # type: ignore[no-untyped-call, attr-defined]


def _filters(channels_in: int, channels_out: int) -> tuple[nn.Module, ...]:
    """Conv + BN + ReLU of Table 1."""
    return nn.Conv2d(channels_in, channels_out, 3), nn.BatchNorm2d(channels_out), nn.ReLU(inplace=True)


def position_loss(
    predicted: Float[Tensor, "B M 3"], targets: Float[Tensor, "B M 3"], *, knee: float = 1.0
) -> Tensor:
    """Smooth L1 distance, the mean over coordinates.

    Args:
        predicted: From `DeepLabelCNN`.
        targets: True positions in view units, those of occluded markers too.
        knee: Distance at which it turns from quadratic to linear [view unit]; the paper gives none, 1 is
            usual.
    """
    return functional.smooth_l1_loss(predicted, targets, beta=knee)


def cnn_loss(
    network: nn.Module,
    batch: Batch,
    device: torch.device,
    config: TrainConfig,
    *,
    rng: np.random.Generator,
    part: Part,
) -> Tensor:
    """Loss of a part of one batch, each cloud in a view of its own (section 3.1 of the paper)."""
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
    return mine.weights.clouds * position_loss(network(seen), targets, knee=config.knee)
