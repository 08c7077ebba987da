"""Numbered jobs on workers: processes of this machine, or any other `concurrent.futures.Executor`."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Final

from handsim._checks import check_count
from handsim.errors import DatasetError, HandSimError

Job = Callable[[int], int]
"""Takes a number, leaves files that depend on nothing else, and returns the number; it can be pickled."""
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_IN_FLIGHT: Final = 1000  # jobs that an executor knows of: enough for hundreds of workers, few in memory
_AGAIN: Final = "run the same command again to go on"


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_workers(workers: int | None) -> int:
    """A number of processes: the given one, or one a core."""
    if workers is None:
        return usable_cores()
    check_count("workers", workers, 1)
    return workers


def run_jobs(job: Job, todo: Sequence[int], workers: int | Executor | None) -> Iterator[int]:
    """Do jobs, each in any process and in any order, and yield the number of each when it is done.

    Args:
        job: Takes a number and returns it.
        workers: Number of processes, all cores when not given; or an executor. With a number the first job is
            done in this process, before the others: this fills numba's cache before workers need it, and a
            mistake common to all jobs shows at once.

    Raises:
        Exception: What a job raised.
        DatasetError: A worker died.
    """
    if isinstance(workers, Executor):
        yield from _share_out(job, todo, workers)
        return
    count = check_workers(workers)
    here = len(todo) if count == 1 or len(todo) == 2 else 1
    for number in todo[:here]:
        yield job(number)
    if todo[here:]:
        with LocalProcesses(min(count, len(todo) - here)) as processes:
            yield from _share_out(job, todo[here:], processes)


def _share_out(job: Job, todo: Sequence[int], executor: Executor) -> Iterator[int]:
    """Keep an executor supplied with jobs, and yield the numbers of those that are done."""
    waiting = iter(todo)
    pending: set[Future[int]] = set()
    try:
        while True:
            more = islice(waiting, _IN_FLIGHT - len(pending))
            pending.update([executor.submit(_do, job, number) for number in more])
            if not pending:
                return
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise DatasetError(f"a worker died (out of memory?); {_AGAIN}") from error
    except CancelledError as error:
        raise HandSimError(f"the workers are gone; {_AGAIN}") from error
    finally:
        for future in pending:
            future.cancel()


def _do(job: Job, number: int) -> int:
    """Do a job in a worker; its error comes back as it is, or in words where it cannot be pickled."""
    try:
        return job(number)
    except Exception as error:
        raise portable(error) from None


class LocalProcesses(ProcessPoolExecutor):
    """Processes of this machine, spawned when they are needed, with one thread each unless the user chose.

    They end with the block; at once if it raises, or if this process ends, however that ends. They do not
    hear Ctrl-C and hang-ups.
    """

    def __init__(self, workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        theirs, self._ours = context.Pipe(duplex=False)
        super().__init__(workers, mp_context=context, initializer=_end_with, initargs=(theirs,))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Have a process call `fn(*args, **kwargs)`."""
        with _one_thread(), without_signals():  # this starts a process if none waits for work
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._ours.close()
        self.shutdown(wait=True, cancel_futures=kind is not None)
        self._ours.close()


def _end_with(channel: Connection) -> None:
    """Have this process end when the other end of a pipe is closed, as it is when its process ends."""

    def watch() -> None:
        try:
            channel.poll(None)
        except OSError:  # on Windows
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


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


def portable(error: Exception) -> Exception:
    """The same error, or its words where it does not survive pickling."""
    try:
        same = pickle.loads(pickle.dumps(error))
    except Exception:
        return HandSimError(f"{type(error).__name__}: {error}")
    return same if isinstance(same, type(error)) else HandSimError(str(error))
