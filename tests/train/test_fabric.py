"""Training in two processes is training in one: the same samples, losses and weights, if resumed too."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from handsim.errors import ArgumentError, WeightsError
from handsim.files.signals import Stopped
from train import SetLabelerConfig, TrainSettings, train_labeler
from train.data.batches import Part, draw_batch
from train.fabric import start_fabric
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.networks import batch_loss, new_network, prepare_network
from train.labelers.storage import CARD, WEIGHTS, load_network
from train.loop import CHECKPOINT
from train.reports.run_page import PAGE
from train.settings import batch_recipe, usual_settings

pytestmark = [pytest.mark.xdist_group("many devices"), pytest.mark.slow]  # what they share is made once
ROOT = Path(__file__).resolve().parents[2]
SMALL = SetLabelerConfig(width=8, gates=2, depth=1)
ONE = TrainSettings(samples=640, batch=32, network=SMALL)
OPTIONS = ["--samples", "640", "--batch", "32", "--network.width", "8", "--network.gates", "2"]
OPTIONS += ["--network.depth", "1"]
HANDSIM = [sys.executable, "-c", "import sys; from handsim.cli.main import main; sys.exit(main())"]
SRUN = {"SLURM_JOB_ID": "4711", "SLURM_JOB_NAME": "training", "SLURM_NODELIST": "127.0.0.1"}
SRUN |= {"SLURM_NTASKS": "2", "SLURM_STEP_NUM_TASKS": "2", "SLURM_NNODES": "1", "SLURM_STEP_NUM_NODES": "1"}
SRUN |= {"SLURM_NODEID": "0"}


@pytest.fixture(scope="module")
def one(dataset, tmp_path_factory):
    """A run on one device."""
    out = tmp_path_factory.mktemp("runs") / "one"
    train_labeler(dataset, out, ONE, threads=1)
    return out


def weights_of(run):
    return load_network(run)[0].state_dict()


def losses_of(run):
    return np.array(torch.load(run / CHECKPOINT, weights_only=True)["history"]["losses"])


def check_same_run(run, other):
    """Rounding differs: gradients are added in another order."""
    assert losses_of(run) == pytest.approx(losses_of(other), rel=1e-3)
    for name, values in weights_of(other).items():
        assert torch.allclose(weights_of(run)[name], values, atol=1e-3), name
    curves = [json.loads((folder / CARD).read_text())["curve"] for folder in (run, other)]
    assert [entry[0] for entry in curves[0]] == [entry[0] for entry in curves[1]]
    assert (run / PAGE).is_file() and not list(run.glob(".*"))


def environment(**variables):
    """This one, with the sources and without a word about processes."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    return {**kept, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}


def torchrun(tmp_path, dataset, out, *options):
    command = tmp_path / "handsim"
    command.write_text(f"#!/bin/sh\nexec '{sys.executable}' -c '{HANDSIM[2]}' \"$@\"\n")
    command.chmod(0o755)
    start = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    return subprocess.run(
        [*start, "--no-python", command, "train", dataset.path, "--out", out, *options],
        capture_output=True, text=True, check=False, env=environment(),
    )  # fmt: skip


def test_torchrun_needs_no_options(dataset, one, tmp_path):
    done = torchrun(tmp_path, dataset, tmp_path / "run", *OPTIONS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("weights and model card in") == done.stdout.count("report in") == 1
    check_same_run(tmp_path / "run", one)
    assert json.loads((tmp_path / "run" / CARD).read_text())["train"]["devices"] == 2


def test_a_run_goes_on_with_another_number_of_devices(dataset, one, tmp_path):
    """The checkpoint has no devices; a run of one that stopped half way ends in two as the whole run."""

    def stop(done, expected):
        if done == 64:
            raise KeyboardInterrupt

    with pytest.raises(Stopped, match=r"64 of 640 samples are kept in .*checkpoint\.pt"):
        train_labeler(dataset, tmp_path / "run", ONE, progress=stop, threads=1)
    done = torchrun(tmp_path, dataset, tmp_path / "run", *OPTIONS)
    assert done.returncode == 0, done.stderr
    check_same_run(tmp_path / "run", one)


def tasks_of_srun(dataset, out, *options):
    """The two processes that `srun --ntasks 2` starts, in their environment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    return [
        subprocess.Popen(
            [*HANDSIM, "train", str(dataset.path), "--out", str(out), *OPTIONS, *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=environment(**SRUN, SLURM_PROCID=str(rank), SLURM_LOCALID=str(rank), MASTER_PORT=port),
        )
        for rank in range(2)
    ]  # fmt: skip


def ends_of(tasks):
    outputs = [task.communicate(timeout=300) for task in tasks]
    return [task.returncode for task in tasks], *zip(*outputs, strict=True)


def test_a_run_of_slurm_is_stopped_by_a_signal_to_one_task(dataset, one, tmp_path):
    tasks = tasks_of_srun(dataset, tmp_path / "run")
    while not (tmp_path / "run" / "train.json").exists() and tasks[0].poll() is None:
        time.sleep(0.05)
    tasks[1].send_signal(signal.SIGTERM)
    codes, said, told = ends_of(tasks)
    assert codes == [143, 143], told
    assert said == ("", "")
    assert all(one.startswith("handsim train: ended by SIGTERM") for one in told), told


def test_a_mistake_ends_all_tasks(dataset, one):
    codes, said, told = ends_of(tasks_of_srun(dataset, one, "--seed", "1"))
    assert codes == [1, 1], told
    assert said == ("", "")
    assert "holds a training run begun with other settings (train.seed: 0 there, 1 here)" in told[0]
    assert "Traceback" not in told[1] and told[1].count("\n") == 1


def test_tasks_that_cannot_share_a_batch_are_told(tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "4")
    with pytest.raises(ArgumentError, match="batch is 2, expected at least 4: a cloud for each device"):
        start_fabric(TrainSettings(batch=2), tmp_path)
    monkeypatch.setenv("SLURM_STEP_NUM_NODES", "3")
    with pytest.raises(ArgumentError, match="srun started 4 tasks on 3 nodes, expected as many on each"):
        start_fabric(TrainSettings(), tmp_path)


def test_a_run_of_an_earlier_version_with_its_number_of_devices_goes_on(dataset, tmp_path):
    short = dataclasses.replace(ONE, samples=64)
    train_labeler(dataset, tmp_path, short)
    settings = json.loads((tmp_path / "train.json").read_text())
    assert "devices" not in settings["train"]
    settings["train"]["devices"] = 4
    (tmp_path / "train.json").write_text(json.dumps(settings))
    train_labeler(dataset, tmp_path, short)
    with pytest.raises(WeightsError, match=r"\(train.seed: 0 there, 1 here\)"):
        train_labeler(dataset, tmp_path, dataclasses.replace(short, seed=1))


@pytest.mark.parametrize("views", ["aligned", "random"])
def test_parts_of_a_batch_give_the_papers_network_the_loss_of_the_whole(dataset, tmp_path, views):
    """Each cloud keeps its own view; batch normalization is off, which sees the part alone."""
    config = usual_settings("cnn")
    config = dataclasses.replace(config, batch=7, cnn=dataclasses.replace(config.cnn, views=views))
    fabric = start_fabric(TrainSettings(precision="32"), tmp_path)
    network = new_network(config.cnn)
    assert isinstance(network, DeepLabelCNN)
    prepare_network(network, dataset.mapped_rows())
    network.eval()

    def loss(part):
        rng = np.random.default_rng(3)
        recipe = batch_recipe(config, len(dataset.marker_names))
        batch = draw_batch(dataset.mapped_rows(), recipe, rng=rng)
        with torch.no_grad():
            return float(batch_loss(config, network, batch, fabric.device, rng=rng, part=part))

    parts = [loss(Part(first, 3)) for first in range(3)]
    assert np.mean(parts) == pytest.approx(loss(Part()), rel=1e-5)
    assert (tmp_path / WEIGHTS).exists() is False
