"""Gloves on hands: attachment, and markers that are put on a point of the skin."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gloves import Attachment, MarkerLayout, MarkerPlace, attach, load_layout
from gloves.fit import (
    _ray,
    attach_markers,
    nearest_markers,
    nominal_fit,
    place_marker,
    settle_glove,
    vary_layout,
    wear,
)
from handsim import HandModel, join_qpos, sample_shape
from handsim.errors import LayoutError
from handsim.hand.shape import BONE_NAMES, BONES, EVERYBODY, PALM, SIZES
from handsim.hand.skin import vertex_normals
from tests.meshes import blend_skin

MODELS = {side: HandModel.named("M", side=side) for side in ("left", "right")}
LAYOUT = load_layout("dense19")
STALKS = dataclasses.replace(
    LAYOUT, markers=tuple(dataclasses.replace(marker, height=0.01) for marker in LAYOUT.markers)
)


def test_no_poses_have_no_markers():
    centers, normals = nominal_fit("dense19", "M", "right").markers(np.empty((0, 27)))
    assert centers.shape == normals.shape == (0, 19, 3)


@pytest.mark.parametrize("glove", ["dense19", "sparse13"])
def test_markers_sit_one_radius_above_the_skin(glove, rng):
    model = HandModel(sample_shape(EVERYBODY, rng=rng))
    layout = load_layout(glove)
    attachment = attach_markers(layout, model)
    skin = trimesh.Trimesh(model.surface.vertices, model.surface.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(skin, attachment.points)
    np.testing.assert_allclose(distance, layout.radius, atol=0.0004)
    np.testing.assert_allclose(np.linalg.norm(attachment.normals, axis=1), 1.0)
    np.testing.assert_allclose(attachment.bone_weights.sum(axis=1), 1.0)


@given(side=st.sampled_from(["left", "right"]), index=st.integers(0, 18), height=st.floats(0.0, 0.05))
def test_a_stalk_lifts_its_marker_alone_straight_off_the_skin(side, index, height):
    layout, model = load_layout("dense19"), MODELS[side]
    markers = list(layout.markers)
    markers[index] = dataclasses.replace(markers[index], height=height)
    flat = attach_markers(layout, model)
    lifted = attach_markers(dataclasses.replace(layout, markers=tuple(markers)), model)
    expected = flat.points.copy()
    expected[index] += height * flat.normals[index]
    np.testing.assert_allclose(lifted.points, expected, atol=1e-12)
    np.testing.assert_array_equal(lifted.normals, flat.normals)
    np.testing.assert_array_equal(lifted.bone_weights, flat.bone_weights)


@pytest.mark.parametrize("side", ["left", "right"])
def test_markers_stand_where_a_ray_through_every_triangle_leaves_the_skin(side, rng):
    layout = vary_layout(load_layout("dense19"), along=0.1, around=0.3, rng=rng)
    model = HandModel(sample_shape(EVERYBODY, side=side, rng=rng))
    attachment, skin = attach_markers(layout, model), model.surface
    corners = skin.vertices[skin.faces]
    edges1, edges2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    for number, marker in enumerate(layout.markers):
        origin, direction = _ray(marker, model)
        ahead = np.broadcast_to(-direction, edges1.shape)
        systems = np.stack([edges1, edges2, ahead], axis=-1)
        u, v, distance = np.linalg.solve(systems, (origin - corners[:, 0])[..., None])[..., 0].T
        outwards = np.cross(edges1, edges2) @ direction > 0.0
        met = outwards & (np.minimum(u, v) >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        exit_point = origin + distance[met].min() * direction
        below = attachment.points[number] - layout.radius * attachment.normals[number]
        np.testing.assert_allclose(below, exit_point, atol=1e-12)


def test_markers_are_carried_as_the_skin_is(rng):
    model = HandModel(sample_shape(EVERYBODY, rng=rng))
    glove = attach_markers(load_layout("dense19"), model)
    low, high = model.skeleton.ranges.T
    bones = model.forward_kinematics(join_qpos(rng.uniform(low, high, size=(20, 20))))
    markers, normals = glove.markers(model, bones)
    weights = (glove.bone_indices, glove.bone_weights, model.rest_transforms, bones)
    np.testing.assert_allclose(markers, blend_skin(glove.points, *weights), atol=1e-12)
    ahead = blend_skin(glove.points + glove.normals, *weights) - markers
    np.testing.assert_allclose(normals, ahead / np.linalg.norm(ahead, axis=-1, keepdims=True), atol=1e-12)
    np.testing.assert_array_equal(glove.centers(model, bones), markers)


@pytest.mark.parametrize("size", ["XS", "M", "XL"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_markers_at_the_wrist_move_with_the_hand_alone(size, side, rng):
    angles = {"back": 0.0, "thumb": np.pi / 2, "palm": np.pi, "little": -np.pi / 2}
    wrist = [
        MarkerPlace(f"{name}{along}", "palm", along, around)
        for name, around in angles.items()
        for along in (-0.15, 0.0)
    ]
    model = HandModel.named(size, side=side)
    glove = attach_markers(MarkerLayout("band", tuple(wrist), 0.004), model)
    thumbwards, back = glove.normals[:, 1] * (1 if side == "right" else -1), glove.normals[:, 2]
    assert (thumbwards[[2, 3]] > 0.5).all() and (thumbwards[[6, 7]] < -0.5).all()
    assert (back[[0, 1]] > 0.5).all() and (back[[4, 5]] < -0.5).all()
    low, high = model.skeleton.ranges.T
    bones = model.forward_kinematics(join_qpos(rng.uniform(low, high, size=(5, 20))))
    centers = glove.centers(model, bones)[:, ::2]  # at 0 the thumb's root pulls at the skin
    np.testing.assert_allclose(centers, np.broadcast_to(glove.points[::2], centers.shape), atol=5e-4)


def test_a_marker_in_the_air_is_told():
    layout = load_layout("dense19")
    markers = list(layout.markers)
    markers[6] = dataclasses.replace(markers[6], along=1.3)
    with pytest.raises(LayoutError, match=r"marker 'IndexTip' meets no skin from index_distal at along 1\.3"):
        attach_markers(dataclasses.replace(layout, markers=tuple(markers)), HandModel.named("M"))


def test_slipped_markers_keep_their_bones_and_names(rng):
    layout = load_layout("dense19")
    slipped = vary_layout(layout, along=0.1, around=0.2, rng=rng)
    assert slipped.names == layout.names
    assert [m.bone for m in slipped.markers] == [m.bone for m in layout.markers]
    moved = np.array([a.along - b.along for a, b in zip(slipped.markers, layout.markers, strict=True)])
    assert 0.02 < moved.std() < 0.2
    assert vary_layout(layout, along=0.0, around=0.0, rng=rng) == layout


def test_the_nearest_markers_are_named() -> None:
    fit = attach("dense19", "M")
    points = fit.attachment.points.copy()
    points[7] = points[2] + [0.0, 0.003, 0.004]
    first, second, distance = nearest_markers(
        dataclasses.replace(fit, attachment=dataclasses.replace(fit.attachment, points=points))
    )
    assert (first, second) == (fit.layout.names[2], fit.layout.names[7])
    assert distance == pytest.approx(0.005)


@pytest.mark.parametrize("layout", [LAYOUT, STALKS])
@pytest.mark.parametrize("side", ["right", "left"])
def test_a_marker_that_is_put_where_it_is_stays_there(side, layout):
    fit = nominal_fit(layout, "L", side)
    for index in range(0, layout.num_markers, 1 if layout is LAYOUT else 5):
        moved = place_marker(layout, index, fit.model, fit.attachment.points[index])
        assert moved.markers[index].bone == layout.markers[index].bone
        assert moved.markers[index].height == layout.markers[index].height
        assert moved.markers[:index] == layout.markers[:index]
        assert moved.markers[index + 1 :] == layout.markers[index + 1 :]
        again = attach_markers(moved, fit.model).points[index]
        tolerance = 2e-4 if layout is LAYOUT else 5e-4
        np.testing.assert_allclose(again, fit.attachment.points[index], atol=tolerance)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(["right", "left"]),
    st.integers(0, LAYOUT.num_markers - 1),
    st.integers(0, 10**6),
    st.floats(0.0, 0.02),
)
def test_a_marker_goes_to_the_skin_below_the_point(side, index, place, height):
    model = MODELS[side]
    surface = model.surface
    vertex = place % len(surface.vertices)
    normal = vertex_normals(surface.vertices, surface.faces)[vertex]
    point = surface.vertices[vertex] + (LAYOUT.radius + height) * normal
    center = attach_markers(place_marker(LAYOUT, index, model, point), model).points[index]
    nearest = np.linalg.norm(surface.vertices - point, axis=1).min()
    assume(nearest > LAYOUT.radius + height - 1e-4)  # no marker fits into the folds between the fingers
    assert np.linalg.norm(center - point) < height + 0.02  # the wrist's cut is beyond what a layout reaches
    assert LAYOUT.radius - 1e-3 < np.linalg.norm(surface.vertices - center, axis=1).min() < 0.008


def worn_by(*places: MarkerPlace) -> MarkerLayout:
    """A glove of these markers, numbered; the first is repeated until there are five."""
    markers = (*places, *[places[0]] * (5 - len(places)))
    named = [dataclasses.replace(marker, name=str(number)) for number, marker in enumerate(markers)]
    return MarkerLayout("own", tuple(named), 0.003)


def nearest_digits(points: np.ndarray, model: HandModel) -> np.ndarray:
    """The digit of the moving bone whose segment at rest is nearest to each point: thumb 0 to little 4."""
    starts = model.rest_transforms[1:, :3, 3]
    spans = model.skeleton.lengths[1:, None] * model.rest_transforms[1:, :3, 0]
    offsets = points[:, None] - starts
    shares = np.clip((offsets * spans).sum(-1) / (spans**2).sum(-1), 0.0, 1.0)
    distances = np.linalg.norm(offsets - shares[..., None] * spans, axis=-1)
    return distances.argmin(axis=1) // 3


@pytest.mark.parametrize(
    ("bone", "along", "around", "other"),
    [("ring_proximal", 0.45, 90, "index_proximal"), ("little_proximal", 0.5, 90, "proximal")],
)
def test_a_place_in_the_web_between_fingers_is_refused_with_the_bone_it_would_be_on(
    bone, along, around, other
):
    layout = worn_by(MarkerPlace("R1", bone, along, np.deg2rad(around)))
    for size in ("XS", "M", "XL"):
        with pytest.raises(LayoutError, match=rf"marker '0' on {bone} .* would lie on \w*{other}"):
            attach(layout, size)
    with pytest.raises(LayoutError, match="would lie on"):
        wear(layout, HandModel.named("XL"), along=0.1, around=0.1, rng=np.random.default_rng(0))
    attach(worn_by(MarkerPlace("R1", bone, 0.7, np.deg2rad(around))), "M")


def test_the_skin_that_the_palm_carries_is_the_palms():
    thenar = MarkerPlace("P1", "palm", 0.3, np.pi, across=0.2)
    knuckle = MarkerPlace("P2", "palm", 1.0, 0.0, across=0.2)
    for size in ("XS", "M", "XL"):
        attach(worn_by(thenar, knuckle), size)
    with pytest.raises(LayoutError, match="would lie on ring_proximal"):
        attach(worn_by(dataclasses.replace(knuckle, along=1.2, across=-0.35)), "M")


def test_a_stalk_that_ends_inside_the_neighboring_finger_is_refused():
    side = MarkerPlace("M1", "middle_middle", 0.4, np.pi / 2)
    attach(worn_by(side), "M")
    with pytest.raises(LayoutError, match=r"would lie on index_"):
        attach(worn_by(dataclasses.replace(side, height=0.008)), "M")


def test_slips_leave_lateral_markers_on_the_skin_of_their_digit(rng):
    fingers = ("index", "middle", "ring", "little")
    sides = [
        (f"{name}_{part}", turn) for name in fingers for part in ("proximal", "middle") for turn in (1, -1)
    ]
    layout = worn_by(*(MarkerPlace("x", bone, 0.68, turn * np.pi / 2) for bone, turn in sides))
    own = np.array([1 + fingers.index(bone.split("_")[0]) for bone, _ in sides])
    for _ in range(60):
        model = HandModel(sample_shape(EVERYBODY, rng=rng))
        designed = settle_glove(layout, model).attachment
        worn = wear(layout, model, along=0.1, around=np.deg2rad(10), rng=rng)
        np.testing.assert_array_equal(nearest_digits(worn.feet, model), own)
        assert np.linalg.norm(worn.points - designed.points, axis=1).max() < 0.025
        assert worn.layout.names == layout.names


def stray(worn: Attachment, model: HandModel) -> list[str]:
    """Markers whose nearest bone, or the bone that carries their skin, is of another digit.

    Metacarpals are the palm's and their finger's; the thumb has the index finger's and the wrist, too. What
    the palm carries is its own.
    """
    feet, capsules = worn.feet, model.capsules
    starts, ends = np.moveaxis(capsules.posed(model.rest_transforms[None])[0], 1, 0)
    shares = ((feet[:, None] - starts) * (ends - starts)).sum(-1) / ((ends - starts) ** 2).sum(-1)
    away = feet[:, None] - starts - np.clip(shares, 0.0, 1.0)[..., None] * (ends - starts)
    distances = np.linalg.norm(away, axis=-1)
    metacarpals = iter(({1, 0}, {2}, {3}, {4}, {0}, {0}))
    owners = [
        {-1} | next(metacarpals) if bone == PALM else {BONES[bone].digit} for bone in capsules.bones.tolist()
    ]
    found = []
    for index, marker in enumerate(worn.layout.markers):
        own = [BONES[BONE_NAMES.index(marker.bone)].digit in one for one in owners]
        # Where two bones meet, as in a knuckle, both are equally near.
        near = distances[index, own].min() <= distances[index].min() + 1e-9
        digit = BONES[BONE_NAMES.index(marker.bone)].digit
        carried = digit < 0 or BONES[worn.main_bones[index]].digit in (-1, digit)
        if not (carried and near) and not (marker.bone == "palm" and worn.main_bones[index] == PALM):
            found.append(marker.name)
    return found


@pytest.mark.parametrize(
    ("num_places", "num_people"), [(120, 8), pytest.param(2000, 200, marks=pytest.mark.slow)]
)
def test_any_place_is_refused_or_stays_on_its_digit_and_slips_a_little(num_places, num_people):
    rng, places = np.random.default_rng(0), []
    for _ in range(num_places):
        bone = BONE_NAMES[rng.integers(len(BONE_NAMES))]
        across = rng.uniform(-0.5, 0.5) if bone == "palm" else 0.0
        place = MarkerPlace("x", bone, rng.uniform(0.0, 1.0), rng.uniform(-np.pi, np.pi), across)
        try:
            attach(worn_by(place), "M")
        except LayoutError:
            continue
        places.append(place)
    assert len(places) > 0.9 * num_places
    gloves = [worn_by(*places[first : first + 60]) for first in range(0, len(places), 60)]
    for size in SIZES:
        model = HandModel.named(size)
        for place in places[:: 1 if num_people > 100 else 20]:
            try:
                assert not stray(attach(worn_by(place), size).attachment, model), place
            except LayoutError:  # the skin of this size is another digit's there
                assert not stray(settle_glove(worn_by(place), model).attachment, model), place
    for _ in range(num_people):
        model = HandModel(sample_shape(EVERYBODY, rng=rng))
        for glove in gloves:
            designed = settle_glove(glove, model).attachment
            worn = wear(glove, model, along=0.1, around=np.deg2rad(10.0), rng=rng)
            assert not stray(designed, model) and not stray(worn, model)
            assert np.linalg.norm(worn.points - designed.points, axis=1).max() <= 0.025
