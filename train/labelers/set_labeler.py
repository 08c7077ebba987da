"""The set labeler with weights, and its loss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from train.data.batches import Batch
from train.labelers.batch_network import BatchNetwork
from train.labelers.protocol import Labeling, label_by_scores, label_in_batches, pad_clouds
from train.labelers.set_inference import CloudScorer
from train.labelers.set_network import SetLabeler, labeling_loss
from train.matching.pose_prior import PosePrior


class TrainedSetLabeler:
    """The set labeler with weights, ready to use.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
    """

    def __init__(self, network: SetLabeler, marker_names: tuple[str, ...]) -> None:
        self.network = network.eval()
        self.marker_names = marker_names
        self._batches = BatchNetwork(self.network)
        self._scorer: CloudScorer | None = None  # made for the first cloud that comes alone

    @property
    def prior(self) -> PosePrior | None:
        """What it knows of hands as wholes."""
        return self.network.prior

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self._label)

    @torch.inference_mode()
    def _label(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        if len(clouds) == 1:
            if self._scorer is None:
                self._scorer = CloudScorer(self.network)
            by_point, by_label = self._scorer.score(clouds[0])
            return label_by_scores(clouds, by_point[None], by_label[None], self.network.prior)
        points, present = pad_clouds(clouds)
        scores = self._batches(torch.from_numpy(points), torch.from_numpy(present))
        by_point, by_label = scores.points.cpu().numpy(), scores.labels.cpu().numpy()
        return label_by_scores(clouds, by_point, by_label, self.network.prior)


def set_loss(network: torch.nn.Module, batch: Batch, device: torch.device) -> torch.Tensor:
    """Loss of one batch, see `train.labelers.set_network.labeling_loss`."""
    cloud = batch.cloud
    points = torch.from_numpy(cloud.points.astype(np.float32)).to(device)
    present, truth = torch.from_numpy(cloud.present).to(device), torch.from_numpy(cloud.truth).to(device)
    return labeling_loss(network(points, present), truth, present, weights=batch.weights)
