"""Runs that are stopped, grow, diverge or meet a full disk; modes and bytes of what they write."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal

import numpy as np
import pytest
import torch

from benchmarks.held_out import held_out_markers
from gloves import load_layout
from handsim.cli.main import main
from handsim.errors import WeightsError
from handsim.files.signals import Stopped
from tests.limits import file_size_limit
from tests.sentences import assert_names
from train import (
    CNNConfig,
    Corruption,
    GenerateSettings,
    SetLabelerConfig,
    TrainSettings,
    evaluate_labeler,
    load_labeler,
    train_labeler,
)
from train.data.shards import load_dataset
from train.evaluation import SEEN, paper_report, rig_report
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.layout_labeler import learned_labeler
from train.labelers.networks import cnn_labeler, prepare_network
from train.labelers.storage import CARD, WEIGHTS, load_network
from train.loop import CHECKPOINT, TrainingError, choose_costs, untrained_report
from train.settings import usual_settings
from train.simulation.generation import make_dataset

SMALL = SetLabelerConfig(width=8, gates=2, depth=1)
CONFIG = TrainSettings(samples=640, batch=32, network=SMALL)
OPTIONS = ["--batch", "32", "--network.width", "8", "--network.gates", "2", "--network.depth", "1"]
OPTION_ERRORS = {
    "--learning-rate nan": "learning_rate is nan, expected a number above 0, at most 10",
    "--learning-rate 1e9": "learning_rate is 1e+09, expected a number above 0, at most 10",
    "--seed -1": "seed is -1, expected 0 or more",
    "--network.width 0": "width is 0, expected 1 to 4096",
    "--network.gates 7": "gates is 7, expected a divisor of width, 64",
    "--batch 0": "batch is 0, expected 1 to 1000000",
    "--average nan": "average is nan, expected a number from 0 to 1",
    "--cnn.reject nan": "reject is nan, expected a number above 0",
    "--threads 0": "threads is 0, expected 1 to 1024",
}
CNN = dataclasses.replace(usual_settings("cnn"), samples=48, batch=16, average_every=2, precision="32")
FIXED_CNN = dataclasses.replace(CNN, cnn=CNNConfig(reject=0.04, spread=0.005))
"""Without the choice of these two, which takes as long as many steps."""
NAMES = tuple(f"marker{label}" for label in range(19))


@pytest.mark.usefixtures("quickly_learned")
@pytest.mark.parametrize("glove", ["tips8", "sparse13", "mine.toml"])
def test_the_labeler_without_training_is_evaluated_on_the_same_held_out_frames(glove, tmp_path):
    """It is the shipped one, or the one for any layout; the others' people are those of the run's card."""
    path = tmp_path / "mine.toml"
    layout = load_layout("starter10" if glove.endswith(".toml") else glove)
    dataclasses.replace(layout, name="mine", markers=layout.markers[::-1]).save(path)
    folder = tmp_path / "set"
    worn = path if glove.endswith(".toml") else glove
    make_dataset(GenerateSettings(num_frames=300, glove=worn), folder, workers=1)
    config = dataclasses.replace(CONFIG, samples=64)
    card = train_labeler(folder, tmp_path / "run", config)
    made, found = load_dataset(folder), untrained_report(folder, config)
    last = made.rows()[made.people() == made.people()[-1]]  # of a few people
    held_out, worn = last[:: -(-len(last) // 64)], made.layout
    usual = load_labeler(worn) if glove == "sparse13" else learned_labeler(worn)
    expected = rig_report(usual, held_out, rng=np.random.default_rng(0))
    assert found.num_frames == len(held_out)
    assert found.figures["slot_accuracy"] == expected.figures["slot_accuracy"]
    assert card["held_out_simulated"][SEEN]["occlusion_ratio"] == found.figures["occlusion_ratio"]


def done_in(run):
    return torch.load(run / CHECKPOINT, weights_only=True)["done"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_keeps_the_last_step_and_the_run_ends_the_same(dataset, tmp_path, capsys, number):
    def command(out):
        return main(["train", str(dataset.path), "--out", str(out), "--samples", "640", *OPTIONS])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.loop.TrainingState._average", sending(number))
        assert command(tmp_path / "stopped") == 128 + number
    said = capsys.readouterr().err
    assert f"320 of 640 samples are kept in {tmp_path / 'stopped' / CHECKPOINT}, and the same command" in said
    assert said.count("\n") == 1
    assert done_in(tmp_path / "stopped") == 320
    assert command(tmp_path / "stopped") == command(tmp_path / "whole") == 0
    stopped, whole = ((tmp_path / name / WEIGHTS).read_bytes() for name in ("stopped", "whole"))
    assert stopped == whole


def sending(number):
    """A step that is hit by a signal in its middle, at 320 samples."""
    from train.loop import TrainingState

    average = TrainingState._average

    def hit(self):
        if self.done == 320:
            os.kill(os.getpid(), number)
        average(self)

    return hit


def test_a_run_grows_and_its_learning_rate_is_that_of_the_new_length(dataset, tmp_path):
    train_labeler(dataset, tmp_path / "run", CONFIG)
    steps = []
    longer = dataclasses.replace(CONFIG, samples=960)
    card = train_labeler(dataset, tmp_path / "run", longer, progress=lambda *step: steps.append(step[0]))
    assert steps == list(range(672, 961, 32)) and card["train"]["samples"] == 960
    losses = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)["history"]["losses"]
    rates = {done: rate for done, _, rate in losses}
    assert rates[640] < 1e-4 < rates[672]
    with pytest.raises(WeightsError, match=r"train.samples: 960 there, 640 here.*may only grow"):
        train_labeler(dataset, tmp_path / "run", CONFIG)


def test_an_evaluation_that_was_cut_off_is_done_by_the_next_run(dataset, tmp_path, monkeypatch):
    def cut(self, rows, names):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("train.loop.TrainingState.evaluate", cut)
        with pytest.raises(Stopped):
            train_labeler(dataset, tmp_path / "cut", CONFIG)
    done = done_in(tmp_path / "cut")
    assert 0 < done < 640
    curve = train_labeler(dataset, tmp_path / "cut", CONFIG)["curve"]
    assert [entry[0] for entry in curve] == [
        entry[0] for entry in train_labeler(dataset, tmp_path / "whole", CONFIG)["curve"]
    ]
    assert curve[0][0] == done


@pytest.mark.parametrize(("samples", "evaluations"), [(320, 1), (640, 2), (960, 2), (1440, 3)])
def test_a_run_is_evaluated_in_proportion_to_its_samples(
    dataset, tmp_path, monkeypatch, samples, evaluations
):
    monkeypatch.setattr("train.loop._HELD_OUT_SHARE", 0.2)
    steps = []
    with monkeypatch.context() as patch:
        patch.setattr("train.loop.paper_report", counting(seen := []))
        settings = dataclasses.replace(CONFIG, samples=samples)
        card = train_labeler(dataset, tmp_path / "run", settings, on_step=steps.append)
    assert len(card["curve"]) == evaluations and steps.count("held-out frames") == evaluations + 1
    assert len(seen) == evaluations + 1
    assert sum(seen[:-1]) <= samples / 8 + seen[0]


def counting(seen):
    """The evaluation of the paper's corruption, which notes how many frames it is made on."""

    def report(labeler, rows):
        seen.append(len(rows))
        return paper_report(labeler, rows)

    return report


def test_a_loss_that_is_no_number_ends_the_run(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "train.loop.batch_loss", lambda *args, **kwargs: torch.tensor(float("nan"), requires_grad=True)
    )
    with pytest.raises(TrainingError, match=r"the loss is nan after 32 samples; .* below 0.002"):
        train_labeler(dataset, tmp_path / "run", CONFIG)
    assert not (tmp_path / "run" / CHECKPOINT).exists()


def test_what_a_run_writes_has_no_trace_of_the_process(dataset, tmp_path):
    before = os.umask(0o022)
    try:
        train_labeler(dataset, tmp_path / "run", CONFIG)
    finally:
        os.umask(before)
    assert b"tmp-" not in (tmp_path / "run" / CHECKPOINT).read_bytes()
    modes = {
        path.name: path.stat().st_mode & 0o777 for path in (tmp_path / "run").iterdir() if path.is_file()
    }
    assert set(modes.values()) == {0o644}, modes


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    train_labeler(dataset, out, CONFIG)
    return out


@pytest.mark.parametrize("damage", ["cut", "nan", "count", "shape", "list"])
def test_a_damaged_checkpoint_is_told(dataset, trained, tmp_path, damage):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    path = tmp_path / CHECKPOINT
    content = torch.load(path, weights_only=True)
    name = next(iter(content["mean"]))
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-900])
    else:
        if damage == "nan":
            content["mean"][name].view(-1)[0] = float("nan")
        elif damage == "count":
            content["done"] = -32
        elif damage == "shape":
            content["mean"][name] = torch.zeros(3)
        torch.save([content] if damage == "list" else content, path)
    with pytest.raises(WeightsError, match=r"checkpoint.pt is damaged; delete it to begin this run again"):
        train_labeler(dataset, tmp_path, CONFIG)


def test_a_full_disk_is_one_sentence_and_the_checkpoint_stays(dataset, tmp_path, capsys):
    """A limit of file sizes stands in for the full disk: the same OSError from the same system call."""
    options = ["train", str(dataset.path), "--out", str(tmp_path / "run"), *OPTIONS]
    assert main([*options, "--samples", "320"]) == 0
    kept = (tmp_path / "run" / CHECKPOINT).read_bytes()
    capsys.readouterr()
    with file_size_limit(10_000):
        assert main([*options, "--samples", "640"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "file too large" in said
    assert (tmp_path / "run" / CHECKPOINT).read_bytes() == kept
    assert not list((tmp_path / "run").glob(".*"))
    load_labeler(tmp_path / "run")


@pytest.mark.parametrize("options", OPTION_ERRORS)
def test_options_without_sense_are_told(dataset, tmp_path, capsys, options):
    assert main(["train", str(dataset.path), "--out", str(tmp_path / "run"), *options.split()]) == 1
    assert_names(capsys.readouterr().err.strip(), f"handsim train: {OPTION_ERRORS[options]}")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_that_was_stopped_is_the_run_that_was_not(dataset, tmp_path):
    class Stopped(Exception):
        pass

    def stop(done, total):
        if done == 2 * CNN.batch:
            raise Stopped

    train_labeler(dataset, tmp_path / "whole", FIXED_CNN)
    with pytest.raises(Stopped):  # after the first checkpoint, before the second
        train_labeler(dataset, tmp_path / "stopped", FIXED_CNN, progress=stop, save_every=0.0)
    train_labeler(dataset, tmp_path / "stopped", FIXED_CNN)
    whole, stopped = (load_network(tmp_path / name)[0].state_dict() for name in ("whole", "stopped"))
    for name, values in whole.items():
        assert torch.equal(values, stopped[name]), name
    assert whole["mean_hand.markers"].std() > 0.01


def test_what_training_used_is_saved_with_the_network(dataset, tmp_path):
    config = dataclasses.replace(CNN, samples=16, cnn=CNNConfig(views="random", reject=0.033))
    train_labeler(dataset, tmp_path, config)
    card = json.loads((tmp_path / CARD).read_text())
    assert card["labeler"] == "cnn"
    assert card["network"]["views"] == "random" and card["network"]["reject"] == 0.033
    assert card["network"]["spread"] > 0.0, "chosen on held-out frames"
    assert card["curve"][-1][0] == 16
    network, _ = load_network(tmp_path)
    assert network.config == CNNConfig(**card["network"])
    assert (tmp_path / WEIGHTS).stat().st_size > 80e6
    assert load_labeler(tmp_path).marker_names == dataset.marker_names


@pytest.mark.slow
def test_a_minute_of_training_labels_three_times_as_much_as_chance(dataset, tmp_path):
    recipe = {"learning_rate": 5e-4, "anisotropy": 0.0, "occlude": 0, "ghosts": 0}
    train_labeler(dataset, tmp_path, dataclasses.replace(FIXED_CNN, samples=960, **recipe))
    markers = dataset.rows()[:24]["markers"].astype(np.float64)
    report = evaluate_labeler(load_labeler(tmp_path), markers, Corruption(0, 0), rng=np.random.default_rng(0))
    assert report.figures["slot_accuracy"] > 3.0 / markers.shape[1]


@pytest.fixture(scope="module")
def rows():
    markers = held_out_markers("dense19", 60, seed=4)
    rows = np.zeros(len(markers), dtype=[("markers", "f4", (19, 3)), ("hand", "u4")])
    rows["markers"] = markers
    return rows


@pytest.fixture(scope="module")
def network(rows):
    """A network that answers with the mean hand, so that some points are near their markers."""
    torch.manual_seed(0)
    network = DeepLabelCNN(CNNConfig(views="aligned")).eval()
    prepare_network(network, rows)
    last = network.positions[-1]
    torch.nn.init.zeros_(last.weight)
    markers = network.mean_hand.markers
    with torch.no_grad():
        last.bias.copy_((markers / markers.abs().max() * 0.8).flatten())
    return network


def test_no_other_costs_are_better(network, rows):
    few = rows[:4]
    network.config = CNNConfig()
    chosen = choose_costs(network, NAMES, few)
    assert network.config == chosen and None not in (chosen.reject, chosen.spread)

    def figures(**costs):
        network.config = dataclasses.replace(chosen, **costs)
        return paper_report(cnn_labeler(network, NAMES), few).figures

    best = figures()
    assert 0.1 < best["slot_accuracy"] < 1.0
    assert figures(reject=0.015)["slot_accuracy"] <= best["slot_accuracy"]
    assert figures(reject=0.08)["slot_accuracy"] <= best["slot_accuracy"]
    assert figures(spread=0.002)["calibration_error"] >= best["calibration_error"]
    assert figures(spread=0.012)["calibration_error"] >= best["calibration_error"]


def test_costs_that_are_given_are_kept(network, rows):
    network.config = CNNConfig(reject=0.033, spread=0.0071)
    assert choose_costs(network, NAMES, rows[:2]) == CNNConfig(reject=0.033, spread=0.0071)
