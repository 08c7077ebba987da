"""A simulated calibration capture holds what the user is asked for: motion, and touches of every finger."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.fit import attach
from gloves.layout import load_layout
from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel
from poses.shapes import is_valid
from poses.touch import FINGERS, is_touching
from train.simulation import scenes
from train.simulation.scenes import CalibrationTakeConfig, calibration_angles
from train.simulation.takes import simulate_calibration

SHORT = CalibrationTakeConfig(free=1.0, rounds=1)


def test_the_thumb_touches_every_finger(rng):
    model = HandModel.named("M")
    angles = calibration_angles(model, SHORT, rng=rng)
    assert is_valid(model, angles).all()
    for finger in FINGERS:
        assert is_touching(model, angles, finger).any()


def test_a_take_of_both_hands_has_its_truth(rng):
    hands = [HandModel.named("M", side=side) for side in ("right", "left")]
    fits = tuple(attach(load_layout("dense19"), hand) for hand in hands)
    take = simulate_calibration(fits, CalibrationTakeConfig(free=0.5, rounds=0), rng=rng)
    assert [hand.side for hand in take.hands] == ["right", "left"]
    assert take.settings["kind"] == "calibration"
    assert take.markers_present().mean() > 0.9
    for label, hand, fit in zip(take.hand_labels, take.moving_hands(), fits, strict=True):
        off = take.observed(label) - fit.markers(hand.qpos)[0]
        assert np.nanmedian(np.linalg.norm(off, axis=-1)) < 0.0005
    middles = [np.nanmedian(take.observed(label), axis=(0, 1)) for label in take.hand_labels]
    assert np.linalg.norm(middles[0] - middles[1]) > 0.2


def test_only_touches_out_of_reach_are_left_out(rng, monkeypatch):
    model, touching_angles = HandModel.named("M"), scenes.touching_angles

    def without_the_ring_finger(model, finger, start):
        if finger == "ring":
            raise PoseError("out of reach")
        return touching_angles(model, finger, start)

    monkeypatch.setattr(scenes, "touching_angles", without_the_ring_finger)
    angles = calibration_angles(model, SHORT, rng=rng)
    assert is_touching(model, angles, "index").any()

    def broken(model, finger, start):
        raise ArgumentError("start has shape (3,), expected (..., 20)")

    monkeypatch.setattr(scenes, "touching_angles", broken)
    with pytest.raises(ArgumentError, match="start has shape"):
        calibration_angles(model, SHORT, rng=rng)


def test_bad_values_are_told(rng):
    with pytest.raises(ArgumentError, match="free is 0, expected a number above 0"):
        CalibrationTakeConfig(free=0.0)
    with pytest.raises(ArgumentError, match="expected 0 or more"):
        CalibrationTakeConfig(rounds=-1)
    with pytest.raises(ArgumentError, match="0 hands, expected one or two"):
        simulate_calibration((), SHORT, rng=rng)
