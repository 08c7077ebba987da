"""Numbered jobs, done in worker processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from handsim.errors import DatasetError


def in_processes(job: Callable[[int], int], todo: Sequence[int], workers: int) -> Iterator[int]:
    """Do jobs and yield the number of each when it is done.

    The first is done in this process, before the others. This fills numba's cache before workers need it, and
    a mistake common to all jobs shows at once.

    Args:
        job: Takes a number and returns it; workers are spawned and unpickle it.
        todo: The numbers of the jobs.
        workers: Number of processes; with one, all jobs are done in this process.

    Raises:
        DatasetError: A worker died.
    """
    if not todo:
        return
    yield job(todo[0])
    if workers == 1:
        yield from (job(number) for number in todo[1:])
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(1, len(todo) - 1)), mp_context=context) as pool:
        jobs = [pool.submit(job, number) for number in todo[1:]]
        try:
            for one in as_completed(jobs):
                yield one.result()
        except BrokenProcessPool as error:
            raise DatasetError(
                "a worker died (out of memory?); run the same command again to go on"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)
