"""Whether a worker of a cluster can do jobs as this machine does: its versions, its threads, its folders."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from handsim._extras import import_extra
from handsim.errors import HandSimError

DECIDING: Final = ("handsim", "numpy", "scipy", "mujoco", "numba", "opencv-python-headless")
"""Packages that the bytes of results depend on."""
_WITHOUT: Final = "none"


@dataclass(frozen=True, slots=True)
class WorkerCheck:
    """What must be as it is here."""

    versions: tuple[tuple[str, str], ...]
    """Packages and their versions."""
    place: Path
    """The folder that the command runs in: jobs have names of files that start there."""
    token: Path | None
    """A file beside the results that none but this run has, with a content; None if no folder is shared."""
    content: str

    def compare_versions(self, worker: str, found: Mapping[str, str]) -> None:
        """Compare a worker's versions with those here.

        Raises:
            HandSimError: One differs.
        """
        for name, ours in self.versions:
            if found[name] != ours:
                raise HandSimError(
                    f"the worker {worker} has {name} {found[name]}, this machine has {ours}; results depend "
                    "on it, so install the same version"
                )

    def check_folders(self, worker: str) -> None:
        """Check, on a worker, that it sees the folders of this run, if it must.

        Raises:
            HandSimError: It does not.
        """
        if self.token is None:
            return
        if not self.place.is_dir():
            raise HandSimError(
                f"the worker {worker} does not see {self.place}, where the command runs; run it in a folder "
                "that all workers share"
            )
        try:
            found = self.token.read_text(encoding="utf-8")
        except OSError:
            found = ""
        if found != self.content:
            raise HandSimError(
                f"the worker {worker} does not see the files in {self.token.parent}; write to a folder that "
                "all workers share, under the same path"
            )


def check_threads(worker: str, threads: int) -> None:
    """Refuse a worker with several threads: jobs take a process each.

    Raises:
        HandSimError: It has several.
    """
    if threads != 1:
        raise HandSimError(
            f"the worker {worker} has {threads} threads, expected 1; start workers with --nthreads 1, one "
            "for each core"
        )


def versions_here() -> dict[str, str]:
    """The versions in this process."""
    about = import_extra("distributed.versions", "a cluster", "cluster")
    return complete(about.get_package_info(DECIDING))


def complete(found: Mapping[str, str | None]) -> dict[str, str]:
    """The versions that decide, out of those that Dask found; a package that is not there has a word."""
    return {name: found.get(name) or _WITHOUT for name in DECIDING}


@functools.lru_cache(maxsize=8)
def check_this_worker(check: WorkerCheck) -> None:
    """Check, within a job, the worker that does it; once a run, for workers that came after its start.

    Raises:
        HandSimError: It cannot do the jobs of this run.
    """
    worker = import_extra("distributed", "a cluster", "cluster").get_worker()
    check.compare_versions(worker.address, versions_here())
    check_threads(worker.address, worker.state.nthreads)
    check.check_folders(worker.address)
