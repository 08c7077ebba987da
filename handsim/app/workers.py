"""Numbered jobs on workers: processes of this machine, those of a Dask scheduler, or any other executor."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import math
import multiprocessing
import os
import pickle
import platform
import queue
import re
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Final

from handsim._checks import check_count
from handsim._plugins import import_extra
from handsim._process import core_quota, environment, is_number
from handsim.errors import ArgumentError, DatasetError, HandSimError
from handsim.files.inputs import load_json
from handsim.files.outputs import available_bytes

Job = Callable[[int], int]
"""Writes files that depend on the number alone, and returns the number; it can be pickled."""
_THREAD_VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_MAX_PENDING: Final = 1000  # jobs that an executor holds: enough for hundreds of workers
_WORKER_BYTES: Final = 710_000_000  # largest memory of a worker, docs/cluster.md
_RERUN_HINT: Final = "run the same command again to go on"
_FEWER_HINT: Final = f"(out of memory?); {_RERUN_HINT}, with fewer --workers if they need too much memory"
_GUARD_HINT: Final = 'put the call under `if __name__ == "__main__":`, or give workers=1'
_GUARD_PATTERN: Final = re.compile(r"^if\b.*\b__name__\b", re.M)
_MAIN_MODULE: Final = "__main__"
LOCAL: Final = "local"
"""Name of a scheduler and workers on this machine that end with the command."""
_COMPARED_PACKAGES: Final = ("handsim", "numpy", "scipy", "mujoco", "numba", "opencv-python-headless")
"""Packages that the bytes of results depend on."""
_TIMEOUT: Final = 5.0  # longest wait for the answer of a scheduler [s]


def usable_cores() -> int:
    """Number of cores that affinity, Slurm and control groups allow this process, rounded up."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    task = os.environ.get("SLURM_CPUS_PER_TASK", "")
    return max(1, math.ceil(min(cores, core_quota(), int(task) if is_number(task) else cores)))


def check_workers(workers: int | None) -> int:
    """Number of processes, by default one per core, and not more than the memory holds.

    A worker that runs its parent's script while it starts ends here, before it repeats the parent's work.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(f"a worker process ran this script again while it started; {_GUARD_HINT}")
    if workers is None:
        return max(1, min(usable_cores(), available_bytes() // _WORKER_BYTES))
    check_count("workers", workers, 1)
    return workers


def run_jobs(job: Job, todo: Sequence[int], workers: int | Executor | None) -> Iterator[int]:
    """Run jobs in any process and any order, and yield the number of each finished job.

    `workers` is an executor or a number of processes (by default one per core), of which this process is one.
    It runs the first job while the others start, so an error that all jobs share is raised here.
    """
    if isinstance(workers, Executor):
        with _death_sentences():
            yield from _run_on_executor(job, todo, workers)
        return
    others = min(check_workers(workers), len(todo)) - 1
    if others < 1:
        yield from map(job, todo)
        return
    with _death_sentences(), LocalProcesses(others, _needs_main(job)) as processes:
        yield from _run_here_too(job, todo, processes, others)


def _run_here_too(job: Job, todo: Sequence[int], processes: LocalProcesses, count: int) -> Iterator[int]:
    """Run jobs in this process and in others; each takes its next job when it has finished one."""
    left, finished = deque(todo), queue.SimpleQueue[Future[int]]()

    def take() -> int | None:
        try:
            return left.popleft()  # safe in threads: processes take theirs in a thread of the executor
        except IndexError:
            return None

    def begin(submit: Callable[..., Future[int]]) -> None:
        if (number := take()) is not None:
            future = submit(_do_job, job, number)
            future.add_done_callback(finished.put)
            future.add_done_callback(go_on)

    def go_on(done: Future[int]) -> None:
        if not done.cancelled() and done.exception() is None:
            begin(super(LocalProcesses, processes).submit)  # starts no process, which only this thread may

    mine = take()
    for _ in range(count):
        begin(processes.submit)
    try:
        for _ in todo:
            if mine is None or not finished.empty():
                yield finished.get().result()
            else:
                yield _do_job(job, mine)
                mine = take()
    finally:
        left.clear()


def _needs_main(job: Job) -> bool:
    """Whether workers must run the main script to unpickle a job.

    A script without a guard is refused, because each worker would run its work again.
    """
    content = _pickled(job)
    if content is None or _MAIN_MODULE.encode() not in content:  # the executor raises the error of pickling
        return False
    script = main_script()
    if script is None or not _GUARD_PATTERN.search(script.read_text(encoding="utf-8", errors="replace")):
        defined = f"{script} defines" if script else "this session, not a module, defines"
        raise ArgumentError(f"{defined} what the workers use: {_GUARD_HINT}")
    return True


def main_script() -> Path | None:
    """The file that Python runs; None in a notebook, at a prompt, or where it reads standard input."""
    script = Path(getattr(sys.modules[_MAIN_MODULE], "__file__", None) or "")
    return script if script.is_file() else None


@contextmanager
def _main_left_out() -> Iterator[None]:
    """Start processes in the block that do not run the main script, as multiprocessing's usually do."""
    main, sys.modules[_MAIN_MODULE] = sys.modules[_MAIN_MODULE], ModuleType(_MAIN_MODULE)
    try:
        yield
    finally:
        sys.modules[_MAIN_MODULE] = main


def _run_on_executor(job: Job, todo: Sequence[int], executor: Executor) -> Iterator[int]:
    """Keep an executor supplied with jobs, and yield the numbers of finished ones."""
    waiting = iter(todo)
    pending: set[Future[int]] = set()
    try:
        while True:
            more = islice(waiting, _MAX_PENDING - len(pending))
            pending.update([executor.submit(_do_job, job, number) for number in more])
            if not pending:
                return
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        for future in pending:
            future.cancel()


@contextmanager
def _death_sentences() -> Iterator[None]:
    """Raise one sentence in place of the executor's errors for dead and for vanished workers."""
    try:
        yield
    except BrokenProcessPool as error:
        raise DatasetError(f"a worker died {_FEWER_HINT}") from error
    except CancelledError as error:
        raise HandSimError(f"the workers are gone; {_RERUN_HINT}") from error


def _do_job(job: Job, number: int) -> int:
    """Run a job; an error that cannot be pickled is raised as a `HandSimError` with its text."""
    try:
        return job(number)
    except Exception as error:
        try:
            same = pickle.loads(pickle.dumps(error))
        except Exception:
            raise HandSimError(f"{type(error).__name__}: {error}") from None
        raise (same if isinstance(same, type(error)) else HandSimError(str(error))) from None


class LocalProcesses(ProcessPoolExecutor):
    """Processes of this machine, spawned on demand, with one thread each unless the user set another number.

    They end with the block (immediately if it raises) and with this process, even if it is killed. They
    ignore Ctrl-C and hang-ups. They run the main script only if jobs need its definitions.
    """

    def __init__(self, workers: int, needs_main: bool = False) -> None:
        self._needs_main = needs_main
        context = multiprocessing.get_context("spawn")
        theirs, self._ours = context.Pipe(duplex=False)
        try:
            super().__init__(workers, mp_context=context, initializer=_end_with_parent, initargs=(theirs,))
        except (ImportError, OSError) as error:
            raise HandSimError(
                f"no other processes can be started here ({error}): they need /dev/shm that can be written; "
                "give --workers 1, or mount it"
            ) from error

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Have a process call `fn(*args, **kwargs)`."""
        main_module = contextlib.nullcontext() if self._needs_main else _main_left_out()
        with one_thread(), without_signals(), main_module:  # submit starts a process if none is idle
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._ours.close()
        self.shutdown(wait=True, cancel_futures=kind is not None)
        self._ours.close()

    def end(self) -> None:
        """End the processes at once, without waiting for it."""
        self._ours.close()
        self.shutdown(wait=False, cancel_futures=True)


@contextmanager
def second_process(is_wanted: bool, module: str) -> Iterator[LocalProcesses | None]:
    """A second process for a block, which imports a module in the background; None without a free core."""
    if not is_wanted or usable_cores() < 2 or multiprocessing.parent_process() is not None:
        yield None
        return
    try:
        other = LocalProcesses(1)
    except HandSimError:  # no process can be started here; this one does all the work
        yield None
        return
    with other:
        other.submit(_load, module)
        yield other


def can_be_sent(job: Any) -> bool:
    """Whether a process that does not run the main script can unpickle a job."""
    content = _pickled(job)
    return content is not None and _MAIN_MODULE.encode() not in content


def _pickled(job: Any) -> bytes | None:
    """A job as bytes; None for one that cannot be pickled."""
    try:
        return pickle.dumps(job)
    except Exception:  # of any kind, as what the job holds raises it
        return None


def _load(module: str) -> None:
    """Import a module."""
    importlib.import_module(module)


def _end_with_parent(channel: Connection) -> None:
    """End this process when the process at the other end of a pipe ends."""

    def watch() -> None:
        try:
            channel.poll(None)
        except OSError:  # on Windows
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let processes started in the block use one thread each, unless the user chose otherwise."""
    with environment(**{name: "1" for name in _THREAD_VARIABLES if name not in os.environ}):
        yield


@contextmanager
def without_signals() -> Iterator[None]:
    """Let processes started in the block ignore Ctrl-C and hang-ups; this process gets them afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def chosen_workers(
    cluster: str | None, workers: int | None, report: Callable[[str], None]
) -> Iterator[int | Executor]:
    """The workers of the options --cluster and --workers: a number of processes, or a cluster's executor."""
    if cluster is None:
        yield check_workers(workers)
        return
    if workers is not None and cluster != LOCAL:
        raise ArgumentError(f"--workers counts processes of this machine, but {cluster} has its own workers")
    distributed = import_extra("distributed", f"the cluster {cluster}", "cluster")
    with _open_client(distributed, cluster, check_workers(workers)) as client:
        count = len(client.nthreads())
        there = f"{count} workers" if count else "no workers yet; waiting for the first"
        link = f"; dashboard of the cluster: {client.dashboard_link}" if client.dashboard_link else ""
        report(f"{cluster}: {there}{link}")
        try:
            yield ClusterExecutor(client)
        except distributed.KilledWorker as error:
            raise HandSimError(
                f"a job was begun {error.allowed_failures + 1} times; its worker died each time {_FEWER_HINT}"
            ) from error


@contextmanager
def _open_client(distributed: Any, address: str, workers: int) -> Iterator[Any]:
    """A client of a scheduler, which is started if the address is `LOCAL`."""
    if address == LOCAL:
        with without_signals():  # Ctrl-C is for this process, which ends the others
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs="CRITICAL",
            )
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            yield client
        return
    if address.endswith(".json"):
        file, address = address, str(load_json(Path(address)).get("address", ""))
        if not address:
            raise HandSimError(f"{file}: no address, expected what `dask scheduler --scheduler-file` writes")
    try:
        _test_connection(distributed, address)
        client = distributed.Client(address, timeout=_TIMEOUT, set_as_default=False)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        reason = str(error.__cause__ or error).rpartition("] ")[2] or f"none within {_TIMEOUT:g} s"
        raise HandSimError(
            f"no Dask scheduler answers at {address}: {reason}; expected tcp://host:port, tls://host:port, a "
            f"scheduler's file (.json), or {LOCAL}"
        ) from error
    with client:
        yield client


def _test_connection(distributed: Any, address: str) -> None:
    """Connect to a scheduler once, because a failed `distributed.Client` blocks for ten seconds or longer."""

    async def connect_and_close() -> None:
        async with asyncio.timeout(_TIMEOUT):
            client = distributed.Client(address, timeout=_TIMEOUT, asynchronous=True, set_as_default=False)
            try:
                await client
            finally:
                await client.close()

    host_and_port = distributed.comm.get_address_host_port(address)
    socket.create_connection(host_and_port, timeout=_TIMEOUT).close()  # a refusal ends here
    try:
        asyncio.run(connect_and_close())
    except (OSError, RuntimeError, TypeError):
        raise
    except Exception:  # Dask cannot parse the answer
        raise ValueError("something else listens there") from None


class ClusterExecutor(Executor):
    """Dask's executor. Each worker checks that it has one thread and this machine's package versions.

    If a worker dies, another one repeats its job. Workers may join later. Jobs run in the working directory
    of this process if the worker has such a folder.
    """

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)
        self._versions = _versions()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Have a worker call `fn(*args, **kwargs)`."""
        task = _Task(fn, self._versions, Path.cwd())
        future: Future[Any] = self._executor.submit(task, *args, **kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more jobs."""
        self._executor.shutdown(wait=wait and not cancel_futures)


@dataclass(frozen=True, slots=True)
class _Task:
    """A function that a worker calls, with the package versions and the working directory of its sender."""

    function: Callable[..., Any]
    versions: dict[str, str]
    place: Path

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        worker = import_extra("distributed", "a cluster", "cluster").get_worker()
        check_worker(worker.address, worker.state.nthreads, _versions(), self.versions)
        try:
            with contextlib.chdir(self.place if self.place.is_dir() else "."):
                return self.function(*args, **kwargs)
        except (HandSimError, OSError) as error:
            if self.place.is_dir():
                raise
            raise HandSimError(f"on {platform.node()}, which does not see {self.place}: {error}") from error


def check_worker(worker: str, threads: int, found: dict[str, str], expected: dict[str, str]) -> None:
    """Refuse a worker whose results may differ: it needs one thread and these versions."""
    if threads != 1:
        raise HandSimError(
            f"the worker {worker} has {threads} threads, expected 1; start workers with --nthreads 1, one "
            "for each core"
        )
    for name, version in expected.items():
        if found[name] != version:
            raise HandSimError(
                f"the worker {worker} has {name} {found[name]}, this machine has {version}; results depend "
                "on it, so install the same version"
            )


@functools.cache
def _versions() -> dict[str, str]:
    """Versions of the compared packages in this process."""
    about = import_extra("distributed.versions", "a cluster", "cluster")
    found = about.get_package_info(_COMPARED_PACKAGES)
    return {name: found.get(name) or "none" for name in _COMPARED_PACKAGES}
