"""Workers: jobs are shared out, errors come back, and nothing outlives a parent that is killed."""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from handsim import HandSimError
from handsim.app.workers import LocalProcesses, check_workers, run_jobs, usable_cores
from handsim.errors import ArgumentError, DatasetError, LayoutError

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import multiprocessing, os, sys, time
sys.path.insert(0, ROOT)
from handsim.app.workers import run_jobs
def job(number):
    if multiprocessing.parent_process():
        os.write(1, f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}\\n".encode())  # in one piece
    time.sleep(600)
if __name__ == "__main__":
    list(run_jobs(job, range(4), 3))
"""
SCRIPT = """
import operator, sys
sys.path.insert(0, ROOT)
print("begin", flush=True)
from handsim.app.workers import check_workers, run_jobs
def own(number):
    return number
"""
CALL = "print(sorted(run_jobs({job}, range(5), 2)))\n"
GUARDED = 'if __name__ == "__main__":\n    ' + CALL


def sign_and_meet(folder: Path, number: int) -> int:
    (folder / str(number)).write_text(str(os.getpid()))
    while len(list(folder.iterdir())) < 3:
        time.sleep(0.02)
    return number


def double(number: int) -> int:
    return number


def fail_at_two(number: int) -> int:
    if number == 2:
        raise LayoutError("number 2 does not fit")
    return number


class Odd(Exception):
    def __init__(self, one, two):
        super().__init__("cannot be pickled")


def fail_oddly(number: int) -> int:
    if number:
        raise Odd(1, 2)
    return number


def sign_and_wait(folder: Path, number: int) -> None:
    (folder / str(number)).write_text(str(os.getpid()))
    threading.Event().wait()


def die_in_a_worker(number: int) -> int:
    if multiprocessing.parent_process() is not None:
        os._exit(3)
    return number


@pytest.mark.parametrize("workers", [1, 2, 9])
def test_every_job_is_done_once(workers):
    assert sorted(run_jobs(double, range(7), workers)) == list(range(7))
    assert list(run_jobs(double, [], workers)) == []


def test_this_process_and_others_do_jobs(tmp_path):
    job = functools.partial(sign_and_meet, tmp_path)
    assert sorted(run_jobs(job, range(6), 3)) == list(range(6))
    signed = [int((tmp_path / str(number)).read_text()) for number in range(6)]
    assert signed[0] == os.getpid() and len(set(signed)) == 3


def test_another_executor_does_all_jobs(monkeypatch):
    monkeypatch.setattr("handsim.app.workers._MAX_PENDING", 5)
    with ThreadPoolExecutor(3) as threads:
        assert sorted(run_jobs(double, range(3, 40), threads)) == list(range(3, 40))
        with pytest.raises(LayoutError, match="number 2 does not fit"):
            list(run_jobs(fail_at_two, range(5), threads))


def test_what_a_job_raises_comes_back():
    for job, said in ((fail_at_two, "number 2 does not fit"), (fail_oddly, "Odd: cannot be pickled")):
        with pytest.raises(HandSimError, match=said):
            list(run_jobs(job, range(5), 2))


def test_a_worker_that_dies_is_told():
    with pytest.raises(
        DatasetError, match=r"a worker died .*; run the same command again to go on, with fewer --workers"
    ):
        list(run_jobs(die_in_a_worker, range(5), 2))


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a file system")
@pytest.mark.parametrize(("options", "hides"), [("ro", "/dev/shm"), ("ro,size=4k", "/dev/shm")])
def test_where_no_process_can_be_started_one_worker_is_named(options, hides):
    jobs = "print(*run_jobs(operator.index, range(3), N))"
    script = f"import operator; from handsim.app.workers import run_jobs; {jobs}"
    inner = f"mount -t tmpfs -o {options} tmpfs {hides} && {sys.executable} -c '{script}'"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for workers, told in ((2, "give --workers 1"), (1, "0 1 2")):
        command = ["unshare", "--mount", "--map-root-user", "sh", "-c", inner.replace("N)", f"{workers})")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if "unshare failed" in done.stderr or "mount:" in done.stderr:
            pytest.skip("this user cannot mount")
        assert told in done.stdout + done.stderr


def test_a_block_that_raises_ends_workers_at_once(tmp_path):
    with pytest.raises(KeyboardInterrupt), LocalProcesses(2) as processes:
        for number in range(2):
            processes.submit(sign_and_wait, tmp_path, number)
        while len(signed := [text for file in tmp_path.iterdir() if (text := file.read_text())]) < 2:
            time.sleep(0.02)
        raise KeyboardInterrupt
    assert not any(running(int(number)) for number in signed)


def test_the_number_of_workers():
    assert check_workers(None) == usable_cores() and check_workers(3) == 3
    for wrong, expected in ((0, "at least 1"), (-3, "at least 1"), ("many", "a whole number")):
        with pytest.raises(ArgumentError, match=f"workers is {wrong!r}, expected {expected}"):
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
    with subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as parent:
        assert parent.stdout is not None
        lines = [parent.stdout.readline().split() for _ in range(2)]
        assert [line[1] for line in lines] == ["1", "1"], "a worker has one thread"
        parent.send_signal(number)
        parent.stdout.read()  # until the last process that could write is gone
    assert not any(running(int(line[0])) for line in lines)


@pytest.mark.parametrize("piped", [False, True])
@pytest.mark.parametrize(
    ("call", "said"),
    [
        (CALL.format(job="operator.index"), ""),
        (GUARDED.format(job="operator.index"), ""),
        (CALL.format(job="own"), "put the call under `if __name__ == "),
        (GUARDED.format(job="own"), ""),
        ('# without if __name__ == "__main__":\n' + CALL.format(job="operator.index"), ""),
        (
            "check_workers(2)\n" + GUARDED.format(job="own"),
            "ran this script again while it started; put the call under ",
        ),
    ],
)
def test_a_script_without_a_main_guard(call, said, piped, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.replace("ROOT", repr(str(ROOT))) + call)
    command = [sys.executable, *([] if piped else [script])]
    with script.open() as text:
        done = subprocess.run(
            command, stdin=text if piped else None, capture_output=True, text=True, check=False
        )
    if piped and "(own," in call:
        said = "this session, not a module, defines what the workers use: put the call under"
    if said:
        assert said in done.stderr and "[0" not in done.stdout
        assert done.stdout.count("begin") == (2 if call.startswith("check") and not piped else 1)
        return
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "[0, 1, 2, 3, 4]"), done.stderr
    assert done.stdout.count("begin") == (2 if "if" in call[:2] and "(own," in call and not piped else 1)
