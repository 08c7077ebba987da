"""State that a process inherits: variables, control groups, rank, and global settings of numpy and torch.

handsim computes with its own settings, and restores those of the caller.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast

_P = ParamSpec("_P")
_R = TypeVar("_R")
_CGROUP_ROOT: Final = Path("/sys/fs/cgroup")
_CGROUP_MOUNTS: Final = ("", "unified", "cpu", "cpu,cpuacct", "memory")  # of version 2, and of version 1
_OWN_CGROUPS: Final = Path("/proc/self/cgroup")
_EXHAUSTED: Final = object()
_RANK_VARIABLES: Final = (
    ("RANK", "WORLD_SIZE"),
    ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("PMI_RANK", "PMI_SIZE"),
)
"""Variables for rank and size that torchrun, srun and mpirun set in the processes that they start."""


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Set variables of the environment within the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def rank_and_size() -> tuple[int, int]:
    """Rank of this process in a distributed program, and the number of processes.

    They come from torch.distributed if it is initialized, else from the variables of the launcher. A plain
    `python` in a job of Slurm is one process, however many tasks the job may start.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    for names in _RANK_VARIABLES:
        stated = [os.environ.get(name, "") for name in names]
        if all(map(is_number, stated)) and int(stated[0]) < int(stated[1]):
            return int(stated[0]), int(stated[1])
    return 0, 1


class SharedStream:
    """A base of endless streams for torch's `DataLoader`, whose processes each get a copy."""

    _rank_and_size: tuple[int, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The state that a worker gets, with the rank of its parent process."""
        return {**self.__dict__, "_rank_and_size": rank_and_size()}

    def share(self) -> tuple[int, int]:
        """Number of the first batch of this rank and worker, and the step to its next batch."""
        worker = sys.modules["torch"].utils.data.get_worker_info()
        if worker is None:
            return rank_and_size()
        rank, size = self._rank_and_size or rank_and_size()
        return worker.id * size + rank, worker.num_workers * size


def core_quota() -> float:
    """Cores that the quotas of this process's control groups allow; infinite without a quota."""
    found = [*_cgroup_numbers(2, "cpu.max"), *_cgroup_numbers(2, "cpu.cfs_quota_us", "cpu.cfs_period_us")]
    return min((quota / period for quota, period in found if period), default=math.inf)


def memory_limit() -> float:
    """Memory that this process's control groups allow [bytes]; infinite without a limit."""
    found = [*_cgroup_numbers(1, "memory.max"), *_cgroup_numbers(1, "memory.limit_in_bytes")]
    return min((limit for (limit,) in found), default=math.inf)


def _cgroup_numbers(count: int, *names: str) -> Iterator[list[int]]:
    """The `count` numbers in these files of each control group of this process and of its parent groups.

    A container may state the paths of its host; then the groups that are visible in the container count.
    """
    own = {"", *(line.split(":", 2)[-1].strip("/") for line in text_of_system(_OWN_CGROUPS).splitlines())}
    for root in (_CGROUP_ROOT / mount for mount in _CGROUP_MOUNTS):
        folders = {parent for path in own for parent in (root / path, *(root / path).parents)}
        for folder in [one for one in folders if one.is_relative_to(root)]:
            words = " ".join(text_of_system(folder / name) for name in names).split()
            if len(words) == count and all(map(is_number, words)):
                yield [int(word) for word in words]


def text_of_system(path: Path) -> str:
    """The text of a file of the system; empty if it cannot be read."""
    try:
        return path.read_text("ascii", errors="replace")
    except (OSError, ValueError):
        return ""


def is_number(word: str) -> bool:
    """Whether a word is a whole number that 64 bits hold."""
    return word.isascii() and word.isdecimal() and len(word) < 20


@contextmanager
def own_numerics() -> Iterator[None]:
    """Use the default settings of numpy and torch within the block, whatever the caller's are."""
    import numpy as np

    with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"), ExitStack() as stack:
        torch = sys.modules.get("torch")
        if torch is not None:
            _use_own_torch(torch, stack)
        yield


def _use_own_torch(torch: Any, stack: ExitStack) -> None:
    """Give torch its usual settings until the stack is closed."""
    stack.enter_context(torch.inference_mode(False))
    stack.enter_context(torch.enable_grad())
    if torch.get_default_dtype() != torch.float32:
        stack.callback(torch.set_default_dtype, torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
    if torch.get_default_device().type != "cpu":
        stack.enter_context(torch.device("cpu"))
    if torch.are_deterministic_algorithms_enabled():
        warns = torch.is_deterministic_algorithms_warn_only_enabled()
        stack.callback(torch.use_deterministic_algorithms, True, warn_only=warns)
        torch.use_deterministic_algorithms(False)
    for kind in ("cpu", "cuda"):
        if torch.is_autocast_enabled(kind):
            stack.enter_context(torch.autocast(kind, enabled=False))


@contextmanager
def torch_kept() -> Iterator[None]:
    """Restore torch's random state and its handling of denormal numbers after the block."""
    torch, flushes = sys.modules["torch"], sys.float_info.min * 0.5 == 0.0
    try:
        with torch.random.fork_rng(range(torch.cuda.device_count())):
            yield
    finally:
        torch.set_flush_denormal(flushes)


def with_own_numerics(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Wrap a function to compute in `own_numerics`; so does each step of a generator that it returns."""

    @functools.wraps(function)
    def call(*args: _P.args, **options: _P.kwargs) -> _R:
        with own_numerics():
            result = function(*args, **options)
        return cast("_R", _with_own_steps(result)) if inspect.isgenerator(result) else result

    return call


def _with_own_steps(items: Iterator[Any]) -> Iterator[Any]:
    """Yield the items of an iterator, each of which is computed in `own_numerics`."""
    take_next = own_numerics()(next)
    while (item := take_next(items, _EXHAUSTED)) is not _EXHAUSTED:
        yield item
