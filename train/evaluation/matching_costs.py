"""The costs with which the paper's network matches points, chosen on held-out simulated frames."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Final

from train.config import CNNConfig
from train.evaluation.labeler_evaluation import Report, paper_report
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.kinds import cnn_labeler

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_REJECTS: Final = (0.015, 0.02, 0.03, 0.04, 0.06, 0.08)  # [m]
_SPREADS: Final = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012)  # [m]
_FRAMES: Final = 400


def choose_costs(network: DeepLabelCNN, marker_names: tuple[str, ...], rows: NDArray[np.void]) -> CNNConfig:
    """The network's settings with the reject that labels most slots right, and the best calibrated spread.

    Settings that the network has already are kept.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
        rows: Held-out rows of a training set; they get the paper's corruption.
    """
    few = rows[:: -(-len(rows) // _FRAMES)]

    def report(config: CNNConfig) -> Report:
        network.config = config
        return paper_report(cnn_labeler(network, marker_names), few)

    config = network.config
    if config.reject is None:
        tried = [dataclasses.replace(config, reject=reject) for reject in _REJECTS]
        config = max(tried, key=lambda chosen: report(chosen).figures["slot_accuracy"])
    if config.spread is None:
        tried = [dataclasses.replace(config, spread=spread) for spread in _SPREADS]
        config = min(tried, key=lambda chosen: report(chosen).figures["calibration_error"])
    network.config = config
    return config
