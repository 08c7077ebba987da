"""The set labeler with weights; without torch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from train.config import SetLabelerConfig
from train.labelers.protocol import Labeling, check_clouds, check_output
from train.labelers.set_inference import CloudScorer, Weights
from train.matching.pose_prior import PosePrior
from train.matching.verification import match_scores


class TrainedSetLabeler:
    """The set labeler with weights, ready to use.

    Args:
        config: Size of the network.
        weights: Its weights; later changes of them have no effect.
        prior: What it knows of hands as wholes.
        marker_names: Markers in label order.
    """

    def __init__(
        self,
        config: SetLabelerConfig,
        weights: Weights,
        prior: PosePrior | None,
        marker_names: tuple[str, ...],
    ) -> None:
        self.prior = prior
        self.marker_names = marker_names
        self._scorer = CloudScorer(config, weights)

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return [self._label(cloud) for cloud in check_clouds(frames)]

    def _label(self, cloud: NDArray[np.float64]) -> Labeling:
        if not len(cloud):
            return Labeling(np.zeros(0, dtype=np.int64), np.zeros(0))
        by_point, by_label = self._scorer.score(cloud)
        check_output(by_label)
        return Labeling(*match_scores(cloud, by_point, by_label, self.prior))
