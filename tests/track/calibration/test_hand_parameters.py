"""A shape's parameters make valid hands, and skinned points follow them as their jacobians say."""

from __future__ import annotations

import dataclasses

import numpy as np

from gloves.fit import attach_markers
from gloves.layout import load_layout
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import sample_shape
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles
from track.calibration.hand_parameters import (
    NUM_PARAMETERS,
    shape_at,
    shape_jacobian,
    shape_precision,
    skeleton_jacobian,
    skinned_shape_jacobian,
    skinning_terms,
)
from track.calibration.skin_coordinates import nearest_coordinates, skin_weights


def test_no_change_is_the_first_hand(rng):
    shape = sample_shape(rng=rng)
    again = shape_at(shape, np.zeros(NUM_PARAMETERS))
    for field in dataclasses.fields(shape):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(shape, field.name))


def test_people_differ_by_what_the_prior_says(rng):
    covariance = np.linalg.inv(shape_precision())
    for draw in rng.multivariate_normal(np.zeros(NUM_PARAMETERS), covariance, size=20):
        HandModel(shape_at(sample_shape(rng=rng), draw))  # raises for what is no hand
    whole = np.sqrt(covariance[0, 0] + covariance[2, 2])
    assert 0.08 < whole < 0.15  # log length of a bone


def skeleton_of(shape):
    """What of a shape determines its skeleton, in the order of `skeleton_jacobian`."""
    return np.concatenate([shape.bone_lengths, shape.knuckles, shape.base_angles]).ravel()


def test_the_skeleton_follows_the_parameters(rng):
    shape, here = sample_shape(rng=rng), 0.02 * rng.standard_normal(NUM_PARAMETERS)
    quotient = shape_jacobian(shape, here, lambda hands: np.array([skeleton_of(hand) for hand in hands]))
    np.testing.assert_allclose(skeleton_jacobian(shape, here), quotient, atol=2e-6)


def test_points_follow_the_skeleton(rng):
    shape = sample_shape(rng=rng)
    model = HandModel(shape)
    worn = attach_markers(load_layout("dense19"), model)
    weights = skin_weights(nearest_coordinates(worn.points, shape))
    qpos = join_qpos(
        sample_valid_angles(model, 4, rng=rng),
        position=rng.normal(size=(4, 3)),
        quaternion=random_quaternions(4, rng=rng),
    )

    def placed(numbers):
        lengths, knuckles, angles = numbers.reshape(3, 5, 3)
        changed = dataclasses.replace(shape, bone_lengths=lengths, knuckles=knuckles, base_angles=angles)
        other = HandModel(changed)
        carried = skinning_terms(other, other.forward_kinematics(qpos), worn.points, weights)[1]
        return np.einsum("ml,tmli->tmi", weights, carried)

    jacobian = skinned_shape_jacobian(model, model.forward_kinematics(qpos), worn.points, weights)
    here, step = skeleton_of(shape), 1e-6
    for number, nudge in enumerate(step * np.eye(len(here))):
        quotient = (placed(here + nudge) - placed(here - nudge)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., number], quotient, atol=1e-7)


def test_jacobian_of_a_linear_function(rng):
    shape = sample_shape(rng=rng)
    jacobian = shape_jacobian(
        shape, np.zeros(NUM_PARAMETERS), lambda hands: np.array([hand.knuckles.ravel() for hand in hands])
    )
    np.testing.assert_allclose(jacobian[:, 17:32], np.eye(15), atol=1e-9)
    np.testing.assert_allclose(jacobian[::3, 0], shape.knuckles[:, 0], rtol=1e-4)
