"""Takes drawn in shards: truth agrees with pictures, work goes on where it stopped, bytes are the same."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from handsim.errors import CaptureError, HandSimError
from render.cameras.viewpoints import ViewConfig, Viewpoints
from render.config import RenderConfig
from render.formats.png_depth import read_depth
from render.frames.keypoints import KEYPOINT_DIGITS
from render.painting.figures import digit_of_part
from render.sensors.depth_noise import DepthNoiseConfig
from render.session import SHEET, draw_shard, render_take
from render.shown_take import load_shown_take
from render.skin.look import TONES
from train.simulation.takes import TakeConfig, simulate_take


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("take") / "take.truth.npz"
    simulate_take(TakeConfig(kind="hand-controller", num_frames=48)).save(file)
    return file


MAIN = "import sys; from handsim.app.cli import main; sys.exit(main())"
PLAIN = RenderConfig(
    view=ViewConfig(camera="vga", views=2), depth_sensor=None, color_sensor=None, every=12, frames_per_shard=2
)


def drawn(path, config):
    take = load_shown_take(path)
    viewpoints = Viewpoints(config.view, take, rng=np.random.default_rng(0))
    return list(draw_shard(take, viewpoints, config, 0, [0, 24]))


@pytest.mark.parametrize("dress", ["skin", "glove"])
def test_truth_agrees_with_the_pictures(path, dress):
    for frame in drawn(path, dataclasses.replace(PLAIN, dress=dress)):
        pictures = frame.ideal
        assert pictures.rgb.shape == (480, 640, 3) and frame.noisy.rgb is None and frame.noisy.depth is None
        shown = pictures.instances > 0
        np.testing.assert_array_equal(shown, pictures.depth > 0.0)
        np.testing.assert_allclose(np.linalg.norm(pictures.normals[shown], axis=-1), 1.0, atol=1e-5)
        assert set(np.unique(pictures.instances)) <= {0, 1, 2, 3}
        for number, hand in enumerate(frame.hands):
            columns, rows = hand.pixels[hand.visible].astype(int).T
            digits = digit_of_part(pictures.parts[rows, columns], number)
            own = np.array(KEYPOINT_DIGITS)[hand.visible]
            knuckle = np.flatnonzero(hand.visible) % 4 == 1
            assert ((digits == own) | (knuckle & (digits == -1))).all()
            assert (pictures.instances[rows, columns] == number + 1).all()
            assert len(hand.markers) == (19 if dress == "glove" else 0)
        if dress == "glove":
            check_markers(frame)
        json.dumps(frame.choices)
    assert np.ptp(pictures.rgb.reshape(-1, 3).astype(int), axis=0).min() > 30, "a picture shows something"


def check_markers(frame):
    """What is drawn as a marker lies where the marker is."""
    markers = np.concatenate([hand.markers for hand in frame.hands])
    for number in np.unique(frame.ideal.markers[frame.ideal.markers > 0]):
        rows, columns = np.nonzero(frame.ideal.markers == number)
        middle = frame.camera.project(markers[number - 1])
        assert np.linalg.norm(np.array([columns.mean(), rows.mean()]) + 0.5 - middle) < 8.0


def test_sensors_and_lenses(path):
    config = RenderConfig(
        view=ViewConfig(camera="headset_fisheye", placement="head"), every=24, passes=("rgb", "depth", "ids")
    )
    for frame in drawn(path, config):
        assert frame.noisy.rgb.shape == frame.ideal.rgb.shape and (frame.noisy.rgb != frame.ideal.rgb).any()
        assert frame.noisy.depth.shape == frame.ideal.depth.shape
        assert frame.ideal.normals is None
        assert all(hand.visible.any() for hand in frame.hands)


def test_depth_sensors_see_hands_of_all_tones_alike(path):
    seen = []
    for tone in ("very light", "dark"):
        config = dataclasses.replace(
            PLAIN, tones=TONES[tone], depth_sensor=DepthNoiseConfig(("azure_kinect",))
        )
        frame = drawn(path, config)[0]
        hands = (frame.ideal.instances == 1) | (frame.ideal.instances == 2)
        seen.append((frame.noisy.depth[hands] > 0.0).mean())
    assert min(seen) > 0.7 and abs(seen[0] - seen[1]) < 0.02


def test_a_rendering_goes_on_where_it_stopped_and_comes_out_the_same(path, tmp_path):
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    assert render_take(path, whole, ["coco", "png"], PLAIN, workers=1) == 8
    assert (whole / SHEET).is_file()
    told = []
    render_take(path, parted, ["coco", "png"], PLAIN, workers=1)
    victim = next((parted / "png").glob("shard-00001"))
    for file in victim.iterdir():
        file.unlink()
    victim.rmdir()
    render_take(path, parted, ["coco", "png"], PLAIN, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(8, 8)]
    names = sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file())
    assert names == sorted(file.relative_to(parted) for file in parted.rglob("*") if file.is_file())
    for name in names:
        assert (whole / name).read_bytes() == (parted / name).read_bytes(), name


def test_a_full_disk_is_one_sentence_and_finished_tars_are_kept(path, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(done: int, wanted: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))

    try:
        with pytest.raises(HandSimError, match=r"writing shard 1 failed: File too large; shards that were"):
            render_take(path, tmp_path / "out", ["webdataset"], PLAIN, workers=1, progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["render.json", "shard-00000.tar"]
    kept = (tmp_path / "out" / "shard-00000.tar").read_bytes()
    assert render_take(path, tmp_path / "out", ["webdataset"], PLAIN, workers=1) == 8
    assert (tmp_path / "out" / "shard-00000.tar").read_bytes() == kept
    assert (tmp_path / "out" / "shard-00001.tar").is_file()


def test_no_driver_is_one_sentence_where_opengl_is_wanted(path, tmp_path):
    command = [sys.executable, "-c", MAIN, "render", str(path), "--every", "48", "--workers", "1"]
    environment = {**os.environ, "PYOPENGL_PLATFORM": "egl", "EGL_DEVICE_ID": "4711"}
    for painter, code in (("opengl", 1), ("compiled", 0), ("auto", 0)):
        out = tmp_path / painter
        done = subprocess.run(
            [*command, "--out", str(out), "--painter", painter],
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        assert done.returncode == code, done
        saved = json.loads((out / "render.json").read_text())["painter"]
        assert saved == ("opengl" if code else "compiled")
        said = done.stderr.strip()
        if painter == "opengl":
            assert said.startswith("handsim render: drawing without a screen failed (egl: ")
            assert "apt-get install libegl1" in said and "\n" not in said


def test_depth_on_disk_is_in_meters(path, tmp_path):
    render_take(path, tmp_path / "out", ["png"], dataclasses.replace(PLAIN, passes=("depth",)), workers=1)
    depth = read_depth(next((tmp_path / "out").rglob("*depth*.png")))
    assert 0.2 < np.median(depth[depth > 0]) < 1.5


def test_what_cannot_be_drawn_is_said_in_a_sentence(path, tmp_path):
    with pytest.raises(HandSimError, match="unknown format 'gif'"):
        render_take(path, tmp_path / "a", ["gif"], PLAIN)
    with pytest.raises(HandSimError, match="unknown pass 'heat'"):
        RenderConfig(passes=("heat",))
    with pytest.raises(CaptureError, match="cannot be read"):
        render_take(tmp_path / "none.npz", tmp_path / "a", ["coco"], PLAIN)
    render_take(path, tmp_path / "b", ["png"], dataclasses.replace(PLAIN, passes=("depth",)), workers=1)
    with pytest.raises(HandSimError, match="other settings \\(passes\\)"):
        render_take(path, tmp_path / "b", ["png"], PLAIN, workers=1)


def test_a_camera_inside_a_hand_is_refused(path):
    take = load_shown_take(path)
    config = dataclasses.replace(PLAIN, view=ViewConfig(distance=(0.05, 0.05)))
    inside = Viewpoints(config.view, take, rng=np.random.default_rng(0))
    inside._poses[0] = np.broadcast_to(np.eye(4), (48, 4, 4)).copy()
    inside._poses[0][:, :3, 3] = take.hands[0].fit.model.skin(take.hands[0].qpos)[:, 100] + 0.002
    with pytest.raises(HandSimError, match="mm from a hand or object in frame 0"):
        list(draw_shard(take, inside, config, 0, [0]))
