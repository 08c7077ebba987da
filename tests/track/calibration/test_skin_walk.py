"""Places on the skin: found, walked between, carried along when the hand grows."""

from __future__ import annotations

import numpy as np

from gloves.attachment import attach_markers
from gloves.layout import load_layout
from handsim.hand.model import HandModel
from handsim.hand.shape import named_shape, sample_shape
from track.calibration.skin_walk import (
    SkinPatch,
    nearest_places,
    place_points,
    place_weights,
    skin_mesh,
    skin_of,
    slide,
    slip,
    wear_at,
    weight_slopes,
)


def points_of(places, shape):
    return place_points(places, SkinPatch(places.faces).corners(HandModel(shape).surface.vertices))


def dense_weights(worn):
    weights = np.zeros((len(worn.points), 16))
    np.add.at(weights, (np.arange(len(weights))[:, None], worn.bone_indices), worn.bone_weights)
    return weights


def test_neighbors_share_an_edge():
    mesh = skin_mesh()
    for corner in range(3):
        other = mesh.faces[mesh.across[:, corner]]
        same = (other[:, :, None] == mesh.faces[:, None, :]).any(axis=1)
        assert (same.sum(axis=1) == 2).all()
        assert not same[:, corner].any()


def test_a_glove_is_found_where_it_sits(rng):
    shape = sample_shape(rng=rng)
    worn = attach_markers(load_layout("dense19"), HandModel(shape))
    places = nearest_places(worn.points, shape)
    points, normals = points_of(places, shape)
    np.testing.assert_allclose(points, worn.points, atol=1e-9)
    assert (normals * worn.normals).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(places.heights, worn.layout.radius, atol=3e-4)
    again = wear_at(worn.layout, places, shape)
    np.testing.assert_allclose(dense_weights(again), dense_weights(worn), atol=0.03)


def test_slides_end_under_their_points(rng):
    shape = sample_shape(rng=rng)
    worn = attach_markers(load_layout("dense19"), HandModel(shape))
    moved = slip(worn, shape, 0.005, rng=rng)
    places = slide(nearest_places(worn.points, shape), moved.points, skin_of(shape))
    np.testing.assert_allclose(points_of(places, shape)[0], moved.points, atol=1e-9)
    np.testing.assert_allclose(places.heights, worn.layout.radius, atol=1e-9)
    distance = np.linalg.norm(moved.points - worn.points, axis=1)
    assert 0.0035 < distance.min() <= distance.max() < 0.0055


def test_places_go_with_the_skin():
    small, large = named_shape("XS"), named_shape("XL")
    worn = attach_markers(load_layout("dense19"), HandModel(small))
    places = nearest_places(worn.points, small)
    there = attach_markers(load_layout("dense19"), HandModel(large)).points
    assert np.linalg.norm(points_of(places, large)[0] - there, axis=1).max() < 0.003


def test_weights_change_as_their_slopes_say(rng):
    shape = sample_shape(rng=rng)
    places = nearest_places(attach_markers(load_layout("dense19"), HandModel(shape)).points, shape)
    slopes = weight_slopes(places, skin_of(shape).corners(places.faces))
    points, step = points_of(places, shape)[0], 1e-7
    for axis in np.eye(3):
        there = place_weights(slide(places, points + step * axis, skin_of(shape)))
        np.testing.assert_allclose((there - place_weights(places)) / step, slopes @ axis, atol=0.1)
