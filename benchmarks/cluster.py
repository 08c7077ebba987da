"""A Dask scheduler and its workers against this machine's worker processes: bytes, deaths, and overhead.

python -m benchmarks.cluster [--frames 400000] [--pictures 5000] [--workers 4] [--rounds 2] [--shards 10000]

Training sets and pictures are made by worker processes and by as many `dask worker` processes of one thread,
in turns, and compared byte by byte. Then each is made once more while two of the workers are killed (SIGKILL)
and another one is started. At last shards that do nothing show what the scheduler takes for each.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.record import describe, run
from handsim.app.workers import chosen_workers, run_jobs
from render import RenderConfig, render_take
from train import GenerateSettings, simulate_take
from train.simulation.generation import make_dataset

WAIT = 60.0  # [s] for a scheduler or a worker to come


@dataclass
class DaskProcesses:
    """A scheduler and workers, each a process of its own that was started by Dask's own command."""

    folder: Path
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        """The scheduler's, once it wrote its file."""
        return str(json.loads((self.folder / "scheduler.json").read_text())["address"])

    def start(self, count: int) -> None:
        """Start the scheduler and some workers, and wait until all are there."""
        self.scheduler = self._dask(
            "scheduler", "--scheduler-file", "scheduler.json", "--port", "0", "--host", "127.0.0.1"
        )
        until = time.monotonic() + WAIT
        while not (self.folder / "scheduler.json").exists():
            assert time.monotonic() < until, "no scheduler"
            time.sleep(0.05)
        for _ in range(count):
            self.add_worker()
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=WAIT)

    def add_worker(self) -> None:
        """Start one more, which does not come back when it is killed."""
        options = ("--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--local-directory", ".")
        self.workers.append(self._dask("worker", self.address, *options))

    def kill_worker(self) -> None:
        """Kill the oldest one."""
        self.workers.pop(0).send_signal(signal.SIGKILL)

    def stop(self) -> None:
        """End all of them."""
        for process in (*self.workers, self.scheduler):
            process.terminate()
            process.wait()

    def _dask(self, name: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", *options, "--no-dashboard"]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        log = (self.folder / "dask.log").open("ab")
        return subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log, env=environment)


Make = Callable[[Path, int | Executor], object]


def main(
    frames: int = 400_000, pictures: int = 5_000, workers: int = 4, rounds: int = 2, shards: int = 10_000
) -> None:
    print(describe("dask", "distributed"))
    with tempfile.TemporaryDirectory() as name, running(Path(name), workers) as dask:
        folder = Path(name)
        take = simulate_take(kind="hand-hand", num_frames=pictures)
        take.save(folder / "take.npz")
        kinds: dict[str, Make] = {
            f"{frames} training frames": functools.partial(make_frames, frames),
            f"{pictures} pictures": functools.partial(draw_pictures, folder / "take.npz"),
        }
        for kind, make in kinds.items():
            compare(kind, make, dask, workers, rounds)
        empty_shards(dask, workers, shards)


@contextmanager
def running(folder: Path, workers: int) -> Iterator[DaskProcesses]:
    """A cluster that ends with the block."""
    dask = DaskProcesses(folder / "dask")
    dask.folder.mkdir()
    try:
        dask.start(workers)
        yield dask
    finally:
        dask.stop()


def make_frames(count: int, out: Path, workers: int | Executor) -> None:
    make_dataset(GenerateSettings(num_frames=count, seed=3), out, workers=workers)


def draw_pictures(take: Path, out: Path, workers: int | Executor) -> None:
    config = RenderConfig(passes=("rgb", "depth", "ids"), depth_sensor=None, color_sensor=None, seed=3)
    render_take(take, out, ("webdataset",), config, workers=workers)


def compare(kind: str, make: Make, dask: DaskProcesses, count: int, rounds: int) -> None:
    """Make the same in turns by either, and once more while workers die and come."""
    seconds: dict[str, list[float]] = {"processes": [], "dask": []}
    results: set[str] = set()
    for _ in range(rounds):
        for name, times in seconds.items():
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "out"
                start = time.perf_counter()
                with chosen(name, dask, count) as workers:
                    make(out, workers)
                times.append(time.perf_counter() - start)
                results.add(digest(out))
    pool, there = (float(np.median(each)) for each in seconds.values())
    print(
        f"{kind}: {count} processes {pool:.1f} s, {count} Dask workers {there:.1f} s, "
        f"overhead {100 * (there / pool - 1):.1f} %; bytes {'equal' if len(results) == 1 else 'DIFFER'}"
    )
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        timers = [threading.Timer(share * there, dask.kill_worker) for share in (0.2, 0.5)]
        timers.append(threading.Timer(0.4 * there, dask.add_worker))
        for timer in timers:
            timer.start()
        start = time.perf_counter()
        with chosen("dask", dask, count) as workers:
            make(out, workers)
        took = time.perf_counter() - start
        for timer in timers:
            timer.join()
        same = {digest(out)} == results
    dask.add_worker()  # as many as before
    print(
        f"{kind}: two workers killed and one added: {took:.1f} s; bytes {'equal' if same else 'DIFFER'}",
        flush=True,
    )


def digest(folder: Path) -> str:
    """Of the names and bytes of all files, hidden ones too."""
    whole = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            whole.update(f"{path.relative_to(folder)}".encode() + hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


def nothing(number: int) -> int:
    return number


def chosen(name: str, dask: DaskProcesses, count: int) -> AbstractContextManager[int | Executor]:
    """Processes of this machine, or the workers of the scheduler."""
    if name == "dask":
        return chosen_workers(dask.address, None, lambda line: None)
    return chosen_workers(None, count, print)


def empty_shards(dask: DaskProcesses, count: int, shards: int) -> None:
    """What either takes for a shard, if nothing is to be done."""
    for name in ("dask", "processes"):
        start = time.perf_counter()
        with chosen(name, dask, count) as workers:
            done = sum(1 for _ in run_jobs(nothing, range(shards), workers))
        took = time.perf_counter() - start
        print(f"{done} empty shards, {name}: {took:.1f} s, {1e3 * took / done:.2f} ms each", flush=True)


if __name__ == "__main__":
    run(main, __doc__)
