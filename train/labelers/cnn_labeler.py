"""The paper's network as a labeler, and its loss."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import torch

from train.data.batches import Batch
from train.labelers.cnn_network import REJECT, DeepLabelCNN, match_positions, position_loss
from train.labelers.depth_image import depth_images, view_rotations
from train.labelers.protocol import Labeling, label_in_batches, pad_clouds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from numpy.typing import NDArray

_SPREAD: Final = 0.002
"""Distance over which the confidence falls by a factor of e [m]; chosen, not calibrated."""


class TrainedCNNLabeler:
    """The paper's network with weights: the view of ten on which the cloud spreads best, then equation 1.

    The network is trained on right hands. Each cloud is labeled as it is and mirrored; the labels with the
    smaller total distance are kept.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
    """

    def __init__(self, network: DeepLabelCNN, marker_names: tuple[str, ...]) -> None:
        self.network = network.eval()
        self.marker_names = marker_names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self._label)

    def _label(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        points, present = pad_clouds(clouds)
        cloud = points.astype(np.float64)
        mirrored = cloud * (-1.0, 1.0, 1.0)
        predicted = self.predict(np.concatenate([cloud, mirrored]), np.concatenate([present, present]))
        labelings = []
        for row in range(len(clouds)):
            here = present[row]
            sides = (
                (cloud[row, here], predicted[row]),
                (mirrored[row, here], predicted[len(clouds) + row]),
            )
            labels = [match_positions(markers, points) for points, markers in sides]
            costs = [_costs(points, markers) for points, markers in sides]
            taken = [cost[np.arange(len(label)), label] for cost, label in zip(costs, labels, strict=True)]
            better = int(taken[1].sum() < taken[0].sum())
            labelings.append(Labeling(labels[better], _confidence(costs[better], taken[better])))
        return labelings

    @torch.inference_mode()
    def predict(self, points: Float[np.ndarray, "B N 3"], present: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Predicted marker positions (B, M, 3) [m] of right hands, in the frame of the points (B, N, 3)."""
        rng = np.random.default_rng(0)  # the same clouds get the same labels every time
        rotations = view_rotations(points, present, policy="random10", rng=rng)
        images, frames = depth_images(points, present, rotations)
        seen = torch.from_numpy(images)[:, None].to(memory_format=torch.channels_last)
        return frames.restore(self.network(seen).double().numpy())


def _costs(points: NDArray[np.float64], markers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (N, M + 1) of points from predicted markers [m], and last the cost of no label."""
    distances = np.linalg.norm(points[:, None] - markers[None], axis=-1)
    return np.concatenate([distances, np.full((len(points), 1), REJECT)], axis=1)


def _confidence(costs: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight of the label taken as a share of the weights of all labels of a point."""
    weights = np.exp(-costs / _SPREAD)
    shares: NDArray[np.float64] = np.exp(-taken / _SPREAD) / weights.sum(axis=1)
    return shares


def cnn_loss(
    network: torch.nn.Module, batch: Batch, device: torch.device, *, rng: np.random.Generator
) -> torch.Tensor:
    """Loss of one batch, each cloud seen from a random view (section 3.1 of the paper)."""
    points, present = batch.cloud.points, batch.cloud.present
    images, frames = depth_images(points, present, view_rotations(points, present, policy="random", rng=rng))
    targets = torch.from_numpy(frames.normalize(batch.markers).astype(np.float32)).to(device)
    seen = torch.from_numpy(images)[:, None].to(device, memory_format=torch.channels_last)
    known = torch.ones(targets.shape[:2], dtype=torch.bool, device=device)
    return position_loss(network(seen), targets, known)
