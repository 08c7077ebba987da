"""Ctrl-C as a word to be read when it suits, for loops that have something to finish."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupt_told() -> Iterator[Callable[[], bool]]:
    """Within the block, the first interrupt raises nothing; the function that is given says whether it came.

    An exception from a signal can be lost: compiled code that calls back into Python swallows it. A second
    interrupt raises as ever. Signals are the main thread's; in others the answer is always no.
    """
    told = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield told.is_set
        return

    def tell(_number: int, _frame: FrameType | None) -> None:
        if told.is_set():
            raise KeyboardInterrupt
        told.set()

    before = signal.signal(signal.SIGINT, tell)
    try:
        yield told.is_set
    finally:
        signal.signal(signal.SIGINT, before)
