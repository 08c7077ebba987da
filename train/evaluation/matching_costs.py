"""The costs with which the paper's network matches points, chosen on held-out simulated frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from train.config import CNNConfig
from train.evaluation.labeler_evaluation import Report, paper_report
from train.labelers.cnn_labeler import label_by_distance
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.kinds import cnn_labeler
from train.labelers.protocol import Labeling

_REJECTS: Final = (0.015, 0.02, 0.03, 0.04, 0.06, 0.08)  # [m]
_SPREADS: Final = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012)  # [m]


def choose_costs(network: DeepLabelCNN, marker_names: tuple[str, ...], rows: NDArray[np.void]) -> CNNConfig:
    """The network's settings with the reject that labels most slots right, and the best calibrated spread.

    Settings that the network has already are kept.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
        rows: A few hundred held-out rows of a training set; they get the paper's corruption.
    """
    labeler = _Recalling(network, marker_names)

    def report(reject: float, spread: float) -> Report:
        labeler.reject, labeler.spread = reject, spread
        return paper_report(labeler, rows)

    config = network.config
    reject = config.reject or max(
        _REJECTS, key=lambda tried: report(tried, _SPREADS[0]).figures["slot_accuracy"]
    )
    spread = config.spread or min(
        _SPREADS, key=lambda tried: report(reject, tried).figures["calibration_error"]
    )
    network.config = dataclasses.replace(config, reject=reject, spread=spread)
    return network.config


class _Recalling:
    """A labeler that runs its network once: later calls label the same frames with other costs."""

    def __init__(self, network: DeepLabelCNN, marker_names: tuple[str, ...]) -> None:
        self.marker_names = marker_names
        self.reject = self.spread = 0.0
        self._labeler = cnn_labeler(network, marker_names)
        self._distances: list[NDArray[np.float64]] = []

    def label_frames(self, frames: Sequence[NDArray[np.float64]]) -> list[Labeling]:
        """Label the frames that were given first."""
        self._distances = self._distances or self._labeler.distances(list(frames))
        return [label_by_distance(distances, self.reject, self.spread) for distances in self._distances]
