"""Random valid poses: ours, and those of a user's own sampler."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from poses.shapes import (
    HIGH,
    LIBRARIES,
    LOW,
    gesture,
    gestures_of,
    load_gestures,
    sample_poses,
    sample_valid_angles,
    validate,
)


def test_poses_are_those_of_training_sets():
    model = HandModel.named("M")
    qpos = sample_poses(model, 40, rng=np.random.default_rng(3))
    angles = sample_valid_angles(model, 40, rng=np.random.default_rng(3))
    np.testing.assert_array_equal(qpos, join_qpos(angles))
    assert validate(model, qpos).all()


def test_a_user_brings_a_sampler(rng):
    def anywhere(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(LOW - 0.3, HIGH + 0.3, size=(num_poses, len(LOW)))

    model = HandModel.named("S", side="left")
    qpos = sample_poses(model, 50, anywhere, rng=rng)
    assert qpos.shape == (50, 27)
    assert validate(model, qpos).all()
    assert not validate(model, join_qpos(anywhere(model, 50, rng=rng))).any()


def test_validity_does_not_depend_on_the_wrist(rng):
    model = HandModel.named("L")
    qpos = join_qpos(rng.uniform(LOW, HIGH, size=(60, 20)))
    moved = qpos.copy()
    moved[:, :3], moved[:, 3:7] = rng.normal(size=(60, 3)), rng.normal(size=(60, 4))
    valid = validate(model, qpos)
    np.testing.assert_array_equal(validate(model, moved), valid)
    assert 0 < valid.sum() < len(valid)


def test_all_gestures_by_name():
    gestures = load_gestures()
    assert len(gestures) == sum(len(gestures_of(library)) for library in LIBRARIES)
    np.testing.assert_array_equal(gestures["fist"], gesture("fist"))
    gestures["fist"][:] = 0.0
    assert gesture("fist").any(), "the library keeps its own numbers"


def test_mistakes_are_named(rng):
    model = HandModel.named("M")
    with pytest.raises(ArgumentError, match="num_poses is 0, expected a positive number"):
        sample_poses(model, 0, rng=rng)
    with pytest.raises(
        ArgumentError, match=r"<lambda>' returns has shape \(2, 20\), expected \(3, 20\) joint angles"
    ):
        sample_poses(model, 3, lambda model, num_poses, *, rng: np.zeros((2, 20)), rng=rng)
    with pytest.raises(ArgumentError, match=r"qpos has shape \(1, 20\), expected \(..., any, 27\)"):
        validate(model, np.zeros((1, 20)))
