"""Ctrl-C, and other signals that end a process, as a flag that a loop reads when it has finished a step."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Final

ENDING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a process: Ctrl-C, of a batch system, of a terminal that was closed."""


@contextmanager
def interrupt_flag(signals: Sequence[int] = (signal.SIGINT,)) -> Iterator[Callable[[], bool]]:
    """Within the block the first interrupt raises nothing; the yielded function returns whether it came.

    An exception from a signal can be lost: compiled code that calls back into Python swallows it. A second
    Ctrl-C raises as usual. Only the main thread gets signals; in other threads the function returns False.

    Args:
        signals: Those that count, such as `ENDING`. A hangup that is ignored, as under nohup, stays so.
    """
    received = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield received.is_set
        return

    def note(number: int, _frame: FrameType | None) -> None:
        if received.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        received.set()

    noted = [
        number
        for number in signals
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN
    ]
    before = {number: signal.signal(number, note) for number in noted}
    try:
        yield received.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
