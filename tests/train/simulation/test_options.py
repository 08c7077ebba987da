"""Every option of `handsim generate` and `handsim simulate` acts: another value gives another result."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gloves import OpticsConfig
from handsim.errors import ArgumentError
from train import GenerateSettings, SceneMix, SimulateSettings, simulate_take
from train.data.shards import rows_name
from train.simulation.generation import make_dataset

FRAMES = 240
BASE = GenerateSettings(num_frames=FRAMES, frames_per_hand=60, scenes=SceneMix(1.0, 1.0, 1.0))
NOT_NUMBERS = {
    "glove": "sparse13", "rig": "six", "kind": "hand-hand", "hands": ("left",), "center": (0.1, -0.1, 1.2),
    "flesh": True,
}  # fmt: skip
# What a few frames of the default optics do not show needs a larger change.
STRONG = {
    "roundness": 40.0, "min_angle": 60.0, "min_distance": 0.03, "max_residual": 0.0002, "partial": 3.0,
    "min_rays": 6, "min_rays_to_start": 8, "dropout": 0.3, "dropout_length": 9.0, "dropout_cameras": 9,
    "blob_loss": 0.3, "min_cameras": 6, "children": 0.9, "marker_radius": 0.008, "noise": 0.5,
    "knuckle_spread": 0.004, "holding": 0.0, "strays.number": 9.0,
    "strays.shown": 0.1, "strays.hidden": 0.2,
}  # fmt: skip


def other(name: str, value: Any) -> Any:
    """Another value of an option."""
    for known, strong in ((name, STRONG), (name.rsplit(".", maxsplit=1)[-1], STRONG)):
        if known in strong and not isinstance(value, tuple):
            return strong[known]
    if name in NOT_NUMBERS:
        return NOT_NUMBERS[name]
    if isinstance(value, tuple):
        return tuple(0.6 + 0.5 * one for one in value)
    return value + 7 if isinstance(value, int) else 0.5 * value + 0.02


def options(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Name and value of each option, with dots in the names of groups' fields."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from options(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def changed(settings: Any, name: str, value: Any) -> Any:
    """The settings with another value of an option."""
    head, _, rest = name.partition(".")
    inner = changed(getattr(settings, head), rest, value) if rest else value
    return dataclasses.replace(settings, **{head: inner})


@pytest.fixture(scope="module")
def usual_rows(tmp_path_factory) -> bytes:
    out = tmp_path_factory.mktemp("set")
    make_dataset(BASE, out, workers=1)
    return (out / rows_name(0)).read_bytes()


GENERATE = [(name, value) for name, value in options(BASE) if name not in ("num_frames", "sampler")]


@pytest.mark.parametrize(("name", "value"), GENERATE, ids=[name for name, _ in GENERATE])
def test_every_option_of_generate_acts(name, value, usual_rows, tmp_path):
    make_dataset(changed(BASE, name, other(name, value)), tmp_path, workers=1)
    assert (tmp_path / rows_name(0)).read_bytes() != usual_rows


@functools.cache
def points_of(settings: SimulateSettings) -> bytes:
    return np.ascontiguousarray(simulate_take(settings=settings).points).tobytes()


SIMULATE = [(name, value) for name, value in options(SimulateSettings()) if name != "num_frames"]


@pytest.mark.parametrize(("name", "value"), SIMULATE, ids=[name for name, _ in SIMULATE])
def test_every_option_of_simulate_acts(name, value):
    usual = SimulateSettings(num_frames=FRAMES)
    if name == "optics.min_rays":  # a point may not begin with fewer rays than it needs to go on
        usual = changed(usual, "optics.min_rays_to_start", STRONG["min_rays_to_start"])
    if name in ("strays.shown", "strays.hidden"):  # the usual capture has no strays
        usual = changed(usual, "strays.number", STRONG["strays.number"])
    assert points_of(changed(usual, name, other(name, value))) != points_of(usual)


def test_optics_over_time_are_refused_for_unrelated_frames():
    with pytest.raises(ArgumentError, match="optics is an OpticsConfig, expected FrameOptics"):
        GenerateSettings(optics=OpticsConfig())
