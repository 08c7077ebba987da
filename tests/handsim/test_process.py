"""What a process inherits: its rank, its quotas, and numpy's and torch's settings, which stay as they are."""

from __future__ import annotations

import importlib
import inspect
import math
import os
import pickle
import sys

import numpy as np
import pytest
import torch

from handsim import _process
from handsim._process import (
    SharedStream,
    core_quota,
    environment,
    memory_limit,
    own_numerics,
    rank_and_size,
    torch_kept,
    with_own_numerics,
)
from handsim.app.workers import check_workers, usable_cores
from handsim.files.outputs import available_bytes
from tests.programs import run_python

LAUNCHED = [name for names in _process._RANK_VARIABLES for name in names]
PACKAGES = ("handsim", "poses", "gloves", "render", "train", "track", "film")


@pytest.fixture
def alone(monkeypatch):
    for name in (*LAUNCHED, "SLURM_NTASKS", "SLURM_CPUS_PER_TASK"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


def test_variables_of_the_environment_are_as_before_after_a_block(monkeypatch):
    monkeypatch.setenv("ONE", "1")
    monkeypatch.delenv("OTHER", raising=False)
    with pytest.raises(KeyError), environment(ONE="2", OTHER="3"):
        assert (os.environ["ONE"], os.environ["OTHER"]) == ("2", "3")
        raise KeyError
    assert os.environ["ONE"] == "1" and "OTHER" not in os.environ


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"RANK": "1", "WORLD_SIZE": "4"}, (1, 4)),
        ({"SLURM_PROCID": "2", "SLURM_STEP_NUM_TASKS": "3"}, (2, 3)),
        ({"OMPI_COMM_WORLD_RANK": "7", "OMPI_COMM_WORLD_SIZE": "8"}, (7, 8)),
        ({"PMI_RANK": "0", "PMI_SIZE": "2"}, (0, 2)),
        ({"RANK": "1", "WORLD_SIZE": "2", "SLURM_PROCID": "0", "SLURM_STEP_NUM_TASKS": "1"}, (1, 2)),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8"}, (0, 1)),  # python in a job, without srun
        ({"RANK": "3"}, (0, 1)),
        ({"RANK": "2", "WORLD_SIZE": "2"}, (0, 1)),
        ({"RANK": "one", "WORLD_SIZE": "-2"}, (0, 1)),
        ({"RANK": "9" * 5000, "WORLD_SIZE": "9" * 5001}, (0, 1)),
    ],
)
def test_the_rank_is_that_of_the_launcher(variables, expected, alone):
    for name, value in variables.items():
        alone.setenv(name, value)
    assert rank_and_size() == expected


def test_a_worker_has_its_parents_rank(alone):
    alone.setenv("RANK", "1")
    alone.setenv("WORLD_SIZE", "2")
    stream = pickle.loads(pickle.dumps(SharedStream()))
    assert stream._rank_and_size == (1, 2) and stream.share() == (1, 2)
    alone.setenv("WORLD_SIZE", "3")
    assert pickle.loads(pickle.dumps(stream))._rank_and_size == (1, 3), "it is asked anew"


@pytest.mark.parametrize(
    ("own", "files", "cores", "memory"),
    [
        ("0::/", {"cpu.max": "100000 100000\n"}, 1.0, math.inf),
        ("0::/a/b", {"a/cpu.max": "150000 100000", "a/b/cpu.max": "max 100000"}, 1.5, math.inf),
        ("0::/a/b", {"a/cpu.max": "max 100000", "b/cpu.max": "100000 100000"}, math.inf, math.inf),
        ("0::/", {"a/cpu.max": "100000 100000"}, math.inf, math.inf),  # of somebody else
        ("0::/job", {"job/memory.max": "1000000000", "memory.max": "max"}, math.inf, 1e9),
        (
            "4:memory:/docker/x\n3:cpu,cpuacct:/docker/x",  # version 1, as a container of Docker sees it
            {
                "cpu,cpuacct/cpu.cfs_quota_us": "200000",
                "cpu,cpuacct/cpu.cfs_period_us": "100000",
                "memory/memory.limit_in_bytes": "2000000000",
            },
            2.0,
            2e9,
        ),
        ("3:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, math.inf, math.inf),
        ("0::/", {"cpu.max": "100000"}, math.inf, math.inf),
        ("0::/", {"cpu.max": "100000 0", "memory.max": ""}, math.inf, math.inf),
        ("0::/", {"cpu.max": "some \xff words", "memory.max": "9" * 5000}, math.inf, math.inf),
        ("nonsense", {"cpu.max": "1 2 3"}, math.inf, math.inf),
        ("0::/../..", {}, math.inf, math.inf),
    ],
)
def test_quotas_of_control_groups(own, files, cores, memory, alone, tmp_path):
    for name, text in files.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(text, "latin-1")
    (tmp_path / "own").write_text(own)
    alone.setattr(_process, "_CGROUP_ROOT", tmp_path / "groups")
    alone.setattr(_process, "_OWN_CGROUPS", tmp_path / "own")
    assert (core_quota(), memory_limit()) == (cores, memory)
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert usable_cores() == min(here, math.ceil(min(cores, here)))
    assert available_bytes() <= memory and 1 <= check_workers(None) <= usable_cores()


@pytest.mark.parametrize(("stated", "most"), [("1", 1), ("0", 1), ("", None), ("many", None), ("999", None)])
def test_a_task_of_slurm_has_its_own_cores(stated, most, alone):
    cores = usable_cores()
    alone.setenv("SLURM_CPUS_PER_TASK", stated)
    assert usable_cores() == (cores if most is None else most)


def test_where_memory_is_short_there_are_fewer_workers(alone):
    alone.setattr("handsim.app.workers.available_bytes", lambda: 100_000_000)
    assert check_workers(None) == 1 and check_workers(5) == 5


@pytest.fixture
def unusual():
    """Settings of numpy and torch that no calculation of ours expects."""
    before = np.seterr(all="raise")
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.use_deterministic_algorithms(True, warn_only=True)
    with torch.inference_mode(), torch.autocast("cpu"):
        yield
    np.seterr(**before)
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)
    torch.use_deterministic_algorithms(False)


def settings() -> tuple[object, ...]:
    return (
        np.geterr(),
        torch.get_default_dtype(),
        torch.get_default_device(),
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.is_autocast_enabled("cpu"),
    )


def calculate():
    np.exp(np.float64(-1e4))
    weight = torch.ones(3, requires_grad=True)
    (weight @ torch.eye(3)).sum().backward()
    assert weight.dtype == torch.float32 and weight.grad.tolist() == [1.0] * 3


def calculate_twice():
    for number in range(2):
        calculate()
        yield number


def test_settings_neither_count_nor_change(unusual):
    before = settings()
    with pytest.raises(FloatingPointError):
        np.exp(np.float64(-1e4))
    with own_numerics():
        calculate()
    with_own_numerics(calculate)()
    assert settings() == before
    steps = with_own_numerics(calculate_twice)()
    for number in steps:
        assert number in (0, 1) and settings() == before, "who takes the items keeps the settings"
    with pytest.raises(ZeroDivisionError):
        with_own_numerics(lambda: 1 / 0)()
    assert settings() == before


def test_training_leaves_torchs_random_state_and_denormal_numbers():
    before, small = torch.get_rng_state(), sys.float_info.min
    with torch_kept():
        torch.manual_seed(1)
        torch.set_flush_denormal(True)
    assert torch.equal(torch.get_rng_state(), before) and small * 0.5 > 0.0


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_function_computes_with_our_own_settings(package):
    module = importlib.import_module(package)
    public = [one for name in module.__all__ if inspect.isfunction(one := getattr(module, name))]
    assert public and all(hasattr(one, "__wrapped__") for one in public)
    assert all(pickle.loads(pickle.dumps(one)) is one for one in public)


@pytest.mark.slow
def test_a_take_is_tracked_and_drawn_where_numpy_raises():
    """From the first import on, in a process of its own."""
    script = """
import numpy as np, warnings
np.seterr(all="raise")
from render import draw
from track import Tracker, label_capture, track_capture
from train import simulate_take
take = simulate_take("single-hand", num_frames=60, seed=1)
tracked = track_capture(take, size="M", glove="dense19")
assert (tracked.labels >= 0).mean() > 0.9 and (label_capture(take, size="M").labels >= 0).mean() > 0.9
tracker = Tracker(take.hands)
assert (tracker.step(take.points[0][np.isfinite(take.points[0, :, 0])], time=0.0).labels >= 0).any()
(frame,) = draw(tracked, frames=[30], seed=1, passes=("rgb",), painter="compiled")
assert np.geterr() == dict.fromkeys(("divide", "over", "under", "invalid"), "raise")
"""
    run_python(script)
