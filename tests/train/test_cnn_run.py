"""A run of the paper's network: it learns, stops and goes on, and the labeler uses what training used."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from train import CNNConfig, Corruption, evaluate_labeler, load_labeler, train_labeler
from train.labelers.storage import CARD, WEIGHTS, load_network
from train.settings import usual_settings

CONFIG = dataclasses.replace(usual_settings("cnn"), samples=48, batch=16, average_every=2, precision="32")

FIXED = dataclasses.replace(CONFIG, cnn=CNNConfig(reject=0.04, spread=0.005))
"""Without the choice of these two, which takes as long as many steps."""


@pytest.mark.slow
def test_a_run_that_was_stopped_is_the_run_that_was_not(dataset, tmp_path):
    class Stopped(Exception):
        pass

    def stop(done, total):
        if done == 2 * CONFIG.batch:
            raise Stopped

    train_labeler(dataset, tmp_path / "whole", FIXED)
    with pytest.raises(Stopped):  # after the first checkpoint, before the second
        train_labeler(dataset, tmp_path / "stopped", FIXED, progress=stop, save_every=0.0)
    train_labeler(dataset, tmp_path / "stopped", FIXED)
    whole, stopped = (load_network(tmp_path / name)[0].state_dict() for name in ("whole", "stopped"))
    for name, values in whole.items():
        assert torch.equal(values, stopped[name]), name
    assert whole["mean_hand.markers"].std() > 0.01


def test_what_training_used_is_saved_with_the_network(dataset, tmp_path):
    config = dataclasses.replace(CONFIG, samples=16, cnn=CNNConfig(views="random", reject=0.033))
    train_labeler(dataset, tmp_path, config)
    card = json.loads((tmp_path / CARD).read_text())
    assert card["labeler"] == "cnn"
    assert card["network"]["views"] == "random" and card["network"]["reject"] == 0.033
    assert card["network"]["spread"] > 0.0, "chosen on held-out frames"
    assert card["curve"][-1][0] == 16
    network, _ = load_network(tmp_path)
    assert network.config == CNNConfig(**card["network"])
    assert (tmp_path / WEIGHTS).stat().st_size > 80e6
    assert load_labeler(tmp_path).marker_names == dataset.marker_names


@pytest.mark.slow
def test_a_minute_of_training_labels_three_times_as_much_as_chance(dataset, tmp_path):
    recipe = {"learning_rate": 5e-4, "anisotropy": 0.0, "occlude": 0, "ghosts": 0}
    train_labeler(dataset, tmp_path, dataclasses.replace(FIXED, samples=960, **recipe))
    markers = dataset.rows()[:24]["markers"].astype(np.float64)
    report = evaluate_labeler(load_labeler(tmp_path), markers, Corruption(0, 0), rng=np.random.default_rng(0))
    assert report.figures["slot_accuracy"] > 3.0 / markers.shape[1]
