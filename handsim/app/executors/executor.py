"""What does numbered jobs: one protocol, and the worker processes of this machine behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from handsim.app.executors.dask_cluster import LOCAL, DaskCluster
from handsim.app.workers import Job, check_workers, in_processes
from handsim.errors import ArgumentError
from handsim.files.object_folder import ObjectFolder


class Executor(Protocol):
    """Does numbered jobs, each in any process, in any order, some of them twice."""

    def run(self, job: Job, todo: Sequence[int]) -> Iterator[int]:
        """Do jobs and yield the number of each when it is done.

        Args:
            job: Takes a number, leaves files that depend on nothing else, and returns the number. It can be
                pickled.
            todo: The numbers of the jobs.

        Raises:
            HandSimError: What a job raised, or nobody is left to do the others.
        """
        ...


@dataclass(frozen=True, slots=True)
class Processes:
    """Worker processes of this machine."""

    workers: int
    """How many."""
    first_alone: bool = True
    """Whether the first job is done in this process before the others: it shows a mistake common to all, and
    fills numba's cache."""

    def run(self, job: Job, todo: Sequence[int]) -> Iterator[int]:
        """Do jobs and yield the number of each, see `in_processes`."""
        return in_processes(job, todo, self.workers, first_alone=self.first_alone)


def executor_of(workers: int | Executor | None) -> Executor:
    """An executor as it is; a number of processes, or one a core, as an executor.

    Raises:
        ArgumentError: The number is less than 1.
    """
    return Processes(check_workers(workers)) if workers is None or isinstance(workers, int) else workers


def choose_executor(
    cluster: str | None, workers: int | None, out: Path | ObjectFolder, tell: Callable[[str], None]
) -> Executor:
    """The executor that the options --cluster and --workers stand for.

    Args:
        cluster: The address of a cluster, see `DaskCluster`; this machine when not given.
        workers: Processes of this machine.
        out: Where jobs leave their files; workers need share no folder where that is an object store.
        tell: Takes a line for the user.

    Raises:
        ArgumentError: The options do not fit together, or the address is none.
    """
    if cluster is None:
        return executor_of(workers)
    if workers is not None and cluster != LOCAL:
        raise ArgumentError(f"--workers counts processes of this machine, but {cluster} has its own workers")
    folder = out if isinstance(out, Path) else None
    return DaskCluster(cluster, folder, workers=check_workers(workers), tell=tell)
