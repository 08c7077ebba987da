"""The workers of a Dask scheduler as an executor, which refuses those that are unlike this machine."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import platform
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from handsim._plugins import import_extra
from handsim.app.workers import check_workers, without_signals
from handsim.errors import ArgumentError, HandSimError
from handsim.files.json_files import load_json

LOCAL: Final = "local"
"""Stands for a scheduler and workers on this machine, which end with the command."""
_DECIDING: Final = ("handsim", "numpy", "scipy", "mujoco", "numba", "opencv-python-headless")
"""Packages that the bytes of results depend on."""
_PATIENCE: Final = 5.0  # [s] until a scheduler must have answered


@contextmanager
def chosen_workers(
    cluster: str | None, workers: int | None, tell: Callable[[str], None]
) -> Iterator[int | Executor]:
    """What the options --cluster and --workers stand for: a number of processes, or a cluster's executor.

    Args:
        cluster: `tcp://host:port` or `tls://host:port` of a Dask scheduler, its file (.json), or `local`;
            this machine when not given.
        workers: Processes of this machine, all cores when not given.
        tell: Takes a line for the user.
    """
    if cluster is None:
        yield check_workers(workers)
        return
    if workers is not None and cluster != LOCAL:
        raise ArgumentError(f"--workers counts processes of this machine, but {cluster} has its own workers")
    distributed = import_extra("distributed", f"the cluster {cluster}", "cluster")
    with _client(distributed, cluster, check_workers(workers)) as client:
        count = len(client.nthreads())
        there = f"{count} workers" if count else "no workers yet; waiting for the first"
        link = f"; dashboard of the cluster: {client.dashboard_link}" if client.dashboard_link else ""
        tell(f"{cluster}: {there}{link}")
        try:
            yield ClusterExecutor(client)
        except distributed.KilledWorker as error:
            raise HandSimError(
                f"a job was begun {error.allowed_failures + 1} times, and its worker died each time (out of "
                "memory?); run the same command again to go on"
            ) from error


@contextmanager
def _client(distributed: Any, address: str, workers: int) -> Iterator[Any]:
    """A connection to the scheduler, which is started for it where it is local."""
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
        _greet(distributed, address)
        client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        reason = str(error.__cause__ or error).rpartition("] ")[2] or f"none within {_PATIENCE:g} s"
        raise HandSimError(
            f"no Dask scheduler answers at {address}: {reason}; expected tcp://host:port, tls://host:port, a "
            f"scheduler's file (.json), or {LOCAL}"
        ) from error
    with client:
        yield client


def _greet(distributed: Any, address: str) -> None:
    """Connect to the scheduler and close the connection again.

    A `distributed.Client` that cannot connect stays half made: it tries for as long as it may, and when it is
    collected it waits ten seconds, or forever if that happens while another client is being made.
    """

    async def connect_and_close() -> None:
        async with asyncio.timeout(_PATIENCE):
            client = distributed.Client(address, timeout=_PATIENCE, asynchronous=True, set_as_default=False)
            try:
                await client
            finally:
                await client.close()

    host_and_port = distributed.comm.get_address_host_port(address)
    socket.create_connection(host_and_port, timeout=_PATIENCE).close()  # a refusal ends here
    try:
        asyncio.run(connect_and_close())
    except (OSError, RuntimeError, TypeError):
        raise
    except Exception:  # whatever Dask makes of the words
        raise ValueError("something else listens there") from None


class ClusterExecutor(Executor):
    """Dask's executor of a client, whose workers check themselves before they work.

    A worker that dies loses the job that it was doing, and another does that again. Workers that come later
    take part. Each must have the versions of this machine and one thread. Jobs are done in the folder that
    this process runs in, where a worker has it.

    Args:
        client: A `distributed.Client`.
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
    """A function as a worker calls it."""

    function: Callable[..., Any]
    versions: dict[str, str]
    """Of packages where it comes from."""
    place: Path
    """The folder there: jobs have names of files that start in it."""

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
    """Refuse a worker that other bytes may come from: jobs take a process each, of these versions."""
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
    """Versions in this process of the packages that decide."""
    about = import_extra("distributed.versions", "a cluster", "cluster")
    found = about.get_package_info(_DECIDING)
    return {name: found.get(name) or "none" for name in _DECIDING}
