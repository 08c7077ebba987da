"""Ctrl-C as a flag that a loop reads when it has finished a step."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """Within the block the first interrupt raises nothing; the yielded function returns whether it came.

    An exception from a signal can be lost: compiled code that calls back into Python swallows it. A second
    interrupt raises as usual. Only the main thread gets signals; in other threads the function returns False.
    """
    received = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield received.is_set
        return

    def note(_number: int, _frame: FrameType | None) -> None:
        if received.is_set():
            raise KeyboardInterrupt
        received.set()

    before = signal.signal(signal.SIGINT, note)
    try:
        yield received.is_set
    finally:
        signal.signal(signal.SIGINT, before)
