"""The options of `handsim render`, and the configuration that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import tyro

from handsim.cli.parsing import registry
from render import DepthSensor, RenderConfig
from render.config import resolve
from render.painting.figures import sample_appearance
from render.skin.look import TONES


def parsed(*words: str) -> RenderConfig:
    return tyro.cli(RenderConfig, args=words, registry=registry())


def test_no_option_gives_the_default_configuration() -> None:
    assert parsed() == RenderConfig()


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
    angles = [sample_appearance(False, tones=config.tones, rng=rng).skin.typology_angle for _ in range(200)]
    ends = [TONES[name.replace("-", " ")] for name in set(names.split())]
    for low, high in ends:
        share = np.mean([low <= angle <= high for angle in angles])
        width = (high - low) / sum(high - low for low, high in ends)
        assert share == pytest.approx(width, abs=0.12)
    assert all(any(low - 1e-9 <= angle <= high + 1e-9 for low, high in ends) for angle in angles)


def test_the_depth_sensor_fits_the_placement() -> None:
    assert resolve(parsed("--placement", "head")).depth_sensor == DepthSensor(("d435",))
    assert resolve(parsed("--placement", "orbit")).depth_sensor == DepthSensor(("d435",))
    assert resolve(parsed("--distance", "0.6", "0.9")).depth_sensor == DepthSensor(("kinect2",))
    assert resolve(parsed("--placement", "rig")).depth_sensor == DepthSensor(("kinect2",))
    given = resolve(parsed("--placement", "head", "--depth-sensor", "kinect2", "kinect1"))
    assert given.depth_sensor == DepthSensor(("kinect2", "kinect1"))


def test_photographs_alone_are_the_only_background() -> None:
    config = parsed("--photos", "folder")
    assert config.background.photos == "folder"
    assert [*config.background.shares.values()] == [0.0, 0.0, 0.0, 1.0]


def test_depth_alone_never_looks_for_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("render.painting.painter.choose_painter", lambda: pytest.fail("looked"))
    assert resolve(RenderConfig(passes=("depth",))).painter == "compiled"
    assert resolve(RenderConfig(painter="opengl")).painter == "opengl"
