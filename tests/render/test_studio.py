"""Keypoints that a picture shows, against rays cast by embree past the same skin."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gloves import attach, load_layout
from handsim import Camera, HandModel, join_qpos, look_at
from handsim.hand.model import KEYPOINT_DIGITS, hand_keypoints, keypoint_thickness
from handsim.hand.shape import DIGITS, PALM, bones_of
from handsim.space.camera import pinhole
from poses import sample_poses
from render import Pictures
from render.frames import FOREARM
from render.painting.figures import HandFigure, sample_people
from render.painting.rasterizer import Triangles, join, rasterize
from render.skin.look import ALL_TONES
from render.studio import hand_truth

pytest.importorskip("embreex")
POSES = 80
CAMERA = pinhole("vga", (640, 480), 600.0)
TIPS = np.arange(4, 21, 4)


@pytest.fixture(scope="module")
def figure() -> HandFigure:
    people = sample_people(1, False, tones=ALL_TONES, rng=np.random.default_rng(0))
    return HandFigure(attach(load_layout("dense19"), HandModel.named("M")), people[0], first_marker=0)


def cast(mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) of the first surface along each ray, infinite for none, and the face there."""
    hits, rays, faces = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    distance, face = np.full(len(origins), np.inf), np.full(len(origins), -1)
    distance[rays], face[rays] = np.linalg.norm(hits - origins[rays], axis=1), faces
    return distance, face


def photographed(figure: HandFigure, qpos: np.ndarray, rng: np.random.Generator) -> tuple:
    surface = join([one.triangles for one in figure.drawn(qpos, 0)])
    center, way = figure.fit.model.skin(qpos[None])[0].mean(axis=0), rng.normal(size=3)
    camera = CAMERA.at(look_at(center + 0.6 * way / np.linalg.norm(way), center))
    return surface, camera, rasterize(camera, surface, with_normals=False)


def own_part(keypoint: int, part: int) -> bool:
    """Whether a part of the picture is the keypoint's own digit, or the palm where that is beside it."""
    digit, bone = KEYPOINT_DIGITS[keypoint], part - 1
    if digit < 0:
        return bone in (PALM, FOREARM)
    return (
        bone in bones_of(DIGITS[digit])
        or (bone == PALM and keypoint % 4 == 1)
        or (keypoint, bone) == (2, PALM)
    )


def test_keypoints_are_seen_where_rays_say_so(figure):
    rng, model = np.random.default_rng(17), figure.fit.model
    wrong, seen = np.zeros(21), np.zeros(21)
    for qpos in sample_poses(model, POSES, rng=rng):
        surface, camera, pictures = photographed(figure, qpos, rng)
        truth = hand_truth(figure, qpos, 0, camera, pictures)
        eye, turned = camera.T_world_camera[:3, 3], camera.T_world_camera[:3, :3]
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        rays = camera.unproject(np.floor(truth.keypoints) + 0.5)  # through the pixel that a keypoint is in
        distance, faces = cast(mesh, np.tile(eye, (21, 1)), rays @ turned.T)
        local = camera.local(truth.keypoints_world)
        under = np.linalg.norm(local, axis=1) * (1.0 - distance * rays[:, 2] / local[:, 2])
        own = [face >= 0 and own_part(n, int(surface.parts[face])) for n, face in enumerate(faces)]
        expected = (under <= keypoint_thickness(model.shape)) & own
        wrong += truth.visible != expected
        seen += expected
        columns, rows = truth.keypoints[truth.visible].astype(int).T
        assert (pictures.instances[rows, columns] == 1).all(), "seen keypoints are on their hand"
        behind = local[truth.visible, 2] - pictures.depth[rows, columns]
        assert (behind <= keypoint_thickness(model.shape)[truth.visible]).all()
    assert wrong[TIPS].sum() <= 0.01 * 5 * POSES, f"tips: {wrong[TIPS]}"
    assert wrong.sum() <= 0.005 * 21 * POSES, wrong
    assert 0.3 < seen.mean() / POSES < 0.9, "the test needs both"


def plate(camera: Camera, away: float) -> Triangles:
    """A square before the camera, with the id of another thing."""
    corners = np.array([[-1.0, -1.0, away], [1, -1, away], [1, 1, away], [-1, 1, away]])
    corners[:, :2] *= 0.5
    world = corners @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    ids = [np.full(2, number, dtype=np.uint8) for number in (0, 2, 0)]
    normals = np.tile(-camera.T_world_camera[:3, 2], (4, 1))
    return Triangles(world, np.array([[0, 2, 1], [0, 3, 2]]), normals, *ids)


def test_what_is_in_front_of_a_hand_hides_all_of_it(figure):
    rng = np.random.default_rng(2)
    qpos = join_qpos(np.zeros((1, 20)))[0]
    surface, camera, bare = photographed(figure, qpos, rng)
    depths = camera.local(hand_keypoints(figure.fit.model, qpos[None])[0])[:, 2]

    def visible(pictures: Pictures) -> np.ndarray:
        return hand_truth(figure, qpos, 0, camera, pictures).visible

    assert visible(bare).sum() > 10
    # A plate a millimeter before a joint is inside its flesh, but no flesh.
    for away, rest in ((depths.min() - 0.001, 0), (depths.max() + 0.2, visible(bare).sum())):
        pictures = rasterize(camera, join([surface, plate(camera, away)]), with_normals=False)
        assert visible(pictures).sum() == rest
