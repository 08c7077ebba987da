from __future__ import annotations

import numpy as np
import pytest
import trimesh

from handsim import HandModel, join_qpos, sample_shape
from handsim.hand.shape import BONES, JOINT_NAMES, NUM_BONES, SIDES, Side
from handsim.hand.skin import all_weights, vertex_normals
from handsim.space.transforms import MIRROR
from poses.shapes import gesture
from render.frames import FOREARM
from render.skin.look import CUFF, REACH, Forearm, arm_places, sample_forearm
from render.skin.mesh import RINGS, Flexion, PosableSkin, face_parts, skin_atlas


@pytest.mark.parametrize("side", SIDES)
def test_drawn_skin_is_closed_and_faces_outwards(side: Side, rng: np.random.Generator) -> None:
    for _ in range(3):
        mesh = PosableSkin(HandModel(sample_shape(side=side, rng=rng)), sample_forearm(rng=rng))
        solid = trimesh.Trimesh(mesh.rest, mesh.faces, process=False)
        assert solid.is_watertight
        assert solid.is_winding_consistent
        assert 2e-3 < solid.volume < 7e-3  # [m3]: a hand on an arm


def test_the_hands_own_vertices_are_the_models(model: HandModel) -> None:
    qpos = join_qpos(gesture("ok")[None], position=np.array([0.3, 0.1, 1.0]))[0]
    mesh, atlas = PosableSkin(model), skin_atlas()
    drawn = mesh.posed(qpos)
    skin = model.skin(qpos[None])[0][atlas.used]
    np.testing.assert_array_equal(
        mesh.merged(model.forward_kinematics(qpos[None]), mesh.rest)[: len(skin)], skin
    )
    own = atlas.corners < atlas.num_hand
    np.testing.assert_allclose(drawn.vertices[own], skin[atlas.corners[own]], atol=1e-6)
    # and all that is missing lies behind the wrist
    gone = np.setdiff1d(np.arange(len(model.surface.vertices)), atlas.used)
    assert model.surface.vertices[gone, 0].max() < -0.003


def test_another_hand_takes_light_where_it_is_near_and_nowhere_else(model: HandModel) -> None:
    mesh, qpos = PosableSkin(model), join_qpos(gesture("flat")[None])[0]
    below, far = join_qpos(np.tile(gesture("flat"), (2, 1)), position=np.array([[0, 0, -0.04], [0, 0, -5.0]]))
    alone = mesh.posed(qpos)
    np.testing.assert_allclose(mesh.posed(qpos, others=[mesh.flesh(far)]).shade, alone.shade, atol=1e-3)
    taken = alone.shade - mesh.posed(qpos, others=[mesh.flesh(below)]).shade
    middle, up = np.abs(alone.vertices[:, 0] - 0.06) < 0.02, alone.normals[:, 2]
    palm, back = taken[middle & (up < -0.7)], taken[middle & (up > 0.7)]
    assert palm.mean() > 0.2 and back.mean() < 0.01 and taken.min() > -1e-6


def test_drawn_faces_are_the_closed_surfaces_own(model: HandModel) -> None:
    mesh, atlas = PosableSkin(model), skin_atlas()
    drawn = mesh.posed(join_qpos(gesture("flat")[None])[0])
    np.testing.assert_array_equal(atlas.corners[drawn.faces], mesh.faces)
    assert len(drawn.faces) == len(drawn.parts) < 20_000  # two hands stay below 40 000


def test_normals_are_the_meshs_and_are_shared_across_seams(model: HandModel) -> None:
    mesh, atlas = PosableSkin(model), skin_atlas()
    qpos = join_qpos(gesture("flat")[None])
    drawn = mesh.posed(qpos[0])
    normals = vertex_normals(mesh.merged(model.forward_kinematics(qpos), mesh.rest), mesh.faces)
    np.testing.assert_allclose(drawn.normals, normals[atlas.corners], atol=1e-6)
    order = np.argsort(atlas.corners, kind="stable")
    same = atlas.corners[order][1:] == atlas.corners[order][:-1]
    assert same.sum() > 2000
    assert (drawn.normals[order][1:][same] == drawn.normals[order][:-1][same]).all()


def test_parts_follow_the_weights(model: HandModel) -> None:
    parts, atlas = face_parts(), skin_atlas()
    assert set(parts.tolist()) == {*range(NUM_BONES), FOREARM}
    on_arm = (atlas.faces >= atlas.num_hand).any(axis=1)
    assert ((parts == FOREARM) == on_arm).all()
    surface = model.surface
    strongest = surface.bone_indices[atlas.used][:, 0]
    uniform = (strongest[np.minimum(atlas.faces, atlas.num_hand - 1)] == parts[:, None]).all(axis=1)
    assert uniform[~on_arm].mean() > 0.9
    # a part's middle lies along its bone
    rest, middles = model.rest_transforms, PosableSkin(model).rest[atlas.faces].mean(axis=1)
    for number, bone in enumerate(BONES):
        if bone.digit > 0:
            local = (middles[parts == number].mean(axis=0) - rest[number, :3, 3]) @ rest[number, :3, :3]
            assert 0.0 < local[0] < model.skeleton.lengths[number]
            assert np.hypot(*local[1:]) < 0.006


def test_left_hand_is_the_mirror_image(rng):
    forearm = Forearm(flexion=0.2)
    right, left = (
        PosableSkin(HandModel.named("M", side=side), forearm, bone_relief=1.3) for side in SIDES[::-1]
    )
    np.testing.assert_allclose(left.rest, right.rest @ MIRROR, atol=1e-9)
    qpos = join_qpos(rng.uniform(0.0, 1.2, (1, 20)))[0]  # whose knuckles and tendons stand out
    ours, mirrored = left.posed(qpos), right.posed(qpos)
    np.testing.assert_allclose(ours.vertices, mirrored.vertices @ MIRROR, atol=1e-6)
    np.testing.assert_allclose(ours.shade, mirrored.shade, atol=1e-5)


def test_folds_are_darker_than_what_lies_open(model: HandModel) -> None:
    mesh, parts = PosableSkin(model), face_parts()
    flat, fist = (mesh.posed(join_qpos(gesture(name)[None])[0]) for name in ("spread", "fist"))
    assert flat.shade.min() >= 0.0
    assert fist.shade.max() <= 1.0
    assert flat.shade.mean() > 0.96
    for bone in (5, 8, 11):  # middle phalanges: their pads lie on the palm
        corners = np.unique(fist.faces[parts == bone])
        assert fist.shade[corners].min() < 0.5
    assert fist.shade[np.unique(fist.faces[parts == FOREARM])].mean() > 0.9


def test_fingers_side_by_side_shade_each_other(model: HandModel) -> None:
    mesh, parts = PosableSkin(model), face_parts()
    middle = np.unique(mesh.posed(join_qpos(gesture("flat")[None])[0]).faces[parts == 8])
    shades = {}
    for name in ("flat", "spread"):
        skin = mesh.posed(join_qpos(gesture(name)[None])[0])
        shades[name] = skin.shade[middle][np.abs(skin.normals[middle, 1]) > 0.8].mean()
    assert shades["flat"] < shades["spread"] - 0.05


def test_a_bent_wrist_has_the_arm_come_from_the_palms_side() -> None:
    model = HandModel.named("M")
    straight, bent, aside = (
        PosableSkin(model, Forearm(length=0.2, flexion=flexion, deviation=deviation)).rest[-1]
        for flexion, deviation in ((0.0, 0.0), (0.4, 0.0), (0.0, 0.3))
    )
    assert straight[0] < -0.19
    assert bent[2] < straight[2] - 0.05
    assert aside[1] > straight[1] + 0.04


def test_arms_are_as_thick_as_people_are() -> None:
    model, atlas = HandModel.named("L"), skin_atlas()
    rings = (
        PosableSkin(model, Forearm(length=0.22)).rest[atlas.num_hand : -1].reshape(-1, len(atlas.wrist), 3)
    )
    girths = np.linalg.norm(rings - np.roll(rings, 1, axis=1), axis=-1).sum(axis=1)
    assert 0.150 < girths.min() < 0.180  # [m]: men's wrists, ANSUR II
    assert 0.24 < girths.max() < 0.30
    assert (np.diff(girths[: girths.argmax()])[3:] > 0.0).all()
    arm = PosableSkin(model, Forearm(length=0.7)).rest[atlas.num_hand : -1].reshape(-1, len(atlas.wrist), 3)
    girths = np.linalg.norm(arm - np.roll(arm, 1, axis=1), axis=-1).sum(axis=1)
    behind = -arm[..., 0].mean(axis=1)
    elbow = (behind > 0.24) & (behind < 0.31)
    assert girths[elbow].max() < girths[behind < 0.24].max()  # thinner than the forearm's flesh
    assert 0.30 < girths[-1] < 0.36  # men's upper arms, ANSUR II


@pytest.mark.parametrize("side", SIDES)
def test_an_arm_bends_at_its_elbow_and_stays_one_surface(side: Side, rng: np.random.Generator) -> None:
    mesh = PosableSkin(HandModel.named("M", side=side), sample_forearm(rng=rng))
    qpos = join_qpos(gesture("flat")[None], position=np.array([0.1, 0.2, 0.3]))[0]
    qpos[3:7] = np.array([0.5, 0.5, -0.5, 0.5])
    elbow, ahead = mesh.forearm_line(qpos)
    for way in (ahead, np.cross(ahead, [0.6, 0.0, 0.8]), np.array([0.0, -0.6, 0.8])):
        towards = way / np.linalg.norm(way)
        bent = mesh.posed(qpos, REACH * towards).vertices
        solid = trimesh.Trimesh(bent[np.unique(skin_atlas().corners, return_index=True)[1]], mesh.faces)
        assert solid.is_watertight and solid.volume > 2e-3
        end = bent[-1] - elbow
        assert end @ towards > 0.98 * REACH and np.linalg.norm(end) < REACH + 0.05
        before = skin_atlas().corners < skin_atlas().num_hand
        np.testing.assert_array_equal(bent[before], mesh.posed(qpos).vertices[before])


def test_texture_places_lie_on_texels_of_their_own_tile() -> None:
    atlas = skin_atlas()
    width, height = atlas.size
    texel = atlas.uv * [width, height]
    assert (texel > 0.49).all()
    assert (texel < np.array([width, height]) - 0.49).all()
    # no triangle reaches over more than a quarter of a tile, or of the forearm's strip
    spans = np.ptp(texel[atlas.corner_faces], axis=1)
    on_hand = (atlas.faces < atlas.num_hand).all(axis=1)
    assert spans[on_hand].max() < 4.5


@pytest.mark.parametrize("sleeve", [0.005, 0.035, 0.1, 0.5])
def test_a_sleeve_is_wider_than_the_arm_in_it_from_its_edge_on(sleeve: float) -> None:
    atlas, model = skin_atlas(), HandModel.named("M")
    around: list[np.ndarray] = []
    for looseness in (1.0, 1.3):
        forearm = Forearm(length=0.6, sleeve=sleeve, looseness=looseness)
        arm = PosableSkin(model, forearm).rest[atlas.num_hand : -1].reshape(RINGS, -1, 3)
        around.append(np.linalg.norm(arm - arm.mean(axis=1, keepdims=True), axis=-1).mean(axis=1))
    places = arm_places(forearm, RINGS)[1:]
    assert (np.diff(places) > 0.0).all() and places[-1] == pytest.approx(0.6, abs=0.01)
    wider, sleeved = around[1] / around[0], places > sleeve
    assert np.isclose(places[sleeved][0], sleeve + CUFF)
    np.testing.assert_allclose(wider[~sleeved], 1.0)
    blended = places < 0.05  # the hand's own section
    np.testing.assert_allclose(wider[sleeved & ~blended], 1.3, atol=0.01)


def rises(side: Side, **degrees: float) -> tuple[PosableSkin, np.ndarray]:
    """How far each vertex at rest moves outwards [m], the ulna's head aside."""
    mesh = PosableSkin(HandModel.named("M", side=side))
    normals = vertex_normals(mesh.rest, mesh.faces)
    flexion = Flexion(mesh.model, mesh.rest, normals, 1.0)
    angles = np.zeros(20)
    for name, angle in degrees.items():
        angles[JOINT_NAMES.index(name)] = np.deg2rad(angle)
    moved = flexion.shaped(mesh.rest, angles) - flexion.shaped(mesh.rest, np.zeros(20))
    return mesh, (moved * normals).sum(axis=1)


def test_no_bones_are_the_models_own_skin() -> None:
    mesh = PosableSkin(HandModel.named("M"))
    flexion = Flexion(mesh.model, mesh.rest, vertex_normals(mesh.rest, mesh.faces), 0.0)
    np.testing.assert_array_equal(flexion.shaped(mesh.rest, np.full(20, 0.5)), mesh.rest)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("digit", "bone"), [("index", 4), ("middle", 7), ("ring", 10), ("little", 13)])
def test_a_bent_finger_has_a_knuckle(side: Side, digit: str, bone: int) -> None:
    mesh, rise = rises(side, **{f"{digit}_MCP_flexion": 80.0})
    top = mesh.rest[rise.argmax()] - mesh.model.rest_transforms[bone][:3, 3]
    assert 0.0025 < rise.max() < 0.005  # more, and knuckles of a fist look like teeth
    assert np.linalg.norm(top[:2]) < 0.006 and top[2] > 0.006  # over the joint, on the back
    far = np.linalg.norm(mesh.rest - mesh.rest[rise.argmax()], axis=1) > 0.03
    palm = vertex_normals(mesh.rest, mesh.faces)[:, 2] < -0.3
    assert np.abs(rise[far & ~palm]).max() < 0.0025


def test_fingers_of_a_fist_are_wider_so_that_they_touch() -> None:
    mesh, rise = rises("right", middle_MCP_flexion=80.0)
    frame = mesh.model.rest_transforms[7]
    place = (mesh.rest - frame[:3, 3]) @ frame[:3, :3]
    shaft = (np.abs(place[:, 1]) < 0.0112) & (np.abs(place[:, 0] - 0.025) < 0.008) & (place[:, 2] < 0.0)
    across = vertex_normals(mesh.rest, mesh.faces) @ frame[:3, 1]
    for sides in (shaft & (across > 0.9), shaft & (across < -0.9)):
        assert sides.sum() > 5 and (rise[sides] > 0.0004).all() and (rise[sides] < 0.001).all()


@pytest.mark.parametrize("digit", ["thumb", "middle"])
def test_a_bent_joint_keeps_its_thickness(model: HandModel, digit: str) -> None:
    joint, bone = {"thumb": ("thumb_IP_flexion", 3), "middle": ("middle_PIP_flexion", 8)}[digit]
    qpos = join_qpos(np.zeros((1, 20)))
    qpos[0, 7 + JOINT_NAMES.index(joint)] = np.deg2rad(80.0)
    mesh, transforms, atlas = PosableSkin(model), model.forward_kinematics(qpos), skin_atlas()
    weights = all_weights(model.surface.bone_indices, model.surface.bone_weights)[atlas.used]
    bent = np.flatnonzero(weights[:, bone] * weights[:, bone - 1] > 0.24)  # half way between the bones
    bends = Flexion(model, mesh.rest, vertex_normals(mesh.rest, mesh.faces), 1e-9)  # without hills

    def away(frames: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Distance from the hinge [m]."""
        return np.linalg.norm(((points[bent] - frames[bone, :3, 3]) @ frames[bone, :3, :3])[:, ::2], axis=1)

    rest = away(model.rest_transforms, mesh.rest)
    shaped = mesh.merged(transforms, bends.shaped(mesh.rest, qpos[0, 7:]))
    np.testing.assert_allclose(away(transforms[0], shaped), rest, rtol=1e-6)
    assert (away(transforms[0], mesh.merged(transforms, mesh.rest)) < 0.85 * rest).all()


def test_shapes_grow_with_the_angle_and_never_jump() -> None:
    heights = [rises("right", index_MCP_flexion=angle)[1].max() for angle in np.arange(0.0, 96.0, 4.0)]
    assert (np.diff(heights) > -1e-4).all()
    assert np.abs(np.diff(heights)).max() < 6e-4


def test_a_spread_hand_shows_tendons_between_wrist_and_knuckles() -> None:
    mesh, rise = rises("right", middle_MCP_flexion=-20.0)
    ridge = mesh.rest[rise > 0.0006]
    assert len(ridge) > 10
    assert (ridge[:, 0] > 0.02).all() and (ridge[:, 0] < 0.11).all() and np.ptp(ridge[:, 1]) < 0.012
