"""The options of `handsim render`, and the configuration that they stand for."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import tyro

from handsim import HandSimError
from handsim.cli import render as command
from handsim.cli.parsing import registry
from handsim.cli.render import RenderOptions
from render import Backgrounds, DepthSensor, RenderConfig, ViewConfig
from render.painting.figures import sample_people
from render.skin.look import TONES


def parsed(*words: str) -> RenderConfig:
    return tyro.cli(RenderOptions, args=words, registry=registry()).config()


def test_no_option_gives_the_default_configuration() -> None:
    assert parsed() == RenderConfig()


def test_every_option_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def stub(take, out, formats, config, **rest):
        given.append((take, out, formats, config, rest["workers"]))
        return 0

    monkeypatch.setattr(command, "render_take", stub)
    line = (
        "take.npz --out pics --format coco png --passes rgb depth --placement rig --camera sr300 "
        "--rig eight --dress glove --tones dark brown --background room plain "
        "--vary frame --depth-sensor none --no-color-sensor --motion-blur --painter opengl --every 3 "
        "--frames-per-shard 5 --seed 7 --workers 1"
    )
    tyro.cli(command.render, args=line.split(), registry=registry())
    take, out, formats, config, workers = given[0]
    assert (take, out, formats, workers) == (Path("take.npz"), Path("pics"), ("coco", "png"), 1)
    assert dataclasses.astuple(config.view) == ("rig", "sr300", 1, 1 / 3, None, "eight", None)
    assert (config.passes, config.dress, config.tones) == (("rgb", "depth"), "glove", (-52.0, 10.0))
    assert config.background == Backgrounds({"plain": 1, "room": 1})
    assert (config.vary, config.painter, config.seed) == ("frame", "opengl", 7)
    assert (config.every, config.frames_per_shard) == (3, 5)
    assert config.depth_sensor is None and config.color_sensor is None
    assert config.shutter is not None
    assert parsed("--views", "2", "--share", "0.4").view == ViewConfig(views=2, share=0.4)
    assert parsed("--distance", "0.5", "0.6").view == ViewConfig(distance=(0.5, 0.6))


@pytest.mark.parametrize(
    ("names", "tones"),
    [
        ("very-light dark", (-52.0, -30.0, 55.0, 64.0)),
        ("dark brown", (-52.0, 10.0)),
        ("tan light tan", (10.0, 28.0, 41.0, 55.0)),
    ],
)
def test_named_tones_are_drawn_and_no_others(names: str, tones: tuple[float, ...]) -> None:
    config = parsed("--tones", *names.split())
    assert config.tones == tones
    rng = np.random.default_rng(4)
    angles = [sample_people(1, False, tones=config.tones, rng=rng)[0].skin.typology_angle for _ in range(200)]
    ends = [TONES[name.replace("-", " ")] for name in set(names.split())]
    for low, high in ends:
        share = np.mean([low <= angle <= high for angle in angles])
        width = (high - low) / sum(high - low for low, high in ends)
        assert share == pytest.approx(width, abs=0.12)
    assert all(any(low - 1e-9 <= angle <= high + 1e-9 for low, high in ends) for angle in angles)


def test_the_depth_sensor_fits_the_placement() -> None:
    assert parsed("--placement", "head").resolved().depth_sensor == DepthSensor(("d435",))
    assert parsed("--placement", "orbit").resolved().depth_sensor == DepthSensor(("d435",))
    assert parsed("--distance", "0.6", "0.9").resolved().depth_sensor == DepthSensor(("kinect2",))
    assert parsed("--placement", "rig").resolved().depth_sensor == DepthSensor(("kinect2",))
    given = parsed("--placement", "head", "--depth-sensor", "kinect2", "kinect1").resolved()
    assert given.depth_sensor == DepthSensor(("kinect2", "kinect1"))


def test_photographs_alone_are_the_only_background() -> None:
    config = parsed("--photos", "folder")
    assert config.background.photos == "folder"
    assert [*config.background.shares.values()] == [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--tones", "green"), "unknown skin tone 'green'"),
        (("--depth-sensor", "auto", "d435"), "unknown depth sensor 'auto'"),
        (("--depth-sensor", "sonar"), "unknown depth sensor 'sonar'"),
        (("--passes", "heat"), "unknown pass 'heat'"),
        (("--every", "0"), "every is 0"),
    ],
)
def test_wrong_options_are_told(words: tuple[str, ...], message: str) -> None:
    with pytest.raises(HandSimError, match=message):
        parsed(*words)


def test_depth_alone_never_looks_for_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("render.config.choose_painter", lambda: pytest.fail("looked"))
    assert RenderConfig(passes=("depth",)).resolved().painter == "compiled"
    assert RenderConfig(painter="opengl").resolved().painter == "opengl"
