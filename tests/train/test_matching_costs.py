"""The costs of the paper's network are the best of those that are tried."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from benchmarks.held_out import held_out_markers
from train import CNNConfig
from train.evaluation import paper_report
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.networks import cnn_labeler, prepare_network
from train.loop import choose_costs

NAMES = tuple(f"marker{label}" for label in range(19))


@pytest.fixture(scope="module")
def rows():
    markers = held_out_markers("dense19", 60, seed=4)
    rows = np.zeros(len(markers), dtype=[("markers", "f4", (19, 3)), ("hand", "u4")])
    rows["markers"] = markers
    return rows


@pytest.fixture(scope="module")
def network(rows):
    """A network that answers with the mean hand, so that some points are near their markers."""
    torch.manual_seed(0)
    network = DeepLabelCNN(CNNConfig(views="aligned")).eval()
    prepare_network(network, rows)
    last = network.positions[-1]
    torch.nn.init.zeros_(last.weight)
    markers = network.mean_hand.markers
    with torch.no_grad():
        last.bias.copy_((markers / markers.abs().max() * 0.8).flatten())
    return network


def test_no_other_costs_are_better(network, rows):
    few = rows[:4]
    network.config = CNNConfig()
    chosen = choose_costs(network, NAMES, few)
    assert network.config == chosen and None not in (chosen.reject, chosen.spread)

    def figures(**costs):
        network.config = dataclasses.replace(chosen, **costs)
        return paper_report(cnn_labeler(network, NAMES), few).figures

    best = figures()
    assert 0.1 < best["slot_accuracy"] < 1.0
    assert figures(reject=0.015)["slot_accuracy"] <= best["slot_accuracy"]
    assert figures(reject=0.08)["slot_accuracy"] <= best["slot_accuracy"]
    assert figures(spread=0.002)["calibration_error"] >= best["calibration_error"]
    assert figures(spread=0.012)["calibration_error"] >= best["calibration_error"]


def test_costs_that_are_given_are_kept(network, rows):
    network.config = CNNConfig(reject=0.033, spread=0.0071)
    assert choose_costs(network, NAMES, rows[:2]) == CNNConfig(reject=0.033, spread=0.0071)
