"""What a run ends with: the evaluated network, its card and a page."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from torch import nn

from handsim import __version__
from handsim.files.outputs import written_together
from train.config import CNNConfig, Kind, TrainConfig
from train.data.augmentation import Corruption
from train.data.batches import paper_corruption, right_hands
from train.data.shards import Manifest, MappedRows
from train.labeler_evaluation import Report, evaluate_markers, paper_report
from train.labelers.cnn_labeler import label_by_distance
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.kinds import cnn_labeler, labeler_of
from train.labelers.protocol import Labeling
from train.labelers.set_network import SetLabeler
from train.labelers.storage import save_network
from train.matching.prior_learning import learn_pose_prior
from train.reports.model_card import UNKNOWN_LICENSE, write_model_card
from train.reports.run_page import write_run_page
from train.training_state import TrainingState

MOST_HELD_OUT: Final = 8192
_CARD_FRAMES: Final[dict[Kind, int]] = {"set": MOST_HELD_OUT, "cnn": 1024}  # of the evaluation
_PRIOR_STRETCH: Final = 0.03  # anisotropy of the hands of the pose prior: people differ more than simulated
_COST_FRAMES: Final = 400  # for the costs of the paper's network
_REJECTS: Final = (0.015, 0.02, 0.03, 0.04, 0.06, 0.08)  # [m]
_SPREADS: Final = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012)  # [m]


def finish_run(
    state: TrainingState,
    rows: MappedRows,
    held_out: MappedRows,
    manifest: Manifest,
    out: Path,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Evaluate the network, write weights, card and page, and return the card.

    Args:
        rows: What it was trained on.
        held_out: What it has not seen.
        out: Folder of the run.
        tell: Called with the name of each step.
    """
    config, names = state.config, manifest.marker_names
    network = state.averaged()
    if isinstance(network, DeepLabelCNN):
        tell("costs of the paper's labeler")
        choose_costs(network, names, few(held_out, _COST_FRAMES))
    else:
        assert isinstance(network, SetLabeler)
        tell("pose prior")
        rng = np.random.default_rng(config.seed)
        network.prior = learn_pose_prior(right_hands(rows, _PRIOR_STRETCH, rng=rng), rng=rng)
    tell("held-out frames")
    card, report = _card(network, few(held_out, _CARD_FRAMES[config.labeler]), config, manifest)
    card["curve"] = state.history.accuracies
    tell("weights and report")
    with written_together():
        save_network(out, network, card)
        write_run_page(out, card, state.history, report)
        write_model_card(out, card)
    return card


def few(rows: MappedRows, count: int) -> NDArray[np.void]:
    """Every nth of these rows, at most `count`."""
    return rows[np.arange(0, len(rows), -(-len(rows) // count))]


def _card(
    network: nn.Module, rows: NDArray[np.void], config: TrainConfig, manifest: Manifest
) -> tuple[dict[str, Any], Report]:
    """Model card with figures on held-out simulated frames; the evaluation with the paper's corruption."""
    labeler = labeler_of(network, manifest.marker_names)
    markers = rows["markers"].astype(np.float64)
    clean = evaluate_markers(labeler, markers, Corruption(0, 0), rng=np.random.default_rng(0))
    paper, report = paper_corruption(markers.shape[1]), paper_report(labeler, rows)
    card = {
        "marker_names": list(manifest.marker_names),
        "trained_on": "simulated frames only",
        "handsim": __version__,
        "license": UNKNOWN_LICENSE,
        "dataset": manifest.config,
        "train": config.record(),
        "held_out_simulated": {
            "clean": clean.figures,
            f"occlude {paper.occlude}, ghosts {paper.ghosts}": report.figures,
        },
    }
    return card, report


def choose_costs(network: DeepLabelCNN, marker_names: tuple[str, ...], rows: NDArray[np.void]) -> CNNConfig:
    """The network's settings with the reject that labels most slots right, and the best calibrated spread.

    Settings that the network has already are kept.

    Args:
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
