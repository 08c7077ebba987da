"""A hand does not differ from itself, and what differs is told where it does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.paper.hand_errors import hand_errors
from gloves import GloveFit, load_layout
from gloves.fit import attach_markers, nominal_fit
from handsim import HandModel, sample_shape
from handsim.errors import ArgumentError
from handsim.hand.shape import PALM, SIDES


def worn(shape):
    model = HandModel(shape)
    return GloveFit(model, attach_markers(load_layout("dense19"), model))


@pytest.mark.parametrize("side", SIDES)
def test_what_differs_is_told(side, rng):
    true = worn(sample_shape(side=side, rng=rng))
    assert max(np.abs(part).max() for part in hand_errors(true, true)) < 1e-12
    lengths = true.model.shape.bone_lengths.copy()
    lengths[2, 1] *= 1.1
    shape = dataclasses.replace(true.model.shape, bone_lengths=lengths)
    points = true.attachment.points.copy()
    points[0] += (0.0, 0.003, 0.0)
    found = GloveFit(HandModel(shape), dataclasses.replace(true.attachment, points=points))
    errors = hand_errors(found, true)
    assert errors.lengths[2, 1] == pytest.approx(0.1)
    assert np.abs(np.delete(errors.lengths.ravel(), 5)).max() < 1e-12
    assert errors.positions[0] == pytest.approx(0.003)


def test_a_palm_that_lies_elsewhere_is_laid_back(rng):
    true = worn(sample_shape(rng=rng))
    shift = np.array([0.004, -0.002, 0.001])
    shape = dataclasses.replace(true.model.shape, knuckles=true.model.shape.knuckles + shift)
    found = GloveFit(
        HandModel(shape), dataclasses.replace(true.attachment, points=true.attachment.points + shift)
    )
    errors = hand_errors(found, true)
    palm = true.attachment.bone_indices[:, 0] == PALM
    assert errors.positions.max() < 1e-12
    np.testing.assert_allclose(errors.wrist_positions[palm], np.linalg.norm(shift))


def test_other_hands_are_told():
    layout = load_layout("dense19")
    with pytest.raises(ArgumentError, match="expected two of the same"):
        hand_errors(nominal_fit(layout, "M", "left"), nominal_fit(layout, "M", "right"))
