"""Generate, train small, label, evaluate, track, draw: one chain, most of it through the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.paper.take_evaluation import true_users
from gloves import Capture, read_capture, write_capture
from handsim.cli.main import main
from handsim.hand.model import hand_keypoints
from track import track_capture
from train import Dataset, simulate_take

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("closed loop")]  # what they share is made once
SMALL = "--samples 80000 --batch 128 --network.width 32 --network.gates 8 --network.depth 3".split()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loop")
    sizes = ["--num-frames", "6000", "--frames-per-hand", "60", "--population.children", "0"]
    scenes = ["--scenes.alone", "0.8", "--scenes.together", "0.1", "--scenes.holding", "0.1"]
    assert main(["generate", "--out", str(folder / "set"), *sizes, *scenes, "--workers", "1"]) == 0
    assert main(["train", str(folder / "set"), "--out", str(folder / "run"), *SMALL]) == 0
    return folder


def take(folder, name, frames=200):
    dataset = Dataset(folder / "set")
    path = folder / name
    rows = dataset.rows()[:frames]
    write_capture(path, Capture(dataset.marker_names, rows["markers"].astype(float), 120.0))
    return path


def test_a_small_labeler_labels_most_of_a_capture(run):
    path = take(run, "take.trc")
    figures = run / "figures.json"
    assert main(["evaluate", str(path), "--labeler", str(run / "run"), "--json", str(figures)]) == 0
    found = json.loads(figures.read_text())["figures"]
    assert found["slot_accuracy"] > 0.85
    assert found["macro_f1"] > 0.85 and 0.0 < found["calibration_error"] < 0.5
    assert 0.0 <= found["error_without_least_sure"] < 1.0 - found["point_accuracy"]
    assert found["ghost_precision"] is None or found["ghost_precision"] == 0.0  # no ghost was there


def test_labels_do_not_depend_on_the_columns(run, rng):
    path = take(run, "straight.c3d")
    capture = read_capture(path)
    order = rng.permutation(19)
    shuffled = Capture(tuple(f"*{n}" for n in range(19)), capture.positions[:, order], 120.0)
    write_capture(run / "shuffled.c3d", shuffled)
    for name in ("straight", "shuffled"):
        arguments = ["label", str(run / f"{name}.c3d"), "--labeler", str(run / "run")]
        assert main([*arguments, "--out", str(run / f"{name}.trc")]) == 0
    first, second = read_capture(run / "straight.trc"), read_capture(run / "shuffled.trc")
    assert first.names[:19] == capture.names
    np.testing.assert_allclose(first.positions[:, :19], second.positions[:, :19], atol=1e-7)
    right = np.isclose(first.positions[:, :19], capture.positions, atol=1e-6).all(-1)
    assert right.mean() > 0.85


def test_a_small_labeler_tracks_to_a_millimeter(run):
    truth = simulate_take(num_frames=240)
    tracked = track_capture(truth, hands=true_users(truth), labeler=run / "run")
    model, mine, true = truth.hands[0].model, tracked.qpos[:, 0], truth.qpos[:, 0]
    there = np.isfinite(mine[:, 0])
    assert there.mean() > 0.95
    off = hand_keypoints(model, mine[there]) - hand_keypoints(model, true[there])
    assert 1e3 * np.linalg.norm(off, axis=-1).mean() < 1.0
