"""Processes on this machine, one a device, that end with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Final, Protocol, cast

from handsim.app.interrupts import InterruptFlag, Stopped, interrupt_flag, signals_raise
from handsim.app.workers import portable, without_signals
from handsim.errors import HandSimError
from train.devices.agreement import PeerError
from train.devices.world import RENDEZVOUS, World

Progress = Callable[[int, int, float], None]
"""Called with samples done, samples expected, and the loss."""
_LOOK: Final = 0.2  # [s] between two looks for a signal
_PATIENCE: Final = 5.0  # [s] that the other processes have when one has failed


def spawn(live: Callable[..., None], *args: object) -> tuple[Connection, SpawnProcess]:
    """A process that calls `live(*args, channel)`, and this end of its pipe."""
    context = multiprocessing.get_context("spawn")
    channel, theirs = context.Pipe()
    process = context.Process(target=_bound, args=(live, *args, theirs), daemon=True)
    with without_signals():
        process.start()
    theirs.close()
    return channel, process


def _bound(live: Callable[..., None], *args: object) -> None:
    def watch() -> None:
        process = multiprocessing.parent_process()
        if process is not None:
            process.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    live(*args)


def end_processes(pool: dict[Connection, SpawnProcess]) -> None:
    """End processes, whatever they do, and wait until they are gone."""
    for channel, process in pool.items():
        channel.close()
        process.terminate()
    for process in pool.values():
        process.join(1.0)
        process.kill()
        process.join()


class Job(Protocol):
    """What every process does; the first one's result counts."""

    def __call__(self, *, progress: Progress) -> Any:
        """Do it, and report the progress; the result must survive a pipe."""


class _Death(HandSimError):
    """A process that ended without a word."""


def in_local_processes(job: Job, count: int, *, progress: Progress | None) -> Any:
    """Have each of some processes do a job together and return the result of the first.

    The environment tells each of them its number as torchrun does. A signal to end goes on to all of them.

    Args:
        job: What to do; the processes are spawned and unpickle it.
        count: Number of processes.
        progress: Called in this process.

    Raises:
        Exception: What ended the first process that failed on its own.
        Stopped: A signal came.
    """
    ranks: dict[Connection, tuple[int, SpawnProcess]] = {}
    with tempfile.TemporaryDirectory(prefix="handsim-") as folder, interrupt_flag() as interrupted:
        try:
            for rank in range(count):
                world = World(rank, rank, count, count)
                variables = {**world.variables(), RENDEZVOUS: str(Path(folder) / "rendezvous")}
                channel, process = spawn(_live, job, variables)
                ranks[channel] = rank, process
            outcomes = _listen(ranks, progress, interrupted)
        finally:
            end_processes({channel: process for channel, (_, process) in ranks.items()})
    return _result(outcomes, interrupted.number)


def _listen(
    ranks: dict[Connection, tuple[int, SpawnProcess]], progress: Progress | None, interrupted: InterruptFlag
) -> dict[int, Any]:
    """The last word of each process: its result, or what ended it."""
    outcomes: dict[int, Any] = {}
    waiting, passed_on, deadline = set(ranks), False, float("inf")
    while waiting and time.monotonic() < deadline:
        if interrupted() and not passed_on:
            passed_on = True
            for _, process in ranks.values():
                process.terminate()
        for channel in cast("list[Connection]", wait(list(waiting), timeout=_LOOK)):
            rank, process = ranks[channel]
            try:
                is_last, word = channel.recv()
            except (EOFError, OSError):
                waiting.discard(channel)
                is_last, word = True, outcomes[rank] if rank in outcomes else _death(rank, process)
            if is_last:
                outcomes[rank] = word
                if isinstance(word, BaseException):
                    deadline = min(deadline, time.monotonic() + _PATIENCE)
            elif progress is not None:
                progress(*word)
    return outcomes


def _death(rank: int, process: SpawnProcess) -> _Death:
    process.join(1.0)
    code = process.exitcode or 0
    how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return _Death(
        f"process {rank} of the training {how} (out of memory?); run the same command again to go on from "
        "the last checkpoint"
    )


def _result(outcomes: dict[int, Any], number: int) -> Any:
    """The result of the first process, or what ended the run: an error comes before a signal."""
    ended = [word for _, word in sorted(outcomes.items()) if isinstance(word, BaseException)]
    for error in ended:
        if not isinstance(error, (PeerError, _Death, Stopped)):
            raise error
    dead = [error for error in ended if isinstance(error, _Death)]
    stopped = [stop for stop in ended if isinstance(stop, Stopped)]
    if number or (stopped and not dead):  # a process dies of a signal before it has a handler
        raise Stopped(number or stopped[0].number, next((stop.kept for stop in stopped if stop.kept), ""))
    for error in (*dead, *ended):
        raise error
    return outcomes[0]


def _live(job: Job, variables: dict[str, str], channel: Connection) -> None:
    """The life of a process: do the job and say how it ended."""
    os.environ.update(variables)
    if variables["RANK"] != "0":
        warnings.simplefilter("ignore")  # the first one tells

    def report(done: int, expected: int, loss: float) -> None:
        channel.send((False, (done, expected, loss)))

    try:
        with signals_raise():
            word = job(progress=report)
    except KeyboardInterrupt as stop:
        word = stop if isinstance(stop, Stopped) else Stopped()
    except Exception as error:
        error.add_note(traceback.format_exc())
        word = portable(error)
    channel.send((True, word))
