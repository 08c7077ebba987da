"""The network that batches go through: a copy on a GPU where there is one, else the network itself."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn

from train.threads import labeling_threads


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
