"""The set labeler with weights, and its loss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from train.data.batches import Batch
from train.labelers.protocol import Labeling, check_clouds, check_output
from train.labelers.set_inference import CloudScorer
from train.labelers.set_network import SetLabeler, labeling_loss
from train.matching.pose_prior import PosePrior
from train.matching.verification import match_scores


class TrainedSetLabeler:
    """The set labeler with weights, ready to use.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
    """

    def __init__(self, network: SetLabeler, marker_names: tuple[str, ...]) -> None:
        self.network = network.eval()
        self.marker_names = marker_names
        self._scorer = CloudScorer(self.network)

    @property
    def prior(self) -> PosePrior | None:
        """What it knows of hands as wholes."""
        return self.network.prior

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return [self._label(cloud) for cloud in check_clouds(frames)]

    def _label(self, cloud: NDArray[np.float64]) -> Labeling:
        if not len(cloud):
            return Labeling(np.zeros(0, dtype=np.int64), np.zeros(0))
        by_point, by_label = self._scorer.score(cloud)
        check_output(by_label)
        return Labeling(*match_scores(cloud, by_point, by_label, self.network.prior))


def set_loss(network: torch.nn.Module, batch: Batch, device: torch.device) -> torch.Tensor:
    """Loss of one batch, see `train.labelers.set_network.labeling_loss`."""
    cloud = batch.cloud
    points = torch.from_numpy(cloud.points.astype(np.float32)).to(device)
    present, truth = torch.from_numpy(cloud.present).to(device), torch.from_numpy(cloud.truth).to(device)
    return labeling_loss(network(points, present), truth, present, weights=batch.weights)
