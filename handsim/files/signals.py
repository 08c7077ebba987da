"""Signals that ask a command to end: delayed, as a flag for a loop, or as an exception."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Final

from handsim.callbacks import Closing
from handsim.errors import HandSimError

ENDING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Ctrl-C, the end of a batch job, and a terminal that closes."""


class Stopped(KeyboardInterrupt):
    """A command was asked to end.

    Args:
        kept: A sentence without a capital and a period: what was saved, and how to continue.
    """

    def __init__(self, number: int = signal.SIGINT, kept: str = "") -> None:
        super().__init__(kept)
        self.number, self.kept = number, kept

    @classmethod
    def again(cls, stop: KeyboardInterrupt, kept: str) -> Stopped:
        """A `Stopped` by the signal of another one, with this `kept`."""
        return cls(stop.number if isinstance(stop, Stopped) else signal.SIGINT, kept)


class InterruptFlag:
    """A flag that a signal to end sets; a call returns whether it is set."""

    def __init__(self) -> None:
        self.number = 0
        """The first signal that came, 0 if none did."""

    def __call__(self) -> bool:
        """Whether a signal to end came."""
        return self.number != 0


@contextmanager
def signals_wait() -> Iterator[None]:
    """Delay signals to end that come within the block until after it."""
    came: list[int] = []
    try:
        with _signal_handler(lambda number, _frame: came.append(number)):
            yield
    finally:
        for number in dict.fromkeys(came):
            signal.raise_signal(number)


@contextmanager
def interrupt_flag(flag: InterruptFlag | None = None, *, again: bool = True) -> Iterator[InterruptFlag]:
    """Within the block the first signal to end sets a flag; a second one raises if `again`."""
    flag, block = flag or InterruptFlag(), _Block()

    def note(number: int, _frame: FrameType | None) -> None:
        if flag() and again:
            raise _PersistentStop(number, block)
        flag.number = flag.number or number

    with _signal_handler(note), block:
        yield flag


class _Block(Closing):
    """Whether a block of code was left, and the last signal that came in it (0 if none did)."""

    left = False
    number = 0

    def close(self) -> None:
        self.left = True

    def send(self, number: int) -> None:
        """Send a signal to this process unless the block was left."""
        if not self.left:
            os.kill(os.getpid(), number)


class _PersistentStop(Stopped):
    """A `Stopped` whose signal is sent again if the exception is lost, until a block is left."""

    def __init__(self, number: int, block: _Block) -> None:
        super().__init__(number)
        self._block = block

    def __del__(self) -> None:
        if not self._block.left:  # A thread sends the signal, because an exception in __del__ would be lost.
            threading.Timer(0.05, self._block.send, (self.number,)).start()


@contextmanager
def signals_raise() -> Iterator[None]:
    """Raise `Stopped` for a signal to end within the block, so that a batch job cleans up as after Ctrl-C.

    Compiled code that calls back into Python may swallow the exception; then the signal is sent again. An
    import may catch it and fail with another error, which counts as the interrupt.
    """
    block = _Block()

    def stop(number: int, _frame: FrameType | None) -> None:
        block.number = number
        raise _PersistentStop(number, block)

    with _signal_handler(stop), _lost_stops_hidden(), block:
        try:
            with interrupts_bare():
                yield
        except Exception as error:
            if block.number and not isinstance(error, HandSimError | OSError):
                raise Stopped(block.number) from error
            raise


@contextmanager
def interrupts_bare() -> Iterator[None]:
    """Raise an interrupt that was wrapped in other errors as itself, so that `except` finds it."""
    try:
        yield
    except Exception as error:
        stop = interrupt_behind(error)
        if stop is None:
            raise
        raise stop from error


def interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interrupt that caused an error, None if there was none.

    Interrupted compiled code raises a `SystemError`, and an interrupted import an `ImportError`. An error
    that occurs while an interrupt is handled, such as a full disk, is not caused by it.
    """
    below: BaseException | None = error
    while below is not None and not isinstance(below, KeyboardInterrupt):
        below = below.__cause__ or (None if isinstance(below, HandSimError | OSError) else below.__context__)
    return below


@contextmanager
def _lost_stops_hidden() -> Iterator[None]:
    """Suppress the traceback of a lost `Stopped`, because its signal is sent again."""
    others = sys.unraisablehook

    def hook(lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Stopped):
            others(lost)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = others


@contextmanager
def _signal_handler(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle signals to end within the block; only the main thread gets signals, and ignored ones stay so."""
    with ExitStack() as stack:  # it restores every handler, even where one that is restored raises at once
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):
                    stack.callback(signal.signal, number, before)
                    signal.signal(number, handler)
        yield
