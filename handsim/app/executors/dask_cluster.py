"""Numbered jobs on the workers of a Dask scheduler, which come and go while it runs."""

from __future__ import annotations

import contextlib
import platform
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from handsim._extras import import_extra
from handsim.app.executors.worker_check import (
    DECIDING,
    WorkerCheck,
    check_this_worker,
    check_threads,
    complete,
    versions_here,
)
from handsim.app.workers import Job, portable, without_signals
from handsim.errors import ArgumentError, HandSimError
from handsim.files.atomic import remove_leftovers, temporary_beside
from handsim.files.json_files import load_json

LOCAL: Final = "local"
"""Stands for a scheduler and workers on this machine, which end with the command."""
_PROTOCOLS: Final = ("tcp", "tls")
_EXPECTED: Final = f"expected tcp://host:port, tls://host:port, a scheduler's file (.json), or {LOCAL}"
_PATIENCE: Final = 5.0  # [s] until a scheduler must have answered
_IN_FLIGHT: Final = 1000  # jobs that the scheduler knows of: enough for hundreds of workers, few in memory
_AGAIN: Final = "; run the same command again to go on"


@dataclass(frozen=True, slots=True)
class DaskCluster:
    """The workers of a Dask scheduler, each a process with one thread.

    A worker that dies loses the job that it was doing, and another does that again. Workers that come later
    take part.
    """

    address: str
    """`tcp://host:port`, `tls://host:port`, a scheduler's file (.json), or `local`."""
    folder: Path | None
    """Where jobs write: a folder that workers see under the same path; None if they share none."""
    workers: int = 1
    """Number of processes of a local cluster."""
    tell: Callable[[str], None] = print
    """Takes a line for the user."""

    def __post_init__(self) -> None:
        if self.address == LOCAL or self.address.endswith(".json"):
            return
        try:
            parts = urlsplit(self.address)
            right = parts.scheme in _PROTOCOLS and bool(parts.hostname) and parts.port is not None
        except ValueError:  # a port that is no number
            right = False
        if not right:
            raise ArgumentError(f"the cluster is '{self.address[:200]}', {_EXPECTED}")

    def run(self, job: Job, todo: Sequence[int]) -> Iterator[int]:
        """Do jobs on the workers and yield the number of each when it is done.

        Raises:
            HandSimError: Nobody answers at the address, a worker cannot do jobs as this machine does, the
                scheduler is lost, a job ended its workers, or what a job raised.
            ArgumentError: Dask is not installed.
        """
        if not todo:
            return
        distributed = import_extra("distributed", f"the cluster {self.address}", "cluster")
        with self._client(distributed) as client, _token(self.folder) as (token, content):
            versions = tuple(
                (name, str(found)) for name, found in versions_here().items() if name in DECIDING
            )
            check = WorkerCheck(versions, Path.cwd(), token, content)
            self._look_around(client, check)
            yield from _share_out(distributed, client, _Task(job, check), todo)
        if self.folder is not None:
            remove_leftovers(self.folder)  # of workers that died

    @contextmanager
    def _client(self, distributed: Any) -> Iterator[Any]:
        """A connection to the scheduler, which is started for it where it is local."""
        if self.address == LOCAL:
            with without_signals():  # Ctrl-C is for this process, which ends the others
                cluster = distributed.LocalCluster(
                    n_workers=self.workers,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs="CRITICAL",
                )
            with cluster, distributed.Client(cluster, set_as_default=False) as client:
                yield client
            return
        address = _in_file(Path(self.address)) if self.address.endswith(".json") else self.address
        try:
            client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = str(error.__cause__ or error).rpartition("] ")[2] or f"none within {_PATIENCE:g} s"
            raise HandSimError(f"no Dask scheduler answers at {address}: {reason}") from error
        with client:
            yield client

    def _look_around(self, client: Any, check: WorkerCheck) -> None:
        """Check the workers that are there, and say what there is to see."""
        for worker, about in client.get_versions(packages=list(DECIDING))["workers"].items():
            check.compare_versions(worker, complete(about["packages"]))
        threads = client.nthreads()
        for worker, count in threads.items():
            check_threads(worker, count)
        for answer in client.run(_folder_trouble, check).values():
            if answer:
                raise HandSimError(answer)
        if not threads:
            self.tell(f"{self.address}: no workers yet; waiting for the first")
        if client.dashboard_link:
            self.tell(f"{len(threads)} workers; dashboard of the cluster: {client.dashboard_link}")


@dataclass(frozen=True, slots=True)
class _Task:
    """A job as a worker does it: in the folder that the command runs in, if it is there."""

    job: Job
    check: WorkerCheck

    def __call__(self, number: int) -> int:
        try:
            check_this_worker(self.check)
            if self.check.token is None:
                return self._alone(number)
            with contextlib.chdir(self.check.place):
                return self.job(number)
        except Exception as error:
            raise portable(error) from None

    def _alone(self, number: int) -> int:
        """Do the job on a worker that may lack files, or credentials, which the command has."""
        try:
            with contextlib.chdir(self.check.place if self.check.place.is_dir() else "."):
                return self.job(number)
        except (HandSimError, OSError) as error:
            raise HandSimError(f"on {platform.node()}, which shares no folder: {error}") from error


def _folder_trouble(check: WorkerCheck, dask_worker: Any = None) -> str:
    """What is wrong with the folders that a worker sees, or nothing."""
    try:
        check.check_folders(dask_worker.address)
    except HandSimError as error:
        return str(error)
    return ""


@contextmanager
def _token(folder: Path | None) -> Iterator[tuple[Path | None, str]]:
    """A file in a folder that workers must see, and its content; what a killed run leaves is a leftover."""
    if folder is None:
        yield None, ""
        return
    folder.mkdir(parents=True, exist_ok=True)
    content = secrets.token_hex(16)
    token = temporary_beside(folder.absolute() / f"cluster-{content[:8]}.txt")  # nobody asked for it before
    token.write_text(content, encoding="utf-8")
    try:
        yield token, content
    finally:
        token.unlink(missing_ok=True)


def _in_file(path: Path) -> str:
    """The address that a scheduler wrote to its file."""
    address = load_json(path).get("address")
    if not isinstance(address, str):
        raise HandSimError(f"{path}: no address, expected what `dask scheduler --scheduler-file` writes")
    return DaskCluster(address, None).address


def _share_out(distributed: Any, client: Any, task: _Task, todo: Sequence[int]) -> Iterator[int]:
    """Keep the scheduler supplied with jobs, and yield the numbers of those that are done."""
    waiting, name = iter(todo), f"shard-{secrets.token_hex(8)}"  # of this run alone

    def submit(count: int) -> list[Any]:
        numbers = list(islice(waiting, count))
        keys = [(name, number) for number in numbers]
        return client.map(task, numbers, key=keys, pure=False) if numbers else []

    finished = distributed.as_completed(submit(_IN_FLIGHT), loop=client.loop)
    for batch in finished.batches():
        numbers = [_number_of(distributed, future) for future in batch]
        finished.update(submit(len(numbers)))
        yield from numbers


def _number_of(distributed: Any, future: Any) -> int:
    """The number of a job that is done.

    Raises:
        Exception: What the job raised.
        HandSimError: It ended its workers, or the scheduler is gone.
    """
    number: int = future.key[1]
    if future.status == "finished":
        return number
    if future.status == "error":
        error = future.exception()
        if isinstance(error, distributed.KilledWorker):
            raise HandSimError(
                f"shard {number} was begun {error.allowed_failures + 1} times, and its worker died each time "
                f"(out of memory?){_AGAIN}"
            ) from error
        raise error
    raise HandSimError(f"the Dask scheduler is gone or gave up shard {number}{_AGAIN}")
