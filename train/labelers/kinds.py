"""The kinds of network: how each is built, its loss, and how it becomes a labeler.

Batches go through a copy on a GPU where there is one, else through the network itself.
"""

from __future__ import annotations

import copy
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from train.config import CNNConfig, NetworkConfig, TrainConfig, batch_recipe
from train.data.batches import Batch, Part, draw_batch
from train.data.shards import MappedRows
from train.labelers.cnn_labeler import CNNLabeler
from train.labelers.cnn_network import DeepLabelCNN, cnn_loss
from train.labelers.protocol import Labeler
from train.labelers.set_inference import TrainedSetLabeler
from train.labelers.set_network import SetLabeler, set_loss
from train.labelers.views import MeanHand
from train.threads import labeling_threads

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


def batch_device() -> torch.device:
    """Where batches are labeled."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class BatchNetwork:
    """A trained network for batches; a copy on a GPU is made for the first of them.

    Args:
        network: The network, on the CPU.
    """

    def __init__(self, network: nn.Module) -> None:
        self._network = network
        self._placed: tuple[nn.Module, torch.device] | None = None

    def __call__(self, *inputs: torch.Tensor) -> Any:
        """What the network makes of inputs on the CPU; its tensors stay on the network's device.

        A GPU computes in 32 bits too, so that labels are the CPU's but for ties in the last bits.
        """
        if self._placed is None:
            device, here = batch_device(), next(self._network.parameters()).device
            network = self._network if device == here else copy.deepcopy(self._network).to(device)
            self._placed = network, device
        network, device = self._placed
        with labeling_threads(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            return network(*(tensor.to(device) for tensor in inputs))
