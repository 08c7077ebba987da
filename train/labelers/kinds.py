"""The kinds of network: how each is built, its loss, and how it becomes a labeler."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from train.config import CNNConfig, NetworkConfig, TrainConfig, batch_recipe
from train.data.batches import Batch, Part, draw_batch
from train.data.mapped_rows import MappedRows
from train.labelers.batch_network import BatchNetwork
from train.labelers.cnn_labeler import CNNLabeler
from train.labelers.cnn_network import DeepLabelCNN, cnn_loss
from train.labelers.protocol import Labeler
from train.labelers.set_labeler import TrainedSetLabeler
from train.labelers.set_network import SetLabeler, set_loss
from train.labelers.views import MeanHand

_PREPARED: Final = 20_000  # frames


def new_network(config: NetworkConfig) -> nn.Module:
    """An untrained network of the kind that its settings are for."""
    if isinstance(config, CNNConfig):
        network = DeepLabelCNN(config)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]
    return SetLabeler(config)


def prepare_network(network: nn.Module, rows: NDArray[np.void] | MappedRows) -> None:
    """Give an untrained network what it must know of a training set before the first step."""
    if isinstance(network, DeepLabelCNN):
        rng = np.random.default_rng(0)
        config = TrainConfig(batch=_PREPARED, rig_share=0.0, anisotropy=0.0)
        batch = draw_batch(rows, batch_recipe(config, network.config.num_labels), rng=rng)
        hand = MeanHand.of_clouds(batch.markers, batch.cloud.points, batch.cloud.present)
        network.mean_hand.set(hand)


def batch_loss(
    config: TrainConfig,
    network: nn.Module,
    batch: Batch,
    device: torch.device,
    *,
    rng: np.random.Generator,
    part: Part,
) -> torch.Tensor:
    """Loss of a part of one batch, a scalar; its mean over all parts is the loss of the batch.

    What is drawn is drawn for the whole batch, so that a cloud does not depend on the number of parts.
    """
    if config.labeler == "cnn":
        return cnn_loss(network, batch, device, config, rng=rng, part=part)
    return set_loss(network, part.of(batch), device)


def cnn_labeler(network: DeepLabelCNN, marker_names: tuple[str, ...]) -> CNNLabeler:
    """The paper's network with trained weights as a labeler."""
    batches = BatchNetwork(network.eval())

    @torch.inference_mode()
    def positions(images: NDArray[np.float32]) -> NDArray[np.float32]:
        predicted: NDArray[np.float32] = batches(torch.from_numpy(images)).cpu().numpy()
        return predicted

    return CNNLabeler(positions, network.mean_hand.get(), network.config, marker_names)


def labeler_of(network: nn.Module, marker_names: tuple[str, ...]) -> Labeler:
    """A trained network as a labeler."""
    if isinstance(network, DeepLabelCNN):
        return cnn_labeler(network, marker_names)
    assert isinstance(network, SetLabeler)
    return TrainedSetLabeler(network.config, network.numpy_weights(), network.prior, marker_names)
