"""The kinds of network: how each is built, its loss, and how it becomes a labeler."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn

from train.config import Kind, SetLabelerConfig
from train.data.batches import Batch
from train.labelers.cnn_labeler import TrainedCNNLabeler, cnn_loss
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.protocol import Labeler
from train.labelers.set_labeler import TrainedSetLabeler, set_loss
from train.labelers.set_network import SetLabeler

if TYPE_CHECKING:
    import numpy as np


def new_network(kind: Kind, config: SetLabelerConfig) -> nn.Module:
    """An untrained network; the paper's uses only the number of labels of the config."""
    if kind == "cnn":
        network = DeepLabelCNN(config.num_labels)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]
    return SetLabeler(config)


def batch_loss(
    kind: Kind, network: nn.Module, batch: Batch, device: torch.device, *, rng: np.random.Generator
) -> torch.Tensor:
    """Loss of one batch, a scalar."""
    if kind == "cnn":
        return cnn_loss(network, batch, device, rng=rng)
    return set_loss(network, batch, device)


def labeler_of(network: nn.Module, marker_names: tuple[str, ...]) -> Labeler:
    """A trained network as a labeler."""
    if isinstance(network, DeepLabelCNN):
        return TrainedCNNLabeler(network, marker_names)
    assert isinstance(network, SetLabeler)
    return TrainedSetLabeler(network, marker_names)
