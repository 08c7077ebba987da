"""Depth, normals and ids of the z-buffer against embree's rays, and where the answer is known."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import trimesh

from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.skin import vertex_normals
from handsim.space.camera import Camera, look_at, pinhole, preset
from poses.shapes.validity import sample_valid_angles
from render.painting.rasterizer import Triangles, join, rasterize

NO_EMBREE = pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="embreex is not installed")


def surface(vertices: np.ndarray, faces: np.ndarray, part: int = 1) -> Triangles:
    ids = np.full(len(faces), part, dtype=np.uint8)
    return Triangles(vertices, faces, vertex_normals(vertices, faces), ids, ids, np.zeros_like(ids))


def wall(z: float, part: int = 1, half: float = 10.0) -> Triangles:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return surface(corners, np.array([[0, 2, 1], [0, 3, 2]]), part)


def test_a_wall_has_its_distance_everywhere():
    camera = pinhole("small", (32, 24), 20.0)
    pictures = rasterize(camera, wall(1.5, 7))
    np.testing.assert_allclose(pictures.depth, 1.5, rtol=1e-6)
    np.testing.assert_allclose(pictures.normals, np.broadcast_to([0.0, 0.0, -1.0], (24, 32, 3)), atol=1e-6)
    assert (pictures.parts == 7).all() and (pictures.markers == 0).all()


def test_the_nearer_of_two_is_seen_whatever_their_order():
    camera = pinhole("small", (32, 24), 20.0)
    far, near = wall(2.0, 1), wall(1.0, 2, half=0.2)
    for both in (join([far, near]), join([near, far])):
        pictures = rasterize(camera, both)
        assert pictures.parts[12, 16] == 2 and pictures.parts[0, 0] == 1
        assert pictures.depth[12, 16] == pytest.approx(1.0) and pictures.depth[0, 0] == pytest.approx(2.0)


def test_neighbors_leave_no_gap_and_nothing_is_seen_behind_the_camera():
    camera = pinhole("small", (64, 48), 40.0)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    shown = rasterize(camera, surface(ball.vertices + [0.01, 0.02, 1.0], ball.faces)).depth > 0.0
    rows, columns = np.nonzero(shown)
    for row in np.unique(rows):
        mine = columns[rows == row]
        assert len(mine) == np.ptp(mine) + 1
    assert not rasterize(camera, surface(ball.vertices - [0.0, 0.0, 1.0], ball.faces)).depth.any()


def test_a_principal_point_off_the_middle_moves_the_picture():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    thing = surface(ball.vertices + [0.0, 0.0, 1.0], ball.faces)
    middle = rasterize(pinhole("a", (40, 30), 60.0), thing).depth
    aside = rasterize(pinhole("b", (40, 30), 60.0, (25.0, 13.0)), thing).depth
    np.testing.assert_array_equal(aside[:-2, 5:], middle[2:, :-5])


def test_a_lens_is_not_a_pinhole():
    with pytest.raises(ArgumentError, match="expected a pinhole"):
        rasterize(preset("headset_fisheye"), wall(1.0))


@NO_EMBREE
@pytest.mark.parametrize("seed", range(3))
def test_a_hand_is_where_embree_finds_it(seed):
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    model, rng = HandModel.named("M"), np.random.default_rng(seed)
    vertices = model.skin(join_qpos(sample_valid_angles(model, 1, rng=rng)))[0]
    faces = model.surface.faces
    parts = rng.integers(1, 200, len(faces)).astype(np.uint8)
    shown = Triangles(vertices, faces, vertex_normals(vertices, faces), parts, parts, parts)
    camera: Camera = preset("vga").at(look_at(np.array([0.1, 0.3, 0.35]), np.array([0.09, 0.0, 0.0])))
    pictures = rasterize(camera, shown)
    directions = camera.rays().reshape(-1, 3) @ camera.T_world_camera[:3, :3].T
    origins = np.broadcast_to(camera.T_world_camera[:3, 3], directions.shape)
    caster = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    places, rays, hit = caster.intersects_location(origins, directions, multiple_hits=False)
    depth, part = np.zeros(len(directions)), np.zeros(len(directions), dtype=np.uint8)
    depth[rays], part[rays] = camera.local(places)[:, 2], parts[hit]
    theirs, mine = depth.reshape(480, 640), pictures.depth
    assert ((theirs > 0) == (mine > 0)).mean() >= 0.9999
    both = (theirs > 0) & (mine > 0)
    assert both.mean() > 0.02
    off = np.abs(theirs - mine)[both]
    assert np.median(off) <= 1e-6 and np.quantile(off, 0.999) <= 1e-5
    assert (part.reshape(480, 640) == pictures.parts)[both].mean() >= 0.999
