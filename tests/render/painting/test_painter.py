"""Colors of the compiled painter: where the answer is known, and against OpenGL's."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import attach, load_layout
from handsim import Camera, HandModel, Lens, join_qpos, look_at
from handsim.hand.shape import SIDES, Side
from handsim.space.camera import pinhole
from poses.shapes import gesture
from render.color_sensor import light_of
from render.painting.figures import Drawn, HandFigure, Material, sample_appearance
from render.painting.painter import Painter, paint, put_before
from render.painting.rasterizer import rasterize
from render.scenery.lights import Lamp, Lighting, sample_lighting, surround
from render.skin.look import TONES
from tests.render.scenes import plain, thing

CAMERA = pinhole("small", (96, 72), 90.0)
DARK = (0.0, 0.0, 0.0)


def ball(material: Material, place: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Drawn:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    return thing(mesh.apply_translation(place), material)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(0.05, 1.0))
def test_light_from_everywhere_shows_a_surface_in_its_own_color(level: float, strength: float) -> None:
    picture = paint(CAMERA, [ball(plain(level))], Lighting((), (strength,) * 3))
    inside = picture[..., 3] == 255
    assert inside.sum() > 500
    wanted = 255.0 * (level * strength) ** (1 / 2.2)
    assert np.abs(picture[inside][:, :3] - wanted).max() <= 1.0


def test_a_wall_that_faces_the_lamp_sends_back_its_color_and_a_glint() -> None:
    wall = thing(trimesh.creation.box((8.0, 8.0, 0.1)).apply_translation([0, 0, 2.0]), plain(), smooth=False)
    shown = paint(CAMERA, [wall], Lighting((Lamp((0.0, 0.0, -1.0), 1.0),), DARK))[36, 48]
    # What is not mirrored of its 0.5, and the peak of chalk's microfacets: a quarter of 0.028.
    light = 0.5 * 0.972 * 0.972 + 0.028 / 4
    assert np.abs(shown[:3] - 255.0 * light ** (1 / 2.2)).max() <= 1.5
    behind = paint(CAMERA, [wall], Lighting((Lamp((0.0, 0.0, 1.0), 1.0),), DARK))[36, 48]
    assert behind.tolist() == [0, 0, 0, 255]


def test_bright_pictures_do_not_end_at_white() -> None:
    wall = thing(trimesh.creation.box((8.0, 8.0, 0.1)).apply_translation([0, 0, 2.0]), plain(), smooth=False)
    for strength in (1.0, 4.0, 8.0):
        lighting = Lighting((Lamp((0.0, 0.0, -1.0), strength),), DARK)
        whole, bright = paint(CAMERA, [wall], lighting), paint(CAMERA, [wall], lighting, "bright")
        assert np.abs(np.minimum(bright, 255.0) - whole).max() <= 0.75
        wanted = strength * (0.5 * 0.972 * 0.972 + 0.028 / 4)
        if wanted > 1.0:
            assert light_of(bright[36, 48, :3]) == pytest.approx([wanted] * 3, rel=5e-3)


def test_edges_cover_pixels_in_part_as_much_as_the_surface_does() -> None:
    picture = paint(CAMERA, [ball(plain())], Lighting((), (1.0,) * 3))
    covered = picture[..., 3] / 255.0
    assert set(np.unique(picture[..., 3])) <= {0, 64, 128, 191, 255}
    radius = 90.0 * 0.2 / np.sqrt(1.0 - 0.04)  # of the ball's outline [px]
    assert covered.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    whole = paint(
        dataclasses.replace(CAMERA, size=(192, 144), K=CAMERA.K * [[2], [2], [1]]),
        [ball(plain())],
        Lighting((), (1.0,) * 3),
    )
    folded = whole[..., 3].reshape(72, 2, 96, 2).mean(axis=(1, 3)) / 255.0
    assert np.abs(folded - covered).mean() < 0.003


def test_only_the_first_lamp_casts_shadows() -> None:
    floor = thing(
        trimesh.creation.box((4.0, 4.0, 0.02)).apply_translation([0, 0, 1.6]), plain(), smooth=False
    )
    above = ball(plain(), (-0.15, 0.0, 1.2))
    aslant = (-0.8, 0.0, -1.0)
    first = paint(CAMERA, [floor, above], Lighting((Lamp(aslant, 1.0),), DARK))
    other = paint(CAMERA, [floor, above], Lighting((Lamp((0.0, 0.0, 1.0), 0.0), Lamp(aslant, 1.0)), DARK))
    # The shadow lies where the lamp's ray through the ball's middle meets the floor.
    x = -0.15 + 0.8 * (1.59 - 1.2)
    column = int(90.0 * x / 1.59 + 48)
    assert first[36, column, :3].max() == 0
    assert other[36, column, :3].min() > 100
    far = first[5, 5, :3].astype(int)
    assert far.min() > 100 and np.abs(far - other[5, 5, :3]).max() <= 1


def test_light_under_the_surface_goes_round_the_edge_and_red_goes_farthest() -> None:
    # The far lamp stands to the left; along the middle row the cosine falls from left to right.
    side = Lighting((Lamp((0.0, 0.0, -1.0), 0.0), Lamp((-1.0, 0.0, 0.0), 1.0)), DARK)
    flesh = dataclasses.replace(plain(), scatter=np.array([0.3, 0.1, 0.0]))
    plainly, under = (paint(CAMERA, [ball(one)], side)[36].astype(int) for one in (plain(), flesh))
    lit = [[(row[:, color] > 0).sum() for color in range(3)] for row in (plainly, under)]
    assert lit[0][0] == lit[0][1] == lit[0][2] == lit[1][2]
    assert lit[1][0] > lit[1][1] > lit[1][2]
    brightest = plainly[:, 0].argmax()
    assert np.abs(under[brightest] - plainly[brightest]).max() <= 12
    np.testing.assert_array_equal(under[:, 2], plainly[:, 2])


def test_a_ball_casts_no_shadow_on_its_lit_side() -> None:
    lamp = Lighting((Lamp((-0.5, -0.5, -1.0), 1.0),), DARK)
    hidden = Lighting((Lamp((0.0, 0.0, 1.0), 0.0), Lamp((-0.5, -0.5, -1.0), 1.0)), DARK)
    shown, free = (paint(CAMERA, [ball(plain())], light).astype(int) for light in (lamp, hidden))
    assert np.abs(shown - free).max() <= 2


def six_views() -> list[Camera]:
    """Cameras all around, each with another roll."""
    cameras = []
    for number, way in enumerate(np.concatenate([np.eye(3), -np.eye(3)]) + 0.1):
        turn = trimesh.transformations.rotation_matrix(np.deg2rad(47.0 * number), [0, 0, 1])
        cameras.append(CAMERA.at(look_at(way / np.linalg.norm(way), np.zeros(3)) @ turn))
    return cameras


def test_light_stays_where_it_is_for_cameras_all_around_and_rolled_ones() -> None:
    lighting = sample_lighting(rng=np.random.default_rng(5))
    lighting = surround(lighting, np.random.default_rng(6).random((9, 3)) * 0.1, 0.5)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    for camera in six_views():
        painted = paint(camera, [thing(mesh, plain(0.4))], lighting)
        truth = rasterize(camera, thing(mesh, plain()).triangles)
        assert truth.normals is not None
        rows, columns = np.nonzero((painted[..., 3] == 255) & (truth.depth > 0.0))
        normals = truth.normals[rows, columns] @ camera.T_world_camera[:3, :3].T
        x, y, z = normals.T
        around = [np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
        light = 0.4 * np.maximum(np.stack(around, axis=1) @ np.array(lighting.surroundings), 0.0)
        views = -truth.depth[rows, columns, None] * camera.rays()[rows, columns]
        views = views / np.linalg.norm(views, axis=1, keepdims=True) @ camera.T_world_camera[:3, :3].T
        facing, edge = (normals * views).sum(axis=1), np.zeros(len(rows), dtype=bool)
        for lamp in lighting.lamps:
            towards = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
            half = towards + views
            fresnel = 0.028 + 0.972 * (1.0 - 0.5 * np.linalg.norm(half, axis=1)) ** 5
            cosine = np.maximum(normals @ towards, 0.0)
            mirrored = cosine * fresnel / (4.0 * (0.5 * facing + 0.5) * (0.5 * cosine + 0.5))
            matt = 0.4 * 0.972 * (1.0 - fresnel) * cosine
            light += (lamp.strength * (matt + mirrored))[:, None] * lamp.color
            edge |= np.abs(normals @ towards) < 0.1  # beside the edge of a shadow
        shown = (painted[rows, columns, :3] / 255.0) ** 2.2
        ratio = (shown / light)[~edge & (light.min(axis=1) > 0.02) & (facing > 0.3)]
        assert len(ratio) > 200
        assert np.abs(np.median(ratio, axis=0) - 1.0).max() < 0.01
        assert np.abs(np.quantile(ratio, [0.1, 0.9]) - 1.0).max() < 0.03


def test_a_rolled_camera_and_the_faces_of_a_lens_see_the_same_shading() -> None:
    rotation = np.linalg.qr(np.ones((3, 3)) + np.eye(3))[0]
    lighting = sample_lighting(rng=np.random.default_rng(2)).turned(rotation)
    drawn = [ball(plain(0.4)), ball(plain(0.4), (0.5, 0.0, 0.8))]
    half_turn = CAMERA.at(np.diag([-1.0, -1.0, 1.0, 1.0]))
    upright, rolled = (paint(camera, drawn, lighting).astype(int) for camera in (CAMERA, half_turn))
    assert np.abs(upright - rolled[::-1, ::-1]).max() <= 2
    # Straight ahead, and turned so that the edge of the cube's face runs through the first ball.
    K = np.array([[90.0, 0, 150], [0, 90, 150], [0, 0, 1]])
    fisheye = Camera("bent", (300, 300), K, lens=Lens("fisheye", (0.0,) * 4))
    aside = fisheye.at(look_at(np.zeros(3), np.array([1.0, 0.0, 1.0])))
    ahead, turned = (paint(camera, drawn, lighting).astype(int) for camera in (fisheye, aside))
    rays = aside.rays() @ aside.T_world_camera[:3, :3].T
    there = fisheye.project(rays.reshape(-1, 3)).reshape(300, 300, 2).astype(np.float32) - 0.5
    again = cv2.remap(ahead.astype(np.float32), there, None, cv2.INTER_LINEAR)
    whole = (
        cv2.erode(((turned[..., 3] == 255) & (again[..., 3] == 255)).astype(np.uint8), np.ones((5, 5))) > 0
    )
    assert whole.sum() > 1000
    off = np.abs(turned - again)[whole][:, :3]
    assert off.mean() < 1.0 and np.quantile(off, 0.99) <= 5.0


def hand(side: Side, tone: str, seed: int) -> tuple[Camera, list[Drawn]]:
    rng = np.random.default_rng(seed)
    model = HandModel.named("M", side=side)
    look = sample_appearance(False, tones=TONES[tone], rng=rng)
    qpos = join_qpos(gesture("relaxed")[None])
    figure = HandFigure(attach(load_layout("dense19"), model), look, first_marker=0)
    eye = rng.normal(size=3)
    place = np.array([0.07, 0.0, 0.0])
    camera = pinhole("some", (160, 120), 170.0).at(look_at(place + 0.45 * eye / np.linalg.norm(eye), place))
    return camera, figure.drawn(qpos[0], 0)


def without_scatter(drawn: list[Drawn]) -> list[Drawn]:
    """The same with materials that pyrender's shader knows."""
    materials = [dataclasses.replace(one.material(), scatter=np.zeros(3)) for one in drawn]
    return [
        dataclasses.replace(one, material=functools.partial(lambda material: material, material))
        for one, material in zip(drawn, materials, strict=True)
    ]


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("tone", ["light", "dark"])
def test_opengl_paints_the_same(side: Side, tone: str) -> None:
    for seed in range(3):
        camera, drawn = hand(side, tone, seed)
        drawn, lighting = without_scatter(drawn), sample_lighting(rng=np.random.default_rng(seed))
        names: tuple[Painter, Painter] = ("compiled", "opengl")
        ours, theirs = (paint(camera, drawn, lighting, name).astype(int) for name in names)
        both = (ours[..., 3] == 255) & (theirs[..., 3] == 255)
        off = np.abs(ours - theirs)[both][:, :3]
        assert both.sum() > 1500
        assert np.median(off) <= 1.0
        assert off.mean() < 4.0
        assert np.abs(ours[..., 3] - theirs[..., 3]).mean() < 1.5


def test_colors_lie_where_the_ids_are() -> None:
    camera, drawn = hand("right", "tan", 1)
    painted = paint(camera, drawn, sample_lighting(rng=np.random.default_rng(0)))
    truth = rasterize(camera, drawn[0].triangles)
    inside = truth.parts > 0
    assert (painted[..., 3][inside] >= 64).all()
    assert (painted[..., 3][~inside] < 255).mean() > 0.99


def test_nothing_gives_nothing_and_a_background_shows_through(rng: np.random.Generator) -> None:
    behind = rng.uniform(0.0, 255.0, (72, 96, 3)).astype(np.float32)
    empty = paint(CAMERA, [], Lighting((), DARK))
    assert not empty.any()
    np.testing.assert_array_equal(put_before(empty, behind), behind.astype(np.uint8))
    half = np.full((72, 96, 4), 128, dtype=np.uint8)
    mixed = put_before(half, behind)
    np.testing.assert_allclose(mixed, np.minimum(128 + (1 - 128 / 255) * behind, 255), atol=1.001)
