"""A labeler for any layout, without training: one network that takes the layout as an input.

What it must know of a layout comes from a few seconds of simulation: the distribution of the distance between
every two markers over people and poses, and the pose prior (`train.matching.pose_prior`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gloves.layout import MarkerLayout
from handsim._version import __version__
from handsim.errors import WeightsError
from handsim.files.atomic import atomic_write
from handsim.files.json_files import save_json
from train.any_layout.layout_network import LayoutNetwork, LayoutNetworkConfig, distance_features
from train.any_layout.worn_markers import sample_worn_markers
from train.labelers.protocol import Labeling, label_by_scores, label_in_batches, pad_clouds
from train.matching.pose_prior import PosePrior
from train.matching.prior_learning import learn_pose_prior
from train.threads import labeling_threads

NUM_POSES: Final = 40_000
"""Poses from which a layout is known; fewer make a coarser pose prior."""
WEIGHTS, CARD = "any_layout.safetensors", "any_layout.json"
_SHIPPED: Final = Path(__file__).parents[1] / "weights"
_CHUNK: Final = 500  # poses


class LayoutLabeler:
    """Labels a glove that no network was trained on.

    Args:
        layout: The glove.
        network: The network; the shipped one when not given.
        num_poses: Poses from which the layout is known.
        seed: Of those poses.

    Raises:
        LayoutError: A marker misses the skin.
    """

    def __init__(
        self,
        layout: MarkerLayout,
        network: LayoutNetwork | None = None,
        *,
        num_poses: int = NUM_POSES,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        markers = sample_worn_markers(layout, num_poses, rng=rng)
        self.network = (shipped_network() if network is None else network).eval()
        self.marker_names = layout.names
        self.prior: PosePrior | None = learn_pose_prior(markers, rng=rng)
        """What it knows of hands as wholes."""
        self.distances = mean_features(markers, self.network.config)[None]
        """What the network gets of the layout."""

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self._label)

    @torch.inference_mode()
    def _label(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        points, present = pad_clouds(clouds)
        with labeling_threads():
            scores = self.network(torch.from_numpy(points), torch.from_numpy(present), self.distances)[-1]
        return label_by_scores(clouds, scores.points.numpy(), scores.labels.numpy(), self.prior)


def mean_features(markers: Float[np.ndarray, "T M 3"], config: LayoutNetworkConfig) -> Float[Tensor, "M M K"]:
    """Mean over poses of the distance features between a layout's markers [m]."""
    centered = torch.from_numpy((markers - markers.mean(axis=1, keepdims=True)).astype(np.float32))
    sums = [
        distance_features(centered[first : first + _CHUNK], config).sum(0)
        for first in range(0, len(centered), _CHUNK)
    ]
    return torch.stack(sums).sum(0) / len(markers)


@cache
def shipped_network() -> LayoutNetwork:
    """The network that comes with handsim.

    Raises:
        WeightsError: Its files are missing or damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    network = LayoutNetwork(LayoutNetworkConfig())
    try:
        tensors = load_file(_SHIPPED / WEIGHTS)
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except (SafetensorError, OSError, RuntimeError) as error:
        raise WeightsError(
            f"{_SHIPPED / WEIGHTS} is missing or damaged; install handsim again ({error})"
        ) from error
    return network


def save_layout_network(folder: Path, network: LayoutNetwork, num_clouds: int) -> None:
    """Write the network in half precision, and its card."""
    from safetensors.torch import save

    tensors = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    card = {
        "network": dataclasses.asdict(network.config),
        "clouds": num_clouds,
        "trained_on": "simulated poses in random layouts",
        "handsim": __version__,
        "license": "apache-2.0",
    }
    with atomic_write(folder / WEIGHTS) as temporary:
        temporary.write_bytes(save(tensors))
    save_json(folder / CARD, card)
