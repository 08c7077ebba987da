"""What the processes of a run agree about: an error or a signal that one of them meets ends all of them.

A process that left alone would have the others wait for it. So they compare notes before they do what none
can do alone. Of an error that several meet, the first of them tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

import torch
from lightning_fabric import Fabric

from handsim.errors import HandSimError
from handsim.files.signals import InterruptFlag, Stopped, interrupt_flag

T = TypeVar("T")


class PeerError(HandSimError):
    """What ended another process of the same run; that one tells it."""


class Agreement:
    """The agreement of this process with the others; with none but itself it does nothing."""

    def __init__(self, fabric: Fabric) -> None:
        self._fabric = fabric
        self._signal = InterruptFlag()
        self.alone = fabric.world_size == 1

    @contextmanager
    def signals_noted(self) -> Iterator[None]:
        """Within the block a signal to end raises nothing before the next `agree`, where it ends all.

        A second one does not either: the terminal and what started the processes may send one each.
        """
        with nullcontext() if self.alone else interrupt_flag(again=False) as flag:
            self._signal = flag or InterruptFlag()
            try:
                yield
            finally:
                self._signal = InterruptFlag()

    def agree(self, attempt: Callable[[], T]) -> T:
        """Do something that may fail, and go on if it did not fail anywhere and no signal came.

        Args:
            attempt: What to do; it must not wait for other processes.

        Raises:
            Exception: What `attempt` raised here, if it failed here first.
            PeerError: It failed in another process.
            Stopped: A signal to end came to one of the processes.
        """
        if self.alone:
            return attempt()
        error: Exception | None = None
        try:
            result = attempt()
        except Exception as caught:
            error = caught
        notes = [float(error is not None), float(self._signal())]
        mine = torch.tensor(notes, device=self._fabric.device)
        failed, stopped = self._fabric.all_reduce(mine, reduce_op="sum").tolist()  # type: ignore[union-attr]
        if failed or stopped:
            self._end(error)
        return result

    def _end(self, error: Exception | None) -> None:
        """Raise what ends all processes: the error of the first that has one, or the signal."""
        notes: list[Any] = [None] * self._fabric.world_size
        words = None if error is None else f"{type(error).__name__}: {error}"
        torch.distributed.all_gather_object(notes, (words, self._signal.number))
        for rank, (told, _) in enumerate(notes):
            if told is not None:
                if error is not None and rank == self._fabric.global_rank:
                    raise error
                raise PeerError(f"process {rank} of {self._fabric.world_size} ended with {told}") from error
        raise Stopped(next(number for _, number in notes if number))

    @contextmanager
    def told_once(self) -> Iterator[None]:
        """Within the block all raise the same errors; those of all but the first become `PeerError`.

        So the first alone tells them.
        """
        try:
            yield
        except HandSimError as error:
            if self._fabric.global_rank == 0 or isinstance(error, PeerError):
                raise
            raise PeerError(str(error)) from error

    @contextmanager
    def losses_told(self) -> Iterator[None]:
        """Within the block a connection that breaks, because another process ended, is a `PeerError`."""
        try:
            yield
        except RuntimeError as error:
            # gloo has no class of errors for a process that is lost.
            if self.alone or not (isinstance(error, torch.distributed.DistError) or "gloo" in str(error)):
                raise
            raise PeerError("another process of this run ended") from error
