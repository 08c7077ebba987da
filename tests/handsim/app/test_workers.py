"""Workers: jobs are shared out, errors come back, and nothing outlives a parent that is killed."""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from handsim.app.workers import _work, check_workers, in_processes, usable_cores
from handsim.errors import ArgumentError, DatasetError, LayoutError

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import os, sys, time
sys.path.insert(0, ROOT)
from handsim.app.workers import in_processes
def job(number):
    if number:
        os.write(1, f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}\\n".encode())  # in one piece
        time.sleep(60)
    return number
if __name__ == "__main__":
    list(in_processes(job, range(4), 2))
"""


def sign(folder: Path, number: int) -> int:
    (folder / str(number)).write_text(str(os.getpid()))
    return number


def double(number: int) -> int:
    return number


def fail_at_two(number: int) -> int:
    if number == 2:
        raise LayoutError("number 2 does not fit")
    return number


def die_at_two(number: int) -> int:
    if number == 2:
        os._exit(3)
    return number


@pytest.mark.parametrize("first_alone", [True, False])
@pytest.mark.parametrize("workers", [1, 2, 9])
def test_every_job_is_done_once(workers, first_alone):
    done = in_processes(double, range(7), workers, first_alone=first_alone)
    assert sorted(done) == list(range(7))
    assert list(in_processes(double, [], workers, first_alone=first_alone)) == []


@pytest.mark.parametrize("first_alone", [True, False])
def test_the_first_job_is_done_here_if_it_shall_be(first_alone, tmp_path):
    job = functools.partial(sign, tmp_path)
    assert sorted(in_processes(job, range(3), 2, first_alone=first_alone)) == [0, 1, 2]
    signed = [int((tmp_path / str(number)).read_text()) for number in range(3)]
    assert (signed[0] == os.getpid()) == first_alone
    assert os.getpid() not in signed[1:]


def test_what_a_job_raises_comes_back():
    with pytest.raises(LayoutError, match="number 2 does not fit"):
        list(in_processes(fail_at_two, range(5), 2))


def test_a_worker_that_dies_is_told():
    with pytest.raises(DatasetError, match="a worker died"):
        list(in_processes(die_at_two, range(5), 2))


def test_the_number_of_workers():
    assert check_workers(None) == usable_cores() and check_workers(3) == 3
    for wrong in (0, -3):
        with pytest.raises(ArgumentError, match=f"workers is {wrong}, expected at least 1"):
            check_workers(wrong)


def running(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().split(")")[1][:3]
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_workers_end_with_their_parent(number, tmp_path):
    script = tmp_path / "jobs.py"
    script.write_text(PROGRAM.replace("ROOT", repr(str(ROOT))))
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    before = set(os.listdir("/dev/shm"))
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    lines = [parent.stdout.readline().split() for _ in range(2)]
    workers = [int(line[0]) for line in lines]
    assert [line[1] for line in lines] == ["1", "1"], "a worker has one thread"
    assert set(os.listdir("/dev/shm")) <= before, "workers need no semaphores"
    parent.send_signal(number)
    parent.wait(10)
    deadline = time.monotonic() + 10
    while any(map(running, workers)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(map(running, workers))
    assert set(os.listdir("/dev/shm")) <= before


def test_a_worker_that_ends_is_not_interrupted_by_its_own_handler():
    """What Python calls at its end would print the exit that the handler raises."""
    before = signal.getsignal(signal.SIGTERM)
    ours, theirs = multiprocessing.Pipe()
    ours.close()
    try:
        _work(double, theirs)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)
