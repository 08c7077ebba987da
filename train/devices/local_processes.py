"""Processes on this machine, one a device, started by torch, that end with the one that asks for them."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final, Protocol

from torch import multiprocessing
from torch.multiprocessing.spawn import ProcessContext, ProcessExitedException, start_processes

from handsim.app.workers import portable, without_signals
from handsim.errors import HandSimError
from handsim.files.signals import Stopped, interrupt_flag, signals_raise
from train.devices.agreement import PeerError
from train.devices.world import RENDEZVOUS, World

_LOOK: Final = 0.2  # [s] between two looks for a signal
_PATIENCE: Final = 5.0  # [s] that the other processes have when one has failed


LossProgress = Callable[[int, int, float], None]
"""Called with samples done, samples expected, and the loss."""
Tell = Callable[[str], None]
"""Called with what is done beside the steps, when it begins."""


class Job(Protocol):
    """What every process does; the first one's result counts."""

    def __call__(self, *, progress: LossProgress, told: Tell) -> Any:
        """Do it, and report the progress; the result must survive a pipe."""


def in_local_processes(
    job: Job, count: int, *, progress: LossProgress | None, told: Tell | None = None
) -> Any:
    """Have each of some processes do a job together and return the result of the first.

    The environment tells each of them its number as torchrun does. A signal to end goes on to all of them.

    Args:
        job: What to do; the processes are spawned and unpickle it.

    Raises:
        Exception: What ended the first process that failed on its own.
        Stopped: A signal came.
    """
    pipes = [multiprocessing.get_context("spawn").Pipe(duplex=False) for _ in range(count)]
    words: dict[int, Any] = {}
    ended, passed_on, death = False, False, None
    with tempfile.TemporaryDirectory(prefix="handsim-") as folder, interrupt_flag() as interrupted:
        arguments = (job, Path(folder) / "rendezvous", [theirs for _, theirs in pipes])
        with without_signals():
            started: ProcessContext = start_processes(  # type: ignore[no-untyped-call]
                _live, arguments, count, join=False, daemon=True
            )
        try:
            while not ended:
                wait([*(ours for ours, _ in pipes), *started.sentinels], timeout=_LOOK)
                _listen(pipes, words, progress, told)
                if interrupted() and not passed_on:
                    passed_on = True
                    _terminate(started)
                ended = started.join(timeout=0.0, grace_period=_PATIENCE)
        except ProcessExitedException as error:
            death = error
        finally:
            _terminate(started)
            for process in started.processes:
                process.join()
        _listen(pipes, words, progress, told)
    return _result(words, interrupted.number, death)


def _terminate(started: ProcessContext) -> None:
    for process in started.processes:
        process.terminate()


def _listen(
    pipes: list[tuple[Connection, Connection]],
    words: dict[int, Any],
    progress: LossProgress | None,
    told: Tell | None,
) -> None:
    """Hand on the progress that there is, and keep the last word of each process."""
    for rank, (ours, _) in enumerate(pipes):
        while ours.poll():
            is_last, word = ours.recv()
            if is_last:
                words[rank] = word
            elif isinstance(word, str):
                if told is not None:
                    told(word)
            elif progress is not None:
                progress(*word)


def _result(words: dict[int, Any], number: int, death: ProcessExitedException | None) -> Any:
    """The result of the first process, or what ended the run: an error comes before a signal."""
    ended = [word for _, word in sorted(words.items()) if isinstance(word, BaseException)]
    stopped = [stop for stop in ended if isinstance(stop, Stopped)]
    dead = death is not None and death.error_index not in words
    for error in ended:
        if not isinstance(error, PeerError | Stopped):
            raise error
    if number or (stopped and not dead):  # a process dies of a signal before it has a handler
        raise Stopped(number or stopped[0].number, next((stop.kept for stop in stopped if stop.kept), ""))
    if death is not None and dead:
        how = death.signal_name or f"exit code {death.exit_code}"
        raise HandSimError(
            f"process {death.error_index} of the training was ended by {how} (out of memory?); run the same "
            "command again to go on from the last checkpoint"
        ) from death
    for error in ended:
        raise error
    return words[0]


def _live(rank: int, job: Job, rendezvous: Path, channels: list[Connection]) -> None:
    """The life of a process: do the job and say how it ended."""
    os.environ.update(World(rank, rank, len(channels), len(channels)).variables())
    os.environ[RENDEZVOUS] = str(rendezvous)
    if rank:
        warnings.simplefilter("ignore")  # the first one tells

    def tell(is_last: bool, word: Any) -> None:
        with contextlib.suppress(OSError):  # nobody is there to hear it
            channels[rank].send((is_last, word))

    def report(done: int, expected: int, loss: float) -> None:
        tell(False, (done, expected, loss))

    try:
        with signals_raise():
            if hasattr(signal, "pthread_sigmask"):  # the parent's death sends one, too
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGHUP})
            tell(True, job(progress=report, told=lambda step: tell(False, step)))
            return
    except KeyboardInterrupt as stop:
        word: Exception | Stopped = stop if isinstance(stop, Stopped) else Stopped()
    except Exception as error:
        error.add_note(traceback.format_exc())
        word = portable(error)
    tell(True, word)
    sys.exit(1)
