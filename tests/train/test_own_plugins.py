"""A sampler, a corruption and a labeler of a user's own, through the commands."""

from __future__ import annotations

import functools
import json
import sys

import numpy as np
import pytest

from gloves import read_capture
from handsim import HandSimError
from handsim._plugins import load_plugin
from handsim.app.workers import run_jobs
from handsim.cli.main import main
from handsim.errors import ArgumentError
from poses.shapes import load_sampler
from train import Dataset, load_labeler
from train.data.batches import draw_cloud

SOURCE = '''
import numpy as np
from types import SimpleNamespace

class Curled:
    """One pose again and again."""
    def __call__(self, model, num_poses, *, rng):
        angles = np.zeros((num_poses, 20))
        angles[:, 5::4] = angles[:, 6::4] = 0.3
        return angles + rng.normal(scale=0.001, size=angles.shape)

def others(model, num_poses, *, rng):
    return np.zeros((num_poses, 20))

def flat(model, num_poses, *, rng):
    return np.zeros(20)

def nans(model, num_poses, *, rng):
    return np.full((num_poses, 20), np.nan)

def text(model, num_poses, *, rng):
    return ["a"]

def half(markers, *, rng):
    """Every second marker is lost, and there is one ghost."""
    points = np.concatenate([markers, rng.uniform(-0.1, 0.1, (len(markers), 1, 3))], axis=1)
    points[:, :-1:2] = np.nan
    return points, np.tile([*range(markers.shape[1]), -1], (len(markers), 1))

def alone(markers, *, rng):
    return markers

def twice(markers, *, rng):
    return markers, np.zeros(markers.shape[:2], dtype=int)

def beyond(markers, *, rng):
    return markers, np.tile(np.arange(markers.shape[1]) + 1, (len(markers), 1))

def millimeters(markers, *, rng):
    return 1000 * markers, np.tile(np.arange(markers.shape[1]), (len(markers), 1))

def fewer(markers, *, rng):
    return markers[1:], np.zeros(markers[1:].shape[:2], dtype=int)

def job(name, number):
    from handsim import HandModel
    from poses.shapes import load_sampler
    assert load_sampler(name)(HandModel.named("S"), 3, rng=np.random.default_rng(number)).shape == (3, 20)
    return number

class InOrder:
    """The first point is the first marker, and so on."""
    def __init__(self):
        from gloves.layout import load_layout
        self.marker_names = load_layout("dense19").names
    def label_frames(self, frames):
        counts = [len(frame) for frame in frames]
        labels = [np.where(np.arange(count) < 19, np.arange(count), -1) for count in counts]
        return [SimpleNamespace(labels=one, confidence=np.ones(len(one))) for one in labels]

class Doubled(InOrder):
    def label_frames(self, frames):
        zeros = [np.zeros(len(one), dtype=int) for one in frames]
        return [SimpleNamespace(labels=one, confidence=one + 1.0) for one in zeros]
'''
SMALL = ["--samples", "64", "--batch", "32", "--network.width", "8", "--network.gates", "2"]
SET = ["--num-frames", "300", "--scenes.together", "0", "--scenes.holding", "0", "--workers", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "own_ideas.py").write_text(SOURCE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path, str(folder)])
        yield folder
    load_plugin.cache_clear()
    sys.modules.pop("own_ideas", None)


@pytest.fixture(scope="module")
def dataset(folder):
    assert main(["generate", "--out", "set", "--sampler", "own_ideas:Curled", *SET]) == 0
    return Dataset(folder / "set")


def test_a_training_set_has_the_samplers_poses(dataset, folder, capsys):
    angles = dataset.rows()["qpos"][:, 7:]
    assert np.ptp(angles, axis=0).max() < 0.1, "one pose, which a hand of thick fingers opens a little"
    np.testing.assert_allclose(np.median(angles[:, 5::4]), 0.3, atol=0.01)
    settings = json.loads((folder / "set" / "config.json").read_text())
    assert settings["sampler"] == "own_ideas:Curled"
    line = ["generate", "--out", "set", *SET]
    for other in ([], ["--sampler", "own_ideas:others"]):
        assert main([*line, *other]) == 1
        assert "begun with other settings (sampler: " in capsys.readouterr().err


def test_worker_processes_import_it_too(folder):
    load_sampler("own_ideas:Curled")  # as the command does before the work
    job = functools.partial(sys.modules["own_ideas"].job, "own_ideas:Curled")
    assert sorted(run_jobs(job, [0, 1, 2], 2)) == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("flat", r"what pose sampler 'own_ideas:flat' returns has shape \(20,\), expected \(2, 20\)"),
        ("nans", "returns holds NaN or infinite values"),
        ("text", "expected an array of numbers"),
        ("half", "does not take the arguments"),
        ("absent", "has no attribute 'absent'"),
    ],
)
def test_samplers_that_fail_are_told_before_the_work(folder, name, message):
    with pytest.raises(HandSimError, match=message):
        load_sampler(f"own_ideas:{name}")
    assert main(["generate", "--out", "none", "--sampler", f"own_ideas:{name}", *SET]) == 1
    assert not (folder / "none").exists()


def test_a_run_learns_from_the_corruption_and_is_not_continued_with_another(dataset, folder, capsys):
    line = ["train", "set", "--out", "run", *SMALL, "--rig-share", "0"]
    assert main([*line, "--corruption", "own_ideas:half"]) == 0
    assert json.loads((folder / "run" / "train.json").read_text())["train"]["corruption"] == "own_ideas:half"
    for other in ([], ["--corruption", "own_ideas:alone"]):
        assert main([*line, *other]) == 1
    said = capsys.readouterr().err
    assert "begun with other settings (train.corruption" in said
    assert "returns ndarray, expected the pair points, labels" in said


def test_clouds_are_what_the_corruption_returns(folder):
    markers = np.random.default_rng(0).uniform(-0.1, 0.1, (6, 5, 3))
    cloud = draw_cloud("own_ideas:half", markers, rng=np.random.default_rng(1))
    assert cloud.points.shape == (6, 3, 3) and cloud.present.all()
    for points, truth, row in zip(cloud.points, cloud.truth, markers, strict=True):
        assert sorted(truth) == [-1, 1, 3]
        for label in (1, 3):
            np.testing.assert_array_equal(points[truth == label][0], row[label])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("alone", "returns ndarray, expected the pair"),
        ("twice", "a marker twice in a cloud"),
        ("beyond", "returns labels from 1 to 5, expected -1 to 4"),
        ("millimeters", "or beyond 10 m"),
        ("fewer", r"points of shape \(1, 5, 3\), expected \(2, N, 3\)"),
        ("Curled", "does not take the arguments"),
    ],
)
def test_corruptions_that_fail_are_told(folder, name, message):
    with pytest.raises(HandSimError, match=message):
        draw_cloud(f"own_ideas:{name}", np.full((2, 5, 3), 0.05), rng=np.random.default_rng(0))


def test_a_labeler_of_ones_own(folder):
    assert main(["simulate", "--num-frames", "4", "--kind", "free", "--hands", "left", "--out", "t.c3d"]) == 0
    line = ["label", "t.c3d", "--labeler", "own_ideas:InOrder", "--out", "labeled.trc"]
    assert main(line) == 0
    assert read_capture(folder / "labeled.trc").positions.shape[0] == 4
    labeler = load_labeler("own_ideas:Doubled")
    with pytest.raises(ArgumentError, match="or a marker twice in a frame"):
        labeler.label_frames([np.zeros((3, 3)) + np.arange(3)[:, None] * 0.01])
    with pytest.raises(ArgumentError, match="expected marker_names and label_frames"):
        load_labeler("own_ideas:others")
