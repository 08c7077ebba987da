from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim import Camera, HandSimError, load_rig, look_at
from handsim.space.camera import preset
from render import Backgrounds, RenderConfig, RenderedFrame, ViewConfig, draw
from render.frames import Geometry
from render.scenery.backgrounds import (
    KINDS,
    Backdrop,
    Background,
    Enclosure,
    draw_background,
    draw_surroundings,
    enclose,
    kept_background,
    photos_beside,
    sample_background,
    surroundings_of_picture,
)
from render.scenery.rooms import draw_room
from train import simulate_take

SIZE = (160, 120)
DRAWN = [kind for kind in KINDS if kind != "photo"]
MIDDLE = np.array([0.1, -0.2, 1.1])
POSITIONS = MIDDLE + np.array([[0.0, 0.0, 0.0], [0.5, -0.6, 0.3], [0.56, -0.55, 0.3], [-1.0, 0.3, 0.9]])
LAMP = np.array([0.3, -0.2, 0.9])


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Two photographs, one of them in a subfolder, and files that are none."""
    folder = tmp_path / "photos"
    (folder / "more").mkdir(parents=True)
    assert cv2.imwrite(str(folder / "blue.png"), np.full((300, 500, 3), (200, 10, 10), dtype=np.uint8))
    assert cv2.imwrite(str(folder / "more" / "red.jpg"), np.full((90, 70, 3), (10, 10, 200), dtype=np.uint8))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph at all")
    (folder / "empty.png").write_bytes(b"")
    (folder / "notes.txt").write_text("not a picture", encoding="utf-8")
    return folder


def only(kind: str, **more: str) -> Backgrounds:
    return Backgrounds({kind: 1.0}, **more)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "photo"])
def test_backgrounds_repeat_and_differ(kind: str) -> None:
    first, again, other = (sample_background(only(kind), rng=np.random.default_rng(s)) for s in (1, 1, 2))
    assert first == again
    assert first.kind == kind
    picture = draw_background(first, SIZE)
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.float32
    assert picture.min() >= 0.0
    assert picture.max() <= 1.0
    kept_background.cache_clear()
    assert picture.tobytes() == draw_background(again, SIZE).tobytes()
    assert np.abs(picture - draw_background(other, SIZE)).max() > 0.01
    values = json.loads(json.dumps(dataclasses.asdict(first)))
    assert (draw_background(Background(**values), SIZE) == picture).all()


def test_what_each_kind_is() -> None:
    def spread(kind: str, seed: int) -> float:
        background = sample_background(only(kind), rng=np.random.default_rng(seed))
        return float(np.ptp(draw_background(background, SIZE), axis=(0, 1)).max())

    assert max(spread("plain", seed) for seed in range(5)) == 0.0
    for kind in ("gradient", "room"):
        assert np.median([spread(kind, seed) for seed in range(5)]) > 0.1


def test_shares_are_kept(rng: np.random.Generator) -> None:
    config = Backgrounds({"plain": 1.0, "gradient": 3.0})
    kinds = [sample_background(config, rng=rng).kind for _ in range(400)]
    assert set(kinds) == {"plain", "gradient"}
    assert 0.66 < kinds.count("gradient") / 400 < 0.84


def test_photographs_fill_the_picture_and_broken_files_are_passed_over(photos: Path) -> None:
    config = only("photo", photos=str(photos))
    seen = set()
    for seed in range(12):
        background = sample_background(config, rng=np.random.default_rng(seed))
        assert background.photo is not None
        seen.add(Path(background.photo).name)
        picture = draw_background(background, SIZE)
        assert picture.shape == (120, 160, 3)
        assert picture[..., 1].max() < 0.01
        blue = Path(background.photo).name == "blue.png"
        assert picture[..., 2 if blue else 0].min() > 0.4
        assert picture[..., 0 if blue else 2].max() < 0.05
    assert seen == {"blue.png", "red.jpg"}


def test_photographs_are_cut_and_neither_repeated_nor_mirrored(tmp_path: Path) -> None:
    wide = np.repeat(np.linspace(20, 230, 400, dtype=np.uint8)[None], 100, axis=0)
    cv2.imwrite(str(tmp_path / "ramp.png"), np.dstack([wide] * 3))
    background = Background("photo", ((0.1, 0.1, 0.1),) * 2, 0, photo=str(tmp_path / "ramp.png"))
    for seed in range(4):
        picture = draw_background(dataclasses.replace(background, seed=seed), (64, 96))
        assert (np.diff(picture[..., 0], axis=1) >= 0.0).all() and np.ptp(picture[0, :, 0]) > 0.0
    several = tmp_path / "several"
    several.mkdir()
    for number in range(7):
        cv2.imwrite(str(several / f"{number}.png"), np.full((40, 60, 3), 30 * number, np.uint8))
    (several / "0broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph at all")
    walls = photos_beside(several / "5.png", 6)
    assert walls[0] == several / "5.png" and len(set(walls)) == 6 and several / "0broken.jpg" not in walls


def test_folders_without_photographs_are_told(photos: Path, tmp_path: Path) -> None:
    for name in ("blue.png", "more/red.jpg"):
        (photos / name).unlink()
    with pytest.raises(HandSimError, match=r"photos: no photograph that can be read"):
        sample_background(only("photo", photos=str(photos)), rng=np.random.default_rng(0))
    with pytest.raises(HandSimError, match="no such folder"):
        sample_background(only("photo", photos=str(tmp_path / "none")), rng=np.random.default_rng(0))
    (tmp_path / "room.hdr").touch()
    with pytest.raises(HandSimError, match=r"room\.hdr: a file, expected a folder of photographs"):
        sample_background(only("photo", photos=str(tmp_path / "room.hdr")), rng=np.random.default_rng(0))


def test_impossible_configs_are_told() -> None:
    with pytest.raises(HandSimError, match="shares of backgrounds"):
        Backgrounds({"plain": 0.0})
    with pytest.raises(HandSimError, match="shares of backgrounds"):
        Backgrounds({"plain": -1.0})
    with pytest.raises(HandSimError, match="`photos`"):
        Backgrounds({"photo": 1.0})
    with pytest.raises(HandSimError, match=r"unknown background .rom. .did you mean .room."):
        draw_background(Background("rom", ((0.1, 0.1, 0.1),) * 2, 0), SIZE)  # type: ignore[arg-type]
    gone = Background("photo", ((0.1, 0.1, 0.1),) * 2, 0, photo="/nowhere/a.jpg")  # type: ignore[arg-type]
    with pytest.raises(HandSimError, match=r"/nowhere/a\.jpg: not a readable photograph"):
        draw_background(gone, SIZE)


def test_edges_of_rooms_are_smooth() -> None:
    """Nearly as the mean over sixteen rays has them."""
    for seed in (1, 2):
        coarse, fine = (draw_room((80 * k, 60 * k), seed).light for k in (1, 4))
        mean = fine.reshape(60, 4, 80, 4, 3).mean(axis=(1, 3))
        off = np.abs(cv2.GaussianBlur(mean, (0, 0), 0.9) - coarse)
        assert np.quantile(off, 0.99) < 0.06


def pair(name: str = "vga") -> list[Camera]:
    return [preset(name).at(look_at(position, MIDDLE)) for position in POSITIONS[1:3]]


def background(kind: str, seed: int = 3) -> Background:
    return Background(kind, ((0.7, 0.5, 0.3), (0.1, 0.2, 0.4)), seed)  # type: ignore[arg-type]


def seen_twice(first: Camera, second: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of one camera's depth in the other: pixels (H, W, 2) and depth there, and which are inside."""
    rays = first.rays()
    points = rays / np.where(depth > 0.0, rays[..., 2], 1.0)[..., None] * depth[..., None]
    world = points @ first.T_world_camera[:3, :3].T + first.T_world_camera[:3, 3]
    pixels = second.project(world.reshape(-1, 3)).reshape(*depth.shape, 2)
    inside = ((pixels >= 1.0) & (pixels < np.array(second.size) - 1.0)).all(axis=-1) & (depth > 0.0)
    return pixels.astype(np.float32), second.local(world)[..., 2], inside


def looked_up(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return cv2.remap(picture, np.nan_to_num(pixels) - 0.5, None, cv2.INTER_LINEAR)


@pytest.mark.parametrize("camera", ["vga", "headset_fisheye"])
@pytest.mark.parametrize("kind", DRAWN)
def test_two_cameras_see_one_place(kind: str, camera: str) -> None:
    box = enclose(POSITIONS, 5, LAMP)
    first, second = pair(camera)
    one, two = (draw_surroundings(background(kind), box, view, bright=False) for view in (first, second))
    pixels, depth, inside = seen_twice(first, second, one.depth)
    assert inside.mean() > (0.5 if camera == "vga" else 0.3)
    there = looked_up(two.depth, pixels)
    same = inside & (np.abs(there - depth) < 0.01 * depth)
    assert same.sum() > 0.9 * inside.sum(), "but for what furniture hides"
    difference = np.abs(looked_up(two.rgb, pixels).astype(int) - one.rgb).max(axis=-1)[same]
    assert np.median(difference) <= 3 and np.percentile(difference, 90) <= 12
    rows, columns = np.mgrid[: one.depth.shape[0], : one.depth.shape[1]] + 0.5
    moved = np.linalg.norm(pixels - np.stack([columns, rows], axis=-1), axis=-1)[same]
    assert np.ptp(moved) > 3.0, "parallax: what is near moves more"


@pytest.mark.parametrize("name", ["vga", "headset_fisheye"])
def test_edges_of_rooms_around_cameras_are_smooth(name: str) -> None:
    """A pixel is near the mean of the sixteen pixels of a picture of four times the size."""
    box, (fine, _) = enclose(POSITIONS, 5, LAMP), pair(name)
    small = np.diag([0.25, 0.25, 1.0])
    coarse = dataclasses.replace(fine, size=(fine.size[0] // 4, fine.size[1] // 4), K=small @ fine.K)
    one, other = (
        (draw_surroundings(background("room", 3), box, camera, bright=True).rgb / 255.0) ** 2.2
        for camera in (coarse, fine)
    )
    height, width = one.shape[:2]
    mean = other[: 4 * height, : 4 * width].reshape(height, 4, width, 4, 3).mean(axis=(1, 3))
    assert np.quantile(np.abs(mean - one), 0.99) < 0.035  # 0.04 and 0.07 with one ray a pixel


def test_a_camera_that_was_changed_in_place_is_drawn_anew() -> None:
    box, (camera, _) = enclose(POSITIONS, 5, LAMP), pair("headset_fisheye")
    before = draw_surroundings(background("gradient"), box, camera, bright=False).depth
    camera.K[:2, :2] *= 0.8
    zoomed = draw_surroundings(background("gradient"), box, camera, bright=False).depth
    camera.T_world_camera[2, 3] += 0.05
    moved = draw_surroundings(background("gradient"), box, camera, bright=False).depth
    assert not np.array_equal(before, zoomed) and not np.array_equal(zoomed, moved)
    assert preset("headset_fisheye").K[0, 0] > camera.K[0, 0], "presets are copies"


def test_an_empty_box_is_where_it_says() -> None:
    box = Enclosure((-1.0, -2.0, 0.0), (2.0, 1.5, 2.5), ((-0.5,) * 3, (0.5,) * 3), (0.0, 0.0, 2.0))
    camera = preset("vga").at(look_at(np.array([0.0, 0.0, 1.2]), np.array([0.5, 0.9, 1.0])))
    seen = draw_surroundings(background("gradient"), box, camera, bright=False)
    rays = camera.rays()
    points = rays / rays[..., 2:] * seen.depth[..., None]
    world = points @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    off = np.minimum(np.abs(world - box.low), np.abs(world - box.high)).min(axis=-1)
    assert off.max() < 1e-5
    assert (world > np.array(box.low) - 1e-5).all() and (world < np.array(box.high) + 1e-5).all()
    height, width = seen.depth.shape
    empty = np.zeros((height, width), dtype=np.uint8)
    bare = np.zeros((height, width, 3), dtype=np.float32)
    filled = Geometry(empty.astype(np.float32), bare, empty, empty, empty)
    seen.put_behind(filled)
    assert filled.normals is not None and filled.depth is not None
    np.testing.assert_array_equal(filled.depth, seen.depth)
    np.testing.assert_allclose(np.linalg.norm(filled.normals, axis=-1), 1.0, atol=1e-6)
    assert ((filled.normals * rays).sum(axis=-1) < 0.0).all(), "surfaces face the camera"


def test_a_wall_is_the_plane_that_catches_shadows() -> None:
    camera, wall = preset("d435"), Backdrop(0.1, (0.3, -0.2))
    one = dataclasses.replace(background("gradient"), backdrop=wall)
    seen = surroundings_of_picture(one, camera, -0.7)
    rays = camera.rays()
    points = rays / rays[..., 2:] * seen.depth[..., None]
    assert (seen.depth > 0.3).all() and seen.rgb.size == 0
    np.testing.assert_allclose(points @ wall.normal, -0.7, atol=1e-5)
    np.testing.assert_allclose(seen.facing[seen.walls], np.broadcast_to(wall.normal, points.shape), atol=1e-6)


@pytest.mark.parametrize("size", [(640, 480), (321, 243)])
def test_a_room_of_one_camera_is_made_of_planes(size: tuple[int, int]) -> None:
    """Also for a camera of another angle of view, off its axis: the normals are those of the depth."""
    K = np.array([[700.0, 0.0, 0.3 * size[0]], [0.0, 700.0, 0.6 * size[1]], [0.0, 0.0, 1.0]])
    camera = Camera("own", size, K)
    rays = camera.rays() / camera.rays()[..., 2:]
    for seed in range(5):
        seen = surroundings_of_picture(background("room", seed), camera, -1.6)
        assert seen.depth.min() == pytest.approx(1.6, rel=0.03) or seen.depth.min() > 1.6
        points, normals = rays * seen.depth[..., None], seen.facing[seen.walls]
        assert ((normals * rays).sum(axis=-1) < 0.0).mean() > 0.995, "surfaces face the camera"
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        found = np.cross(down, across)
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
        cosines = (found * normals[1:-1, 1:-1]).sum(axis=-1)
        assert (cosines > 0.999).mean() > 0.9, "but for edges"
        light = kept_background(background("room", seed), size)
        assert light.shape[0] == size[1] // 2
        edges = np.abs(np.diff(np.log(seen.depth), axis=1)) > 0.2
        assert edges.mean() < 0.02


def test_furniture_keeps_away_from_hands_and_cameras() -> None:
    for seed in range(8):
        box = enclose(POSITIONS, seed, LAMP)
        for camera in pair("headset_fisheye"):
            seen = draw_surroundings(background("room", seed), box, camera, bright=False)
            ahead = seen.depth > 0.0
            assert (seen.depth[ahead] / camera.rays()[ahead][:, 2]).min() > 0.4
            assert (np.array(box.low) < POSITIONS.min(axis=0) - 0.7).all()


@pytest.mark.parametrize(
    "view", [ViewConfig(views=2), ViewConfig("head", views=2), ViewConfig("rig", rig="six")]
)
def test_takes_of_several_cameras_have_one_background(view: ViewConfig) -> None:
    take = simulate_take(kind="hand-hand", num_frames=13)
    config = RenderConfig(view=view, depth_sensor=None, color_sensor=None, painter="compiled", vary="frame")
    frames = list(draw(take, config=config, frames=[0, 12]))
    cameras = len(frames) // 2
    assert cameras == (6 if view.placement == "rig" else 2) == len({frame.camera.name for frame in frames})
    for group in (frames[:cameras], frames[cameras:]):
        assert len({str(frame.choices["enclosure"]) for frame in group}) == 1
        if view.placement != "rig":  # whose long lenses see other walls
            check_pair(group[0], group[1])
    assert frames[0].choices["enclosure"] != frames[-1].choices["enclosure"]


def check_pair(one: RenderedFrame, two: RenderedFrame) -> None:
    assert one.ideal.depth is not None and two.ideal.depth is not None
    pixels, depth, inside = seen_twice(one.camera, two.camera, one.ideal.depth)
    there = looked_up(two.ideal.depth, pixels)
    assert one.ideal.instances is not None
    behind = inside & (one.ideal.instances == 0) & (np.abs(there - depth) < 0.01 * depth)
    if not inside.sum() > 1000:
        return  # cameras of a rig may look past one another
    assert behind.sum() > 0.5 * (inside & (one.ideal.instances == 0)).sum()
    off = np.abs(looked_up(two.ideal.rgb, pixels).astype(int) - one.ideal.rgb).max(axis=-1)[behind]
    assert np.median(off) <= 4


def test_a_rig_sees_photographs_on_the_walls(tmp_path) -> None:
    picture = np.zeros((300, 400, 3), dtype=np.uint8)
    picture[:, ::8] = 255
    file = tmp_path / "stripes.png"
    assert cv2.imwrite(str(file), picture)
    photo = dataclasses.replace(background("photo"), photo=str(file))
    rig = load_rig("six")
    box = enclose(np.concatenate([rig.positions, MIDDLE[None]]), 0, LAMP)
    seen = draw_surroundings(photo, box, preset("vga").at(rig.T_world_camera[0]), bright=False)
    assert seen.rgb.min() < 60 and seen.rgb.max() > 200 and (seen.depth > 0.5).all()
