"""Numbered jobs, done in worker processes that end with the process that started them.

Not multiprocessing's pools: their queues need named semaphores, which outlive a process that is killed and
which a machine without /dev/shm does not have. Here each worker has one pipe.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Final, cast

from handsim.errors import ArgumentError, DatasetError, HandSimError

Job = Callable[[int], int]
"""Takes a number and returns it."""
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PR_SET_PDEATHSIG: Final = 1
_PATIENCE: Final = 1.0  # [s] until a worker that was asked to end is killed


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_workers(workers: int | None) -> int:
    """A number of processes: the given one, or one a core.

    Raises:
        ArgumentError: It is less than 1.
    """
    if workers is not None and workers < 1:
        raise ArgumentError(f"workers is {workers}, expected at least 1")
    return usable_cores() if workers is None else workers


def in_processes(job: Job, todo: Sequence[int], workers: int, *, first_alone: bool = True) -> Iterator[int]:
    """Do jobs and yield the number of each when it is done.

    Workers have one thread each; they end when this process does, however it ends.

    Args:
        job: Takes a number and returns it; workers are spawned and unpickle it.
        todo: The numbers of the jobs.
        workers: Number of processes; with one, all jobs are done in this process.
        first_alone: Whether the first is done in this process, before the others. This fills numba's cache
            before workers need it, and a mistake common to all jobs shows at once.

    Raises:
        DatasetError: A worker died.
    """
    if todo and (first_alone or workers == 1):
        yield job(todo[0])
        todo = todo[1:]
    if workers == 1 or len(todo) == 1:
        yield from (job(number) for number in todo)
        return
    if not todo:
        return
    pool: dict[Connection, SpawnProcess] = {}
    try:
        for _ in range(min(workers, len(todo))):
            channel, process = spawn(_work, job)
            pool[channel] = process
        yield from _share_out(todo, list(pool))
    finally:
        end_processes(pool)


def _share_out(todo: Sequence[int], channels: list[Connection]) -> Iterator[int]:
    """Give each worker a job whenever it has none, and yield the numbers that come back."""
    waiting = iter(todo)
    busy = set()
    for channel, number in zip(channels, waiting, strict=False):
        _send(channel, number)
        busy.add(channel)
    while busy:
        for ready in cast("list[Connection]", wait(list(busy))):
            done = _receive(ready)
            number_or_none = next(waiting, None)
            if number_or_none is None:
                busy.discard(ready)
            else:
                _send(ready, number_or_none)
            yield done


def _send(channel: Connection, number: int) -> None:
    try:
        channel.send(number)
    except OSError as error:
        raise _death() from error


def _receive(channel: Connection) -> int:
    """The number of a finished job.

    Raises:
        Exception: What the job raised.
        DatasetError: The worker died.
    """
    try:
        answer = channel.recv()
    except (EOFError, OSError) as error:
        raise _death() from error
    if isinstance(answer, BaseException):
        raise answer
    return int(answer)


def _death() -> DatasetError:
    return DatasetError("a worker died (out of memory?); run the same command again to go on")


def spawn(live: Callable[..., None], *args: object) -> tuple[Connection, SpawnProcess]:
    """A process that calls `live(*args, channel)`, and this end of its pipe.

    It ends when this process does, however that ends, has one thread unless the user chose otherwise, and
    does not hear Ctrl-C or hang-ups.
    """
    context = multiprocessing.get_context("spawn")
    channel, theirs = context.Pipe()
    process = context.Process(target=_bound, args=(os.getpid(), live, *args, theirs), daemon=True)
    with _one_thread(), without_signals():
        process.start()
    theirs.close()
    return channel, process


def _bound(parent: int, live: Callable[..., None], *args: object) -> None:
    _end_with(parent)
    live(*args)


def end_processes(pool: dict[Connection, SpawnProcess]) -> None:
    """End processes, whatever they do, and wait until they are gone."""
    for channel, process in pool.items():
        channel.close()
        process.terminate()
    for process in pool.values():
        process.join(_PATIENCE)
        process.kill()
        process.join()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started within the block use one thread each, unless the user chose otherwise."""
    added = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def without_signals() -> Iterator[None]:
    """Processes started within the block do not hear Ctrl-C or hang-ups; this one hears them after it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(job: Job, channel: Connection) -> None:
    """The life of a worker: do one job after the other until the pipe closes."""
    signal.signal(signal.SIGTERM, _leave)  # so that a half-written file is removed
    try:
        _do_jobs(job, channel)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what Python calls at its end would print the exit


def _do_jobs(job: Job, channel: Connection) -> None:
    while True:
        try:
            number = channel.recv()
        except (EOFError, OSError):
            return
        try:
            answer: int | Exception = job(number)
        except Exception as error:
            answer = portable(error)
        try:
            channel.send(answer)
        except OSError:
            return


def _leave(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(1)


def _end_with(parent: int) -> None:
    """Have this process killed when its parent ends, however that ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before
            os._exit(1)
        return

    def watch() -> None:
        process = multiprocessing.parent_process()
        if process is not None:
            process.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def portable(error: Exception) -> Exception:
    """The same error, or its words where it does not survive the pipe."""
    try:
        same = pickle.loads(pickle.dumps(error))
    except Exception:
        return HandSimError(f"{type(error).__name__}: {error}")
    return same if isinstance(same, type(error)) else HandSimError(str(error))
