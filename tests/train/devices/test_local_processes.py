"""Processes of one machine: a result, one error, one signal, and none that outlives its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from handsim.errors import ArgumentError, HandSimError
from handsim.files.signals import Stopped
from train.devices.agreement import Agreement, PeerError
from train.devices.fabric_start import start_fabric
from train.devices.local_processes import in_local_processes
from train.devices.world import world_of
from train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import os, sys, time
sys.path.insert(0, ROOT)
from train.devices.local_processes import in_local_processes
def job(*, progress, told):
    os.write(1, f"{os.getpid()}\\n".encode())
    try:
        while True:
            progress(1, 2, 0.5)
            time.sleep(0.01)
    except KeyboardInterrupt:
        open(f"kept-{os.getpid()}", "w").close()
        raise
if __name__ == "__main__":
    in_local_processes(job, 2, progress=None)
"""


def sums(*, progress, told):
    fabric = start_fabric(TrainSettings(), Path("unused"))
    total = float(fabric.all_reduce(torch.tensor(fabric.global_rank + 1.0), reduce_op="sum"))
    progress(1, 2, total)
    told(f"step of {total:.0f}")
    return fabric.world_size, total, listening()


def listening():
    """The addresses at which this process waits for connections, in hexadecimal."""
    sockets = {os.readlink(entry) for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()}
    lines = [
        line.split()
        for table in ("tcp", "tcp6")
        for line in Path("/proc/net", table).read_text().splitlines()[1:]
    ]
    return {line[1].split(":")[0] for line in lines if line[3] == "0A" and f"socket:[{line[9]}]" in sockets}


def fails(*, progress, told):
    ranks = Agreement(start_fabric(TrainSettings(), Path("unused")))
    mine = world_of().rank

    def attempt():
        if mine:
            raise ArgumentError(f"{mine} does not fit")

    with ranks.losses_told():
        ranks.agree(lambda: None)
        ranks.agree(attempt)


def dies(*, progress, told):
    fabric = start_fabric(TrainSettings(), Path("unused"))
    if world_of().rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    with Agreement(fabric).losses_told():
        fabric.all_reduce(torch.ones(3))


def waits_for_a_signal(*, progress, told):
    ranks = Agreement(start_fabric(TrainSettings(), Path("unused")))
    with ranks.signals_noted():
        ranks.agree(lambda: None)
        if world_of().rank == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)  # the second one changes nothing
        while True:
            ranks.agree(lambda: time.sleep(0.01))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_work_together_over_the_loopback_and_the_first_ones_result_counts():
    told, steps = [], []
    result = in_local_processes(sums, 2, progress=lambda *step: told.append(step), told=steps.append)
    assert result == (2, 3.0, {"0100007F"})
    assert told == [(1, 2, 3.0)] * 2 and steps == ["step of 3"] * 2


@pytest.mark.parametrize(
    ("job", "kind", "told"),
    [
        (fails, ArgumentError, "^1 does not fit"),
        (dies, HandSimError, "process 1 of the training was ended by SIGKILL .* run the same command again"),
        (waits_for_a_signal, Stopped, None),
    ],
)
def test_what_ends_one_process_ends_all_and_is_told(job, kind, told):
    with pytest.raises(kind, match=told) as raised:
        in_local_processes(job, 2, progress=None)
    assert not isinstance(raised.value, PeerError)
    if kind is Stopped:
        assert raised.value.number == signal.SIGTERM


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a parent that is killed sends no signal")
def test_processes_of_a_parent_that_is_killed_end_as_by_a_signal(tmp_path):
    script = tmp_path / "jobs.py"
    script.write_text(PROGRAM.replace("ROOT", repr(str(ROOT))))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, script], **pipes, text=True, cwd=tmp_path) as parent:
        assert parent.stdout is not None
        workers = [int(parent.stdout.readline()) for _ in range(2)]
        parent.kill()
        parent.stdout.read()  # until the last process that could write is gone
    assert {path.name for path in tmp_path.glob("kept-*")} == {f"kept-{worker}" for worker in workers}
