"""Keypoints that a picture shows, against rays cast by embree past the same skin."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gloves import RigidBody, Take, attach, load_layout, load_take
from handsim import Camera, HandModel, join_qpos, look_at
from handsim.errors import HandSimWarning
from handsim.hand.model import KEYPOINT_DIGITS, hand_keypoints, keypoint_thickness
from handsim.hand.shape import DIGITS, PALM, bones_of
from handsim.space.camera import pinhole
from handsim.space.objects import load_object, named_object
from poses import sample_poses
from render import Pictures, draw
from render.frames import FOREARM
from render.painting.figures import BodyFigure, HandFigure, sample_appearance
from render.painting.rasterizer import Triangles, join, rasterize
from render.skin.look import ALL_TONES
from render.studio import hand_truth

pytest.importorskip("embreex")
POSES = 80
CAMERA = pinhole("vga", (640, 480), 600.0)
TIPS = np.arange(4, 21, 4)


@pytest.fixture(scope="module")
def figure() -> HandFigure:
    look = sample_appearance(False, tones=ALL_TONES, rng=np.random.default_rng(0))
    return HandFigure(attach(load_layout("dense19"), HandModel.named("M")), look, first_marker=0)


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


def test_an_object_of_ones_own_is_drawn_where_embree_finds_it(tmp_path):
    profile = [(0.0, 0.0), (0.035, 0.0), (0.035, 0.12), (0.012, 0.16), (0.012, 0.2), (0.0, 0.2)]
    trimesh.creation.revolve(profile, sections=32).export(tmp_path / "bottle.obj")
    bottle = load_object(tmp_path / "bottle.obj")
    fit, poses = (
        attach(load_layout("dense19"), HandModel.named("M")),
        np.tile([0, 0, 0, 1.0, 0, 0, 0], (1, 1, 1)),
    )
    poses[..., :3] = 0.08, 0.12, -0.05
    qpos = join_qpos(np.zeros((1, 20)))[:, None]
    take = Take.of_poses([fit], qpos, rate=60.0, bodies=[RigidBody.of(bottle)], body_poses=poses)
    take.save(tmp_path / "take.npz")
    for one in (take, load_take(tmp_path / "take.npz")):
        camera = CAMERA.at(look_at(np.array([0.5, 0.6, 0.3]), np.array([0.08, 0.06, 0.03])))
        (frame,) = draw(one, camera=camera, background="plain", painter="compiled", depth_sensor=None)
        mesh = trimesh.Trimesh(bottle.vertices + poses[0, 0, :3], bottle.faces, process=False)
        rays = camera.rays().reshape(-1, 3)
        eyes = np.tile(camera.T_world_camera[:3, 3], (len(rays), 1))
        distance, _ = cast(mesh, eyes, rays @ camera.T_world_camera[:3, :3].T)
        depth = (distance * rays[:, 2]).reshape(480, 640)
        theirs, mine = np.isfinite(depth) & (frame.ids != 1), frame.ids == 2
        assert theirs.sum() > 5000 and (theirs & mine).sum() >= 0.995 * (theirs | mine).sum()
        assert np.quantile(np.abs(frame.depth - depth)[theirs & mine], 0.99) < 1e-5
        assert np.median(np.abs(frame.rgb[mine].astype(int) - frame.rgb[0, 0]).max(axis=1)) > 5
        assert [body.name for body in frame.bodies] == ["bottle.obj"]


def test_edges_of_an_object_are_sharp_and_round_sides_are_smooth():
    for name, most in (("box", 1e-6), ("ball", 6.0), ("mug", 35.0)):
        thing = named_object(name)
        (surface, *_) = BodyFigure(RigidBody.of(thing), (0.5, 0.5, 0.5)).drawn(np.eye(4), 1)
        triangles = surface.triangles
        corners = triangles.vertices[triangles.faces]
        np.testing.assert_array_equal(corners, thing.vertices[thing.faces])
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        faces /= np.linalg.norm(faces, axis=1, keepdims=True)
        cosines = np.einsum("fki,fi->fk", triangles.normals[triangles.faces], faces)
        assert np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0))).max() <= most
        assert (len(triangles.vertices) == len(thing.vertices)) == (name == "ball")


def test_a_body_that_nothing_is_known_of_is_told(figure):
    poses = np.tile([0, 0, 0, 1.0, 0, 0, 0], (1, 1, 1))
    body = RigidBody("bottle.obj", (), np.empty((0, 3)))
    take = Take.of_poses(
        [figure.fit], join_qpos(np.zeros((1, 20)))[:, None], rate=60.0, bodies=[body], body_poses=poses
    )
    with pytest.warns(HandSimWarning, match="bottle.obj has neither a surface nor markers and is not drawn"):
        next(draw(take, passes=("ids",)))


def test_markers_stand_on_bases_that_reach_the_cloth():
    glove = sample_appearance(True, tones=ALL_TONES, rng=np.random.default_rng(0))
    layout = load_layout("dense19")
    figure = HandFigure(attach(layout, HandModel.named("M")), glove, first_marker=0)
    qpos = join_qpos(np.zeros((1, 20)))[0]
    skin, _, bases = (one.triangles for one in figure.drawn(qpos, 0))
    markers, ends = figure.fit.markers(qpos[None])[0][0], bases.vertices.reshape(len(layout.names), 2, -1, 3)
    away = np.linalg.norm(ends - markers[:, None, None], axis=-1)
    assert (away[:, 1] < layout.radius).all() and (away[:, 0] > 0.99 * layout.heights[:, None]).all()
    middles = ends.mean(axis=2)[:, 0]
    np.testing.assert_allclose(np.linalg.norm(markers - middles, axis=-1), layout.heights, atol=1e-9)
    nearest = np.linalg.norm(middles[:, None] - skin.vertices, axis=-1).min(axis=1)
    assert nearest.max() < 0.004 and not bases.markers.any() and (bases.instances == 1).all()
    corners = bases.vertices[bases.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((facing * bases.normals[bases.faces[:, 0]]).sum(axis=-1) > 0.0).all()
