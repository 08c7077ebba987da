"""Compiling of the kernels that a command needs, before it runs, with one process per core.

data/kernels.json lists the kernels of every command with the types of their arguments and the time to compile
them. Types are row numbers in a table, whose rows may refer to earlier ones. `python -m
benchmarks.kernel_list` writes the file. A kernel that is not listed is compiled at its first call.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import json
import time
import warnings
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import ExitStack
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from handsim.app.messages import show_state
from handsim.app.workers import LocalProcesses, usable_cores
from handsim.callbacks import before_compiling
from handsim.errors import HandSimError

if TYPE_CHECKING:
    from numba.core.registry import CPUDispatcher

KERNELS_FILE: Final = Path(__file__).parents[1] / "data" / "kernels.json"
_MIN_SECONDS: Final = 4.0  # least compile time for which processes are started [s]
_STATE_INTERVAL: Final = 2.0  # time between two lines of progress [s]
_MAX_PROCESSES: Final = 8  # More processes would wait for one another.
_KNOWN_FACTOR: Final = 3.0  # factor on the rank of a kernel whose package the process has compiled before


class ListedKernel(NamedTuple):
    """A kernel on the list."""

    name: str
    """Where the kernel is, as module:name."""
    types: list[int]
    """Types of the kernel's arguments, as rows of the table of types."""
    seconds: float
    """Processor time to compile the kernel [s]."""
    commands: str
    """Commands that need the kernel, with spaces between them."""

    @property
    def package(self) -> str:
        """The package of the kernel's module."""
        return self.name.rpartition(".")[0]


def compile_kernels(command: str | None = None) -> tuple[int, int]:
    """Compile the kernels of a command, by default those of all, that the cache lacks.

    Returns:
        How many were compiled, and how many are missing still, which are compiled when they are called.
    """
    listed = {row: one for row, one in enumerate(read_list()) if command in (None, *one.commands.split())}
    missing = missing_kernels(listed)
    if command is not None:  # kernels that are missing afterwards are compiled when they are called
        before_compiling.append(functools.partial(show_state, "compiling what is new, once on this machine"))
    if sum(one.seconds for one in missing.values()) <= (0.0 if command is None else _MIN_SECONDS):
        return 0, len(missing)
    _compile_all(missing)
    rest = len(missing_kernels(missing))
    return len(missing) - rest, rest


def read_list() -> list[ListedKernel]:
    """All kernels on the list."""
    return [ListedKernel(*row) for row in json.loads(KERNELS_FILE.read_text(encoding="utf-8"))["kernels"]]


@functools.cache
def known_types() -> list[Any]:
    """The types of the list's table, as numba has them; None where a type is gone."""
    known: list[Any] = []
    for row in json.loads(KERNELS_FILE.read_text(encoding="utf-8"))["types"]:
        try:
            known.append(_type_of(row, known))
        except (AttributeError, ImportError, ValueError):
            known.append(None)
    return known


def _type_of(row: str | list[Any], known: list[Any]) -> Any:
    """The numba type that a row of the table describes; tuples are made of the types of earlier rows."""
    from numba import types

    if isinstance(row, list):
        kind = resolve_name(row[0]) if row[0] else None
        return types.BaseTuple.from_types([known[part] for part in row[1:]], kind)
    name, *array = row.split()
    if name.startswith("="):
        return types.literal(json.loads(name[1:]))
    if ":" in name:
        return types.Dispatcher(resolve_name(name))
    scalar = getattr(types, name)
    return types.Array(scalar, int(array[0]), array[1], readonly="const" in array) if array else scalar


def missing_kernels(listed: Mapping[int, ListedKernel]) -> dict[int, ListedKernel]:
    """The kernels that the cache lacks, by their rows in the list."""
    from numba.core.registry import cpu_target

    codegen, known = cpu_target.target_context.codegen(), known_types()
    missing = {}
    for row, one in listed.items():
        arguments = tuple(known[number] for number in one.types)
        try:
            cache = resolve_name(one.name)._cache
            there = cache._index_key(arguments, codegen) in cache._cache_file._load_index()
        except (AttributeError, ImportError, OSError):  # the kernel is gone, or needs what is not installed
            continue
        if not there and None not in arguments:
            missing[row] = one
    return missing


def needed_kernels(kernel: CPUDispatcher) -> set[str]:
    """All kernels that a kernel calls, directly or through others, as module:name."""
    from numba.core.registry import CPUDispatcher

    names, unread, seen = set(), [kernel], {kernel}
    while unread:
        function = unread.pop().py_func
        for name in function.__code__.co_names:
            one = function.__globals__.get(name)
            if isinstance(one, CPUDispatcher) and one not in seen:
                seen.add(one)
                unread.append(one)
                names.add(f"{one.py_func.__module__}:{one.py_func.__qualname__}")
    return names


class _Queue:
    """Kernels to compile, each after those that it calls."""

    def __init__(self, listed: Mapping[int, ListedKernel]) -> None:
        self.waiting, self.running = dict(listed), dict[int, ListedKernel]()
        self._needs = {one.name: needed_kernels(resolve_name(one.name)) for one in listed.values()}
        # Kernels that others wait for come first: those with the most to compile along one line of calls.
        self._rank: dict[str, float] = {}
        for one in sorted(listed.values(), key=lambda one: -len(self._needs[one.name])):
            after = (self._rank[name] for name in self._rank if one.name in self._needs[name])
            self._rank[one.name] = max(self._rank.get(one.name, 0.0), one.seconds + max(after, default=0.0))

    def take(self, known: set[str]) -> int | None:
        """The row of the next kernel for a process, None if all wait for others.

        A process also compiles the parts of numba that its kernels use, so it keeps to few packages:
        those that are `known` to it, where that of its new kernel is added.
        """
        busy = {one.name for one in self.running.values()}
        waited_for = busy | {one.name for one in self.waiting.values()}
        ranks = {
            row: self._rank[one.name] * (_KNOWN_FACTOR if one.package in known else 1.0)
            for row, one in self.waiting.items()
            if one.name not in busy and not self._needs[one.name] & waited_for - {one.name}
        }
        if not ranks:
            return None
        row = max(ranks, key=lambda row: ranks[row])
        self.running[row] = self.waiting.pop(row)
        known.add(self.running[row].package)
        return row


def _compile_all(listed: Mapping[int, ListedKernel]) -> None:
    """Compile kernels in processes that end afterwards, and show the progress."""
    what = f"compiling {len(listed)} kernels, once on this machine"
    queue, total, done = _Queue(listed), sum(one.seconds for one in listed.values()), 0.0
    last, first = time.monotonic(), (0.0, 0.0)  # speed counts from the first kernel, when processes run
    show_state(what)
    with ExitStack() as stack:
        try:
            processes = [LocalProcesses(1) for _ in range(min(usable_cores(), len(listed), _MAX_PROCESSES))]
        except HandSimError:  # each kernel is then compiled where it is called
            return
        for one in processes:
            stack.callback(one.end)
        known = {one: set[str]() for one in processes}
        jobs: dict[Future[None], tuple[LocalProcesses, int]] = {}
        while True:
            for process in processes[:]:
                if (row := queue.take(known[process])) is not None:
                    processes.remove(process)
                    try:
                        jobs[process.submit(_compile_row, row)] = process, row
                    except (OSError, BrokenExecutor):  # no memory for another process, or it died
                        queue.waiting[row] = queue.running.pop(row)
            if not jobs:  # the remaining kernels call one another, or all processes died
                break
            for job in wait(jobs, _STATE_INTERVAL, FIRST_COMPLETED).done:
                process, row = jobs.pop(job)
                done += queue.running.pop(row).seconds
                if job.exception() is None:  # else the process died
                    processes.append(process)
            now = time.monotonic()
            if done and not first[0]:
                first = now, done
            if now >= last + _STATE_INTERVAL:
                last = now
                speed = (done - first[1]) / (now - first[0]) if now > first[0] else 0.0
                rest = f", about {(total - done) / speed:.0f} s left" if speed else ""
                count = len(listed) - len(queue.waiting) - len(queue.running)
                show_state(f"{what}: {count} done{rest}")
    show_state("")


def plain_shape_errors() -> None:
    """Make numba compile a shorter error for assignments to a slice of another shape.

    Our kernels never make such an assignment. numba's own error, which states both shapes, takes up to half
    of the machine code of each kernel with a slice.
    """
    from numba.core.extending import overload
    from numba.np import arrayobj

    def complain(source: Any, target: Any) -> None:
        raise NotImplementedError

    @overload(complain)
    def compiled(source: Any, target: Any) -> Any:
        def raise_plainly(source: Any, target: Any) -> None:
            raise ValueError("cannot assign slice from input of different size")

        return raise_plainly

    arrayobj.raise_with_shape_context = complain


@functools.cache
def _prepared() -> tuple[list[ListedKernel], list[Any]]:
    """Prepare a process that only compiles kernels; return the list of kernels, and the types it names."""
    # Python would spend 5 % of the time on garbage.
    gc.set_threshold(100_000)
    warnings.simplefilter("ignore")
    plain_shape_errors()
    return read_list(), known_types()


def _compile_row(row: int) -> None:
    """Compile the kernel of a row in the list, if that can be done."""
    listed, known = _prepared()
    one = listed[row]
    with contextlib.suppress(Exception):  # a kernel that cannot be compiled raises where it is called
        resolve_name(one.name).compile(tuple(known[number] for number in one.types))
