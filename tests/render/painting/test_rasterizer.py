from __future__ import annotations

import importlib.util

import cv2
import numpy as np
import pytest
import trimesh

from handsim import Camera, HandModel, Lens, join_qpos, look_at
from handsim.errors import ArgumentError
from handsim.hand.skin import vertex_normals
from handsim.space.camera import pinhole, preset
from handsim.space.transforms import euler_matrix
from poses.shapes import sample_valid_angles
from render.painting.figures import Drawn, Material
from render.painting.painter import paint
from render.painting.rasterizer import (
    Triangles,
    faces_for,
    join,
    nearest_faces,
    rasterize,
    warp,
    warp_depth,
    warp_normals,
)
from render.scenery.lights import Lighting

NO_EMBREE = pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="embreex is not installed")
SPHERES = (
    ((0.0, 0.0, 0.6), 0.1),
    ((0.35, 0.1, 0.3), 0.12),
    ((-0.5, 0.05, 0.05), 0.15),
    ((0.1, -0.4, 0.2), 0.1),
)
WALL = 1.5
POSE = np.eye(4)
POSE[:3, :3] = euler_matrix(np.array([0.3, -0.2, 0.1]))
POSE[:3, 3] = 0.02, -0.01, 0.03
K = np.array([[200.0, 0.0, 163.0], [0.0, 204.0, 116.0], [0.0, 0.0, 1.0]])
WIDE = np.array([[110.0, 0.0, 161.5], [0.0, 112.0, 118.0], [0.0, 0.0, 1.0]])  # corners see past 90 degrees
CAMERAS = {
    "brown": Camera("brown", (320, 240), K, POSE, Lens("brown", (-0.30, 0.11, -0.001, 0.0015, -0.02))),
    "pincushion": Camera("pincushion", (320, 240), K, POSE, Lens("brown", (0.2, 0.05, 0.0, 0.0, 0.0))),
    "fisheye": Camera("fisheye", (320, 240), WIDE, POSE, Lens("fisheye", (0.02, -0.006, 0.0, 0.0))),
    "narrow fisheye": Camera(
        "narrow fisheye", (320, 240), K, POSE, Lens("fisheye", (0.02, -0.006, 0.0, 0.0))
    ),
}


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


@NO_EMBREE
@pytest.mark.parametrize("away", [0.03, 0.1, 0.3, 1.0])
def test_what_reaches_behind_the_camera_is_cut_off_and_not_left_out(away):
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    arm = trimesh.creation.capsule(height=1.6, radius=0.05, count=[12, 8])  # with long triangles
    camera = pinhole("wide", (640, 480), 210.0)
    camera = camera.at(look_at(np.array([0.05 + away, 0.0, 0.0]), np.array([0.0, 0.0, 0.6])))
    shown, white = surface(np.array(arm.vertices), np.array(arm.faces)), np.ones((len(arm.vertices), 4))
    material = Drawn(shown, white.astype(np.float32), None, lambda: Material(np.ones(3), 1.0))
    pictures = rasterize(camera, shown)
    painted = paint(camera, [material], Lighting((), (0.5,) * 3))
    directions = camera.rays().reshape(-1, 3) @ camera.T_world_camera[:3, :3].T
    origins = np.broadcast_to(camera.T_world_camera[:3, 3], directions.shape)
    places, rays, _ = RayMeshIntersector(arm).intersects_location(origins, directions, multiple_hits=False)
    depth = np.zeros(len(directions))
    depth[rays] = camera.local(places)[:, 2]
    theirs = depth.reshape(480, 640)
    assert (camera.local(arm.vertices)[:, 2] < 0.0).any() == (away < 1.0)
    assert (theirs > 0).mean() > 0.005
    assert ((theirs > 0) == (pictures.depth > 0)).mean() >= 0.9999
    assert np.quantile(np.abs(theirs - pictures.depth)[theirs > 0], 0.999) < 1e-5
    inside = cv2.erode((theirs > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert (painted[..., 3][inside] == 255).all() and (pictures.parts[inside] == 1).all()
    assert np.allclose(np.linalg.norm(pictures.normals[inside], axis=-1), 1.0, atol=1e-5)


def cast(camera: Camera) -> dict[str, np.ndarray]:
    """Depth, normals, ids and colors of a camera's pixels, without any of what is tested."""
    rays = camera.rays()
    known = np.isfinite(rays).all(axis=-1)
    rotation, origin = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    world = np.where(known[..., None], rays, 1.0) @ rotation.T
    range_ = np.full(known.shape, np.inf)
    normals, ids = np.zeros((*known.shape, 3)), np.zeros(known.shape, np.uint8)
    for axis in range(3):  # the inside of a box
        with np.errstate(divide="ignore"):
            away = (np.sign(world[..., axis]) * WALL - origin[axis]) / world[..., axis]
        first = (away > 0) & (away < range_)
        range_[first], ids[first] = away[first], 10 + axis
        normals[first] = 0.0
        normals[first, axis] = -np.sign(world[..., axis])[first]
    for number, (center, radius) in enumerate(SPHERES):
        offset = origin - center
        along = world @ offset
        root = along**2 - offset @ offset + radius**2
        away = -along - np.sqrt(np.maximum(root, 0.0))
        first = (root > 0) & (away > 0) & (away < range_)
        range_[first], ids[first] = away[first], 1 + number
        normals[first] = (origin + away[..., None] * world - center)[first] / radius
    points = origin + range_[..., None] * world
    checker = 0.5 + 0.4 * np.prod(np.cos(6.0 * points), axis=-1)
    ahead = range_ * np.where(known, rays[..., 2], 0.0)
    empty = ~known
    ids[empty], checker[empty], ahead[empty] = 0, 0.0, 0.0
    normals[empty] = 0.0
    return {
        "depth": np.where(ahead > 0, ahead, 0.0).astype(np.float32),
        "normals": (normals @ rotation).astype(np.float32),
        "ids": ids,
        "rgb": np.rint(255 * np.stack([checker, 1 - checker, checker**2], axis=-1)).astype(np.uint8),
    }


@pytest.fixture(scope="module", params=CAMERAS)
def scene(request):
    camera = CAMERAS[request.param]
    return camera, cast(camera), [cast(face) for face in faces_for(camera)]


def test_faces_are_where_the_camera_is_and_as_fine(scene):
    camera, _, _ = scene
    rays = camera.rays()
    world = rays @ camera.T_world_camera[:3, :3].T
    faces = faces_for(camera)
    assert len(faces) == (5 if camera.name == "fisheye" else 1)
    covered = np.zeros(rays.shape[:2], bool)
    for face in faces:
        assert face.lens.kind == "pinhole"
        np.testing.assert_array_equal(face.T_world_camera[:3, 3], POSE[:3, 3])
        pixels = face.project(world + POSE[:3, 3])
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 1.0) & (pixels <= np.array(face.size) - 1.0)).all(axis=-1)
        covered |= inside
        local = world @ face.T_world_camera[:3, :3]
        owned = inside & (local[..., 2] >= 0.999 * np.abs(local).max(axis=-1)) if len(faces) > 1 else inside
        for axis in (0, 1):
            step = np.linalg.norm(np.diff(pixels, axis=axis), axis=-1)
            mine = owned[1:] & owned[:-1] if axis == 0 else owned[:, 1:] & owned[:, :-1]
            assert step[mine].min() >= 0.99  # no step of the lens's is less than a pixel of the face
    assert covered[np.isfinite(rays).all(axis=-1)].all()


def test_ids_are_those_of_rays(scene):
    camera, truth, faces = scene
    ids = warp(camera, [face["ids"] for face in faces])
    assert ids.dtype == np.uint8
    assert (ids != truth["ids"]).mean() < 0.01  # silhouettes, by less than a pixel
    inside = np.ones_like(ids, bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            inside &= np.roll(truth["ids"], (down, right), axis=(0, 1)) == truth["ids"]
    inside[[0, -1]] = inside[:, [0, -1]] = False
    assert (ids == truth["ids"])[inside].all()


def test_colors_are_those_of_rays(scene):
    camera, truth, faces = scene
    rgb = warp(camera, [face["rgb"] for face in faces], cv2.INTER_LINEAR)
    error = np.abs(rgb.astype(int) - truth["rgb"].astype(int)).max(axis=-1)
    assert np.median(error) <= 1 and (error > 4).mean() < 0.02  # edges


def test_depth_is_along_the_cameras_own_axis(scene):
    camera, truth, faces = scene
    depth = warp_depth(camera, [face["depth"] for face in faces])
    assert depth.dtype == np.float32
    both = (depth > 0) & (truth["depth"] > 0)
    assert (both | ((depth == 0) & (truth["depth"] < 2e-3))).mean() > 0.998
    error = np.abs(depth - truth["depth"])[both]
    assert np.median(error) < 2e-5 and (error > 5e-3).mean() < 0.01
    # No value is made up between a sphere and what is behind it.
    close = np.min([np.abs(depth - np.roll(truth["depth"], move, axis=(0, 1))) for move in
                    ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))], axis=0)  # fmt: skip
    assert (close[both] < 0.02).mean() > 0.999


def test_normals_are_in_the_cameras_axes(scene):
    camera, truth, faces = scene
    normals = warp_normals(camera, [face["normals"] for face in faces])
    seen = (np.abs(normals).sum(axis=-1) > 0) & (np.abs(truth["normals"]).sum(axis=-1) > 0)
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=-1), 1.0, atol=1e-5)
    cosine = (normals * truth["normals"]).sum(axis=-1)[seen]
    assert np.quantile(cosine, 0.02) > 0.99 and np.median(cosine) > 0.9999


def test_a_pinhole_is_its_own_face():
    camera = preset("vga")
    (face,) = faces_for(camera)
    assert face is camera
    picture = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    assert (warp(camera, [picture], cv2.INTER_LINEAR) == picture).all()
    depth = picture[..., 0].astype(np.float32)
    assert (warp_depth(camera, [depth]) == depth).all()


def test_places_that_no_ray_meets_stay_empty():
    folds = Camera("folds", (320, 240), K, lens=Lens("brown", (-0.45, 0.0, 0.0, 0.0, 0.0)))
    faces = faces_for(folds)
    white = [np.full(face.size[::-1], 255, np.uint8) for face in faces]
    picture = warp(folds, white)
    known = np.isfinite(folds.rays()).all(axis=-1)
    assert 0.05 < (~known).mean() < 0.6
    assert (picture[known] == 255).all() and (picture[~known] == 0).all()


def test_a_moved_camera_shares_its_lookups(monkeypatch):
    import render.painting.rasterizer

    camera = CAMERAS["fisheye"]
    faces_for(camera)
    monkeypatch.setattr(
        render.painting.rasterizer, "_face", None
    )  # were anything planned anew, this would fail
    moved = camera.at(np.eye(4))
    np.testing.assert_array_equal(faces_for(moved)[0].T_world_camera, np.eye(4))


def test_mistakes_are_told():
    narrow = np.diag([5000.0, 5000.0, 1.0])
    narrow[:2, 2] = 1e6
    blind = Camera("blind", (320, 240), narrow, lens=Lens("brown", (-0.45, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(ArgumentError, match="its lens sees nothing"):
        faces_for(blind)


def test_a_face_fills_the_pixels_whose_centers_it_holds(rng: np.random.Generator) -> None:
    """Also where a side is level or upright, where the face is thin, and where it ends beside the picture."""
    width, height = 40, 30
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    faces, filled = np.array([[0, 1, 2]]), 0
    for attempt in range(300):
        corners = rng.uniform(-15.0, 55.0, (3, 3))
        corners[:, 2] = rng.uniform(0.5, 2.0, 3)
        if attempt % 3 == 0:
            corners[1, attempt % 2] = corners[0, attempt % 2]
        elif attempt % 3 == 1:
            corners[2, :2] = corners[1, :2] + rng.uniform(-1.0, 1.0, 2)
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        w = ((y - ay) * (bx - ax) - (x - ax) * (by - ay)) / area
        inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (area < 0.0)
        behind = corners * [1.0, 1.0, 0.5]
        surfaces = [(behind, faces), (corners, faces), (behind, faces)]
        nearness, first = nearest_faces(surfaces, (width, height), farthest=0.0)
        np.testing.assert_array_equal(first, np.where(inside, 1, -1))
        plane = az + v * (bz - az) + w * (cz - az)
        np.testing.assert_allclose(nearness, np.where(inside, plane, 0.0), rtol=1e-6)
        filled += inside.sum()
    assert filled > 1000
