"""Lines of sight past capsules and meshes."""

from __future__ import annotations

import importlib.util

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import load_layout
from gloves.fit import attach_markers
from gloves.optics.visibility import (
    MAX_FACING,
    MeshTree,
    clear_of_body,
    clear_of_mesh,
    facing_cameras,
    free_rays,
    hand_tree,
    pack_cameras,
    visible_cameras,
)
from handsim import CameraRig, HandModel, join_qpos, load_rig, sample_shape
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses.shapes import sample_valid_angles
from tests.rigs import mixed_rig

FRAMES = 40


coordinate = st.floats(-1.0, 1.0, width=32)
corner = st.tuples(coordinate, coordinate, coordinate)


@pytest.fixture(params=["right", "left"])
def scene(request, rng):
    model = HandModel(sample_shape(side=request.param, rng=rng))
    qpos = join_qpos(
        sample_valid_angles(model, FRAMES, rng=rng),
        position=np.array([0.0, 0.0, 1.1]) + rng.uniform(-0.3, 0.3, (FRAMES, 3)),
        quaternion=random_quaternions(FRAMES, rng=rng),
    )
    bones = model.forward_kinematics(qpos)
    markers, normals = attach_markers(load_layout("dense19"), model).markers(model, bones)
    return model, qpos, markers, normals, model.capsules.posed(bones)


@pytest.fixture
def mesh_scene(scene):
    model, qpos, markers, _, _ = scene
    return model, qpos, model.skin(qpos), markers, load_rig("figure5").positions


def test_every_ray_agrees_with_mujoco(scene):
    model, qpos, markers, _, segments = scene
    cameras = load_rig("figure5").positions
    free = free_rays(markers, cameras, segments, model.capsules.radii)
    assert 0.2 < free.mean() < 0.95, "the test needs rays of both kinds"
    data = mujoco.MjData(model.mj_model)
    hits, distances = np.zeros(16, dtype=np.int32), np.zeros(16)
    for frame, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model.mj_model, data)
        for marker, place in enumerate(markers[frame]):
            rays = cameras - place
            lengths = np.linalg.norm(rays, axis=1)
            unit = (rays / lengths[:, None]).ravel()
            mujoco.mj_multiRay(
                model.mj_model, data, place, unit, None, 1, -1, hits, distances, None, 16, 10.0
            )
            blocked = (distances >= 0) & (distances < lengths)
            np.testing.assert_array_equal(free[frame, marker], ~blocked)


def test_a_camera_sees_alike_whatever_others_there_are(scene):
    model, _, markers, normals, segments = scene
    rig = load_rig("figure5")
    few = CameraRig("few", [rig.cameras[number] for number in (3, 7, 11)])
    everyone = visible_cameras(markers, normals, rig, segments, model.capsules.radii)
    np.testing.assert_array_equal(
        visible_cameras(markers, normals, few, segments, model.capsules.radii), everyone[..., [3, 7, 11]]
    )


def test_markers_that_face_away_or_lie_outside_the_view_are_not_seen(scene):
    model, _, markers, normals, segments = scene
    rig = load_rig("figure5")
    far = np.zeros((len(segments), 0, 2, 3))
    seen = visible_cameras(markers, normals, rig, far, np.zeros(0))
    behind = visible_cameras(markers, -normals, rig, far, np.zeros(0))
    assert not (seen & behind).all(axis=-1).any()
    assert visible_cameras(markers + [0.0, 0.0, 50.0], normals, rig, far, np.zeros(0)).sum() == 0
    assert not visible_cameras(markers, normals, rig, segments, model.capsules.radii)[~seen].any()


def test_facing_cameras_are_those_with_the_marker_in_their_picture_and_on_its_outward_side(scene):
    _, _, markers, normals, _ = scene
    rig = mixed_rig()
    to_camera = rig.positions - markers[..., None, :]
    cosines = np.einsum("tmci,tmi->tmc", to_camera, normals) / np.linalg.norm(to_camera, axis=-1)
    expected = rig.in_view(markers) & (cosines > np.cos(MAX_FACING))
    np.testing.assert_array_equal(facing_cameras(markers, normals, rig), expected)
    assert expected.any(axis=(0, 1)).all()


def test_packing_round_trip(rng):
    seen = rng.random((5, 7, 16)) < 0.5
    bits = (pack_cameras(seen)[..., None] >> np.arange(16)) & 1
    np.testing.assert_array_equal(bits, seen)


def every(points, cameras):
    return np.ones((*points.shape[:2], len(cameras)), dtype=bool)


def poses_of(count, rng):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = quaternion_matrix(random_quaternions(count, rng=rng))
    poses[:, :3, 3] = rng.uniform(-0.3, 0.3, size=(count, 3)) + [0.0, 0.0, 1.1]
    return poses


@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="embreex is not installed")
def test_every_line_agrees_with_embree(mesh_scene):
    model, _, skin, markers, cameras = mesh_scene
    clear = clear_of_mesh(hand_tree(), skin, markers, cameras, every(markers, cameras))
    assert 0.2 < clear.mean() < 0.8, "the test needs lines of both kinds"
    for frame in range(FRAMES):
        mesh = trimesh.Trimesh(skin[frame], model.surface.faces, process=False)
        starts = np.repeat(markers[frame], len(cameras), axis=0)
        ends = np.tile(cameras, (len(markers[frame]), 1))
        blocked = mesh.ray.intersects_any(starts, ends - starts).reshape(clear[frame].shape)
        assert (clear[frame] == ~blocked).mean() > 0.995


def test_nearly_every_line_agrees_with_the_capsules(mesh_scene):
    """An oracle that needs no extra package: flesh and skin are the same hand."""
    model, qpos, skin, markers, cameras = mesh_scene
    segments = model.capsules.posed(model.forward_kinematics(qpos))
    free = free_rays(markers, cameras, segments, model.capsules.radii)
    clear = clear_of_mesh(hand_tree(), skin, markers, cameras, every(markers, cameras))
    assert (free == clear).mean() > 0.95


def test_one_tree_refitted_is_every_tree_rebuilt(mesh_scene):
    model, _, skin, markers, cameras = mesh_scene
    wanted = every(markers, cameras)
    refitted = clear_of_mesh(hand_tree(), skin, markers, cameras, wanted)
    for frame in range(0, FRAMES, 4):
        tree = MeshTree(skin[frame], model.surface.faces)
        one = slice(frame, frame + 1)
        rebuilt = clear_of_mesh(tree, skin[one], markers[one], cameras, wanted[one])
        np.testing.assert_array_equal(rebuilt, refitted[one])


def test_boxes_hold_their_triangles_and_their_children():
    tree = hand_tree()
    corners = tree.vertices[tree.faces]
    for node in range(len(tree.skip)):
        low, high = tree.boxes[node, :3], tree.boxes[node, 3:]
        # a branch's triangles are those from its first leaf to the node that follows the branch
        mine = corners[tree.first[node] : tree.first[tree.skip[node]]]
        assert len(mine) > 0
        np.testing.assert_allclose(mine.min(axis=(0, 1)), low, rtol=0, atol=1.1e-9)
        np.testing.assert_allclose(mine.max(axis=(0, 1)), high, rtol=0, atol=1.1e-9)
        assert (mine >= low).all()
        assert (mine <= high).all()


def test_a_sphere_hides_what_lies_in_its_shadow(rng):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    tree = MeshTree(ball.vertices, ball.faces)
    points = rng.uniform(-3.0, 3.0, size=(1, 400, 3))
    cameras = np.array([[6.0, 0.0, 0.0], [0.0, -7.0, 1.0]])
    clear = clear_of_mesh(tree, np.array(ball.vertices)[None], points, cameras, every(points, cameras))
    way = cameras - points[0, :, None]
    share = np.clip(-np.einsum("pi,pci->pc", points[0], way) / (way**2).sum(-1), 0.0, 1.0)
    nearest = np.linalg.norm(points[0, :, None] + share[..., None] * way, axis=-1)
    inside = (np.linalg.norm(points[0], axis=-1) < 1.0)[:, None]
    sure = np.abs(nearest - 1.0) > 0.01  # the polyhedron is a little smaller than the sphere
    expected = (nearest > 1.0) & ~inside
    assert (~expected & sure).sum() > 20
    np.testing.assert_array_equal(clear[0][sure], expected[sure])


def test_lines_end_at_the_camera_and_edges_of_a_box_block():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    tree = MeshTree(box.vertices, box.faces)
    points = np.array(
        [[[0.3, 0.2, 3.0], [0.3, 0.2, -3.0], [0.3, 0.2, 0.0], [3.0, 0.0, 0.0], [1.0, 0.2, -3.0]]]
    )
    clear = clear_of_mesh(
        tree, np.array(box.vertices)[None], points, np.array([[0.3, 0.2, 1.5], [1.0, 0.2, 4.0]]),
        every(points, [0, 1]),
    )  # fmt: skip
    # before the box; behind it; inside; beside it; below an edge, for the second camera along a side
    np.testing.assert_array_equal(clear[0, :, 0], [True, False, False, True, False])
    np.testing.assert_array_equal(clear[0, :, 1], [True, False, False, True, False])


def test_a_rigid_body_is_its_mesh_carried_along(rng):
    body = trimesh.creation.capsule(height=0.15, radius=0.02, count=[12, 12])
    tree = MeshTree(body.vertices, body.faces)
    poses = poses_of(30, rng)
    points = poses[:, None, :3, 3] + rng.normal(0.0, 0.06, size=(30, 12, 3))
    cameras = load_rig("figure5").positions
    wanted = every(points, cameras)
    moved = np.einsum("tij,vj->tvi", poses[:, :3, :3], body.vertices) + poses[:, None, :3, 3]
    as_body = clear_of_body(tree, poses, points, cameras, wanted)
    assert 0.1 < as_body.mean() < 0.95
    np.testing.assert_array_equal(as_body, clear_of_mesh(tree, moved, points, cameras, wanted))
    each = np.repeat(points[:, :, None], len(cameras), axis=2)
    np.testing.assert_array_equal(as_body, clear_of_body(tree, poses, each, cameras, wanted))


def test_each_cameras_line_may_start_at_its_own_point(mesh_scene, rng):
    _, _, skin, markers, cameras = mesh_scene
    wanted = every(markers, cameras)
    own = markers[:, :, None] + rng.normal(0.0, 0.003, size=(*wanted.shape, 3))
    together = clear_of_mesh(hand_tree(), skin, own, cameras, wanted)
    for camera in (0, 7, 15):
        one = slice(camera, camera + 1)
        alone = clear_of_mesh(hand_tree(), skin, own[:, :, camera], cameras[one], wanted[..., one])
        np.testing.assert_array_equal(alone, together[..., one])


def test_unwanted_and_missing_are_never_clear(mesh_scene, rng):
    _, _, skin, markers, cameras = mesh_scene
    everything = clear_of_mesh(hand_tree(), skin, markers, cameras, every(markers, cameras))
    wanted = rng.random(everything.shape) < 0.5
    missing = rng.random(markers.shape[:2]) < 0.3
    holes = np.where(missing[..., None], np.nan, markers)
    some = clear_of_mesh(hand_tree(), skin, holes, cameras, wanted)
    np.testing.assert_array_equal(some, everything & wanted & ~missing[..., None])
    bodies = np.tile(np.eye(4), (FRAMES, 1, 1))
    assert not clear_of_body(hand_tree(), bodies, holes, cameras, wanted)[missing].any()


@settings(max_examples=60, deadline=None)
@given(
    triangles=st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=30),
    points=st.lists(corner, min_size=1, max_size=4),
    camera=corner,
)
def test_brute_force_says_the_same(triangles, points, camera):
    vertices = np.array(triangles).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    starts, end = np.array(points)[None], np.array([camera])
    clear = clear_of_mesh(MeshTree(vertices, faces), vertices[None], starts, end, every(starts, end))
    for place, answer in zip(starts[0], clear[0, :, 0], strict=True):
        volumes = line_volumes(vertices[faces], place, end[0])
        met = ((volumes > 1e-9).all(axis=1) | (volumes < -1e-9).all(axis=1)).any()
        near = ((volumes >= -1e-9).all(axis=1) | (volumes <= 1e-9).all(axis=1)).any()
        if met == near:  # else a line grazes a triangle, and rounding may say either
            assert answer == (not met)


def line_volumes(corners, start, end):
    """Five signed volumes, of one sign exactly where the line from start to end meets a triangle."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    sides = [
        np.einsum("i,fi->f", end - start, np.cross(p - start, q - start)) for p, q in ((a, b), (b, c), (c, a))
    ]
    # a line that crosses against the normal has start above the plane and all three sides negative
    return np.stack(
        [*sides, np.einsum("fi,fi->f", a - start, normal), np.einsum("fi,fi->f", end - a, normal)], axis=1
    )
