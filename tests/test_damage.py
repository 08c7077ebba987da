"""Four flipped bytes in a file of what is resumed: it comes out right, or one sentence names the file."""

from __future__ import annotations

import functools
import itertools
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gloves import Take
from handsim import look_at
from handsim.errors import DatasetError, HandSimError, WeightsError
from handsim.files.signals import Stopped
from handsim.space.camera import pinhole
from render import RenderConfig, merge_renderings, render_take
from tests.folders import contents
from train import (
    GenerateSettings,
    SetLabelerConfig,
    TrainSettings,
    load_labeler,
    simulate_take,
    train_labeler,
)
from train.data.shards import MANIFEST
from train.labelers.storage import CARD, GLOVE, RUN_SETTINGS, WEIGHTS
from train.simulation import generation
from train.simulation.generation import make_dataset

FLIPS = tuple((place, mask) for place in (0.0, 0.3, 0.7, 1.0) for mask in (0x01, 0xFF))
"""Where four bytes are flipped, as a share of a file's length, and how; 0x01 makes other digits of digits."""

EXTENT = pytest.mark.parametrize("flips", [1, pytest.param(len(FLIPS), marks=pytest.mark.slow)])
"""Flips of each file, and of one file of each kind where there is one flip; all take twenty times as long."""
NETWORK = SetLabelerConfig(width=8, gates=2, depth=1)
RUN = TrainSettings(samples=96, batch=32, network=NETWORK)
FORMATS = [("webdataset",), ("coco",), ("yolo", "exr")]
PICTURES = RenderConfig(
    passes=("rgb", "depth"), every=12, frames_per_shard=1, depth_sensor=None, color_sensor=None,
    background={"plain": 1.0}, painter="compiled",
)  # fmt: skip


def flip(path: Path, place: float, mask: int) -> None:
    content = bytearray(path.read_bytes())
    start = int(place * max(len(content) - 4, 0))
    content[start : start + 4] = bytes(one ^ mask for one in content[start : start + 4])
    path.write_bytes(content)


def assert_never_truth(
    folder: Path, again: Callable[[Path], object], expected: dict[str, bytes], *, flips: int
) -> None:
    """Damage in a folder is refused by name, or the same command gives the expected files.

    Each file gets so many of the flips, and the next file the next ones; names of a kind differ in digits.
    """
    tries = itertools.cycle(FLIPS)
    kept = folder.rename(folder.with_name("kept"))
    names = sorted(contents(kept))
    kinds = {re.sub(r"\d", "", name): name for name in names}
    for name in names if flips == len(FLIPS) else kinds.values():
        for place, mask in itertools.islice(tries, flips):
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(kept, folder)
            flip(folder / name, place, mask)
            try:
                again(folder)
            except HandSimError as error:
                assert Path(name).name in str(error), f"{name} at {place}: {error}"
            else:
                found = contents(folder)
                assert {one: found[one] for one in expected} == expected, f"{name} at {place}"


@pytest.mark.filterwarnings("ignore::handsim.HandSimWarning")
@pytest.mark.parametrize("state", ["finished", "half"])
@EXTENT
def test_a_training_set(tmp_path, monkeypatch, state, flips):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", 20)
    settings = GenerateSettings(num_frames=50, frames_per_hand=10, scenes={"together": 0, "holding": 0})

    def again(folder: Path) -> None:
        make_dataset(settings, folder, workers=1)

    again(tmp_path / "set")
    expected = contents(tmp_path / "set")
    if state == "half":
        (tmp_path / "set" / MANIFEST).unlink()
        for path in (tmp_path / "set").glob("*-00002.*"):
            path.unlink()
    assert_never_truth(tmp_path / "set", again, expected, flips=flips)


@pytest.fixture
def small_run(tmp_path, monkeypatch) -> Callable[..., object]:
    """Training of a tiny network, with a page that lacks its pictures."""
    for page in ("run_page", "dataset_page", "hand_plot"):
        monkeypatch.setattr(f"train.reports.{page}.picture", lambda *drawn: "data:,")
    settings = GenerateSettings(num_frames=300, frames_per_hand=20, scenes={"together": 0, "holding": 0})
    make_dataset(settings, tmp_path / "set", workers=1)
    return functools.partial(train_labeler, tmp_path / "set", settings=RUN)


@pytest.mark.parametrize("state", ["finished", "half"])
@EXTENT
def test_a_run(tmp_path, small_run, state, flips):
    folder = tmp_path / "run"
    small_run(folder)
    shutil.rmtree(folder / "tensorboard")  # curves, a new file of them for each command
    expected = contents(folder)
    if state == "half":
        shutil.rmtree(folder)
        with pytest.raises(Stopped):
            small_run(folder, progress=stop)
        shutil.rmtree(folder / "tensorboard")
        expected = {name: expected[name] for name in (WEIGHTS, RUN_SETTINGS, GLOVE)}  # others hold times
    assert_never_truth(folder, small_run, expected, flips=flips)


@pytest.mark.parametrize("name", [WEIGHTS, CARD])
def test_damaged_weights_are_no_labeler(tmp_path, small_run, name):
    small_run(tmp_path / "run")
    whole = contents(tmp_path / "run")
    names = load_labeler(tmp_path / "run").marker_names
    for place in np.linspace(0.0, 1.0, 40):
        (tmp_path / "run" / name).write_bytes(whole[name])
        flip(tmp_path / "run" / name, place, 0x01)
        try:
            labeler = load_labeler(tmp_path / "run")
        except WeightsError as error:
            assert name in str(error)
        else:
            assert name == CARD and labeler.marker_names == names


@pytest.fixture(scope="module")
def take(tmp_path_factory) -> Take:
    return simulate_take(num_frames=24)


def render(take: Take, folder: Path, formats: tuple[str, ...], **options: Any) -> None:
    """A picture of 64 x 48 pixels in each of two shards."""
    place = take.qpos[0, 0, :3]
    camera = pinhole("small", (64, 48), 40.0).at(look_at(place + [0.1, -0.5, 0.2], place))
    render_take(take, folder, formats, PICTURES, camera=camera, workers=1, **options)


@pytest.mark.filterwarnings("ignore::handsim.HandSimWarning")
@pytest.mark.parametrize("state", ["finished", "half"])
@pytest.mark.parametrize("formats", FORMATS, ids="-".join)
@EXTENT
def test_pictures(tmp_path, take, state, formats, flips):
    folder = tmp_path / "pictures"
    render(take, folder, formats)
    expected = contents(folder)
    if state == "half":
        shutil.rmtree(folder)
        with pytest.raises(Stopped):
            render(take, folder, formats, progress=stop)
    assert_never_truth(folder, lambda copy: render(take, copy, formats), expected, flips=flips)


def stop(done: int, total: int) -> None:
    if done:
        raise KeyboardInterrupt


def test_damaged_pictures_are_not_merged(tmp_path, take):
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        render(take, folder, ("webdataset",))
    merge_renderings(folders, tmp_path / "c")
    for name in ("shard-00003.tar", "checksums-00003.json"):
        damaged = shutil.copytree(tmp_path / "c", tmp_path / name)
        flip(damaged / name, 0.6, 0xFF)
        with pytest.raises(DatasetError, match=rf"{name} are damaged"):
            merge_renderings([folders[0], damaged], tmp_path / "d")
        assert not (tmp_path / "d").exists()
