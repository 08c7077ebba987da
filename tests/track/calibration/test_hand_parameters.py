"""A shape's parameters make valid hands, and skinned points follow them as their jacobians say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.people import displace_markers
from gloves import MarkerLayout, MarkerPlace, load_layout
from gloves.fit import attach_markers, settle_glove
from handsim import HandModel, join_qpos, sample_shape
from handsim.hand.shape import DIGIT_OF_BONE, DIGITS, named_shape, shape_from_measures
from handsim.space.transforms import random_quaternions
from track.calibration.hand_parameters import (
    NUM_PARAMETERS,
    SkinPatch,
    attachment_at,
    build_skin,
    nearest_coordinates,
    project_onto_skin,
    shape_at,
    shape_jacobian,
    shape_precision,
    skin_mesh,
    skin_points,
    skin_weight_jacobian,
    skin_weights,
    skinned_shape_jacobian,
    skinning_terms,
)


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


def test_jacobian_of_a_linear_function(rng):
    shape = sample_shape(rng=rng)
    jacobian = shape_jacobian(
        shape, np.zeros(NUM_PARAMETERS), lambda hands: np.array([hand.knuckles.ravel() for hand in hands])
    )
    np.testing.assert_allclose(jacobian[:, 17:32], np.eye(15), atol=1e-9)
    np.testing.assert_allclose(jacobian[::3, 0], shape.knuckles[:, 0], rtol=1e-4)


@pytest.mark.parametrize("arch", [[0.0, 0.0], [0.2, 0.6]])
def test_skinned_points_follow_the_parameters(arch, rng):
    covariance = np.linalg.inv(shape_precision())
    parameters = rng.multivariate_normal(np.zeros(NUM_PARAMETERS), covariance)
    start = dataclasses.replace(sample_shape(rng=rng), arch=arch)
    qpos = join_qpos(rng.uniform(-0.3, 1.2, (3, 20)), quaternion=random_quaternions(3, rng=rng))
    points, weights = rng.uniform(-0.1, 0.1, (5, 3)), rng.dirichlet(np.ones(16), 5)

    def skinned(shapes):
        return np.array([skinned_points(HandModel(shape))[0] for shape in shapes])

    def skinned_points(model):
        bones = model.forward_kinematics(qpos)
        by_bone = skinning_terms(model, bones, points, weights)[1]
        return np.einsum("ml,tmli->tmi", weights, by_bone), bones, by_bone

    model = HandModel(shape_at(start, parameters))
    _, bones, by_bone = skinned_points(model)
    exact = skinned_shape_jacobian(model, parameters, bones, points, weights, by_bone)
    np.testing.assert_allclose(exact, shape_jacobian(start, parameters, skinned), atol=5e-6)


def points_of(coordinates, shape):
    return skin_points(coordinates, SkinPatch(coordinates.faces).corners(HandModel(shape).surface.vertices))


def dense_weights(worn):
    weights = np.zeros((len(worn.points), 16))
    np.add.at(weights, (np.arange(len(weights))[:, None], worn.bone_indices), worn.bone_weights)
    return weights


def test_neighbors_share_an_edge():
    mesh = skin_mesh()
    for corner in range(3):
        other = mesh.faces[mesh.adjacent[:, corner]]
        same = (other[:, :, None] == mesh.faces[:, None, :]).any(axis=1)
        assert (same.sum(axis=1) == 2).all()
        assert not same[:, corner].any()


def test_a_glove_is_found_where_it_sits(rng):
    shape = sample_shape(rng=rng)
    worn = attach_markers(load_layout("dense19"), HandModel(shape))
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, shape)
    points, normals = points_of(coordinates, shape)
    np.testing.assert_allclose(points, worn.points, atol=1e-9)
    assert (normals * worn.normals).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(coordinates.heights, worn.layout.radius, atol=3e-4)
    again = attachment_at(worn.layout, coordinates, shape)
    np.testing.assert_allclose(dense_weights(again), dense_weights(worn), atol=0.03)


@pytest.mark.parametrize("length", [0.175, 0.187, 0.199])
def test_a_marker_between_two_fingers_is_found_on_its_own(length):
    turns = np.deg2rad([90.0, -90.0])
    sides = [(name, part, turn) for name in DIGITS[1:] for part in ("proximal", "middle") for turn in turns]
    places = [
        MarkerPlace(f"M{number}", f"{name}_{part}", 0.65, turn)
        for number, (name, part, turn) in enumerate(sides)
    ]
    model = HandModel(shape_from_measures(length, 0.086))
    worn = settle_glove(MarkerLayout("sides", tuple(places), 0.0032), model).attachment
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, model.shape)
    again = attachment_at(worn.layout, coordinates, model.shape)
    np.testing.assert_allclose(again.points, worn.points, atol=1e-6)
    own = [DIGITS.index(name) for name, _, _ in sides]
    np.testing.assert_array_equal(DIGIT_OF_BONE[again.main_bones], own)


def test_stalks_are_heights_above_the_skin(rng):
    shape, layout = sample_shape(rng=rng), load_layout("dense19")
    stalks = [dataclasses.replace(marker, height=rng.uniform(0.0, 0.012)) for marker in layout.markers]
    worn = attach_markers(dataclasses.replace(layout, markers=tuple(stalks)), HandModel(shape))
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, shape)
    np.testing.assert_allclose(points_of(coordinates, shape)[0], worn.points, atol=1e-9)
    np.testing.assert_allclose(coordinates.heights, worn.layout.heights, atol=1e-3)
    moved = displace_markers(worn, shape, 0.0, rng=rng)
    np.testing.assert_allclose(moved.points, worn.points, atol=1e-3)


def test_slides_end_under_their_points(rng):
    shape = sample_shape(rng=rng)
    worn = attach_markers(load_layout("dense19"), HandModel(shape))
    moved = displace_markers(worn, shape, 0.005, rng=rng)
    coordinates = project_onto_skin(
        nearest_coordinates(worn.points, worn.feet, worn.main_bones, shape), moved.points, build_skin(shape)
    )
    np.testing.assert_allclose(points_of(coordinates, shape)[0], moved.points, atol=1e-9)
    np.testing.assert_allclose(coordinates.heights, worn.layout.radius, atol=1e-9)
    distance = np.linalg.norm(moved.points - worn.points, axis=1)
    assert 0.0035 < distance.min() <= distance.max() < 0.0055


def test_points_go_with_the_skin():
    small, large = named_shape("XS"), named_shape("XL")
    worn = attach_markers(load_layout("dense19"), HandModel(small))
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, small)
    there = attach_markers(load_layout("dense19"), HandModel(large)).points
    assert np.linalg.norm(points_of(coordinates, large)[0] - there, axis=1).max() < 0.003


def test_weights_change_as_their_jacobian_say(rng):
    shape = sample_shape(rng=rng)
    worn = attach_markers(load_layout("dense19"), HandModel(shape))
    coordinates = nearest_coordinates(worn.points, worn.feet, worn.main_bones, shape)
    jacobian = skin_weight_jacobian(coordinates, build_skin(shape).corners(coordinates.faces))
    points, step = points_of(coordinates, shape)[0], 1e-7
    for axis in np.eye(3):
        there = skin_weights(project_onto_skin(coordinates, points + step * axis, build_skin(shape)))
        np.testing.assert_allclose((there - skin_weights(coordinates)) / step, jacobian @ axis, atol=0.1)
