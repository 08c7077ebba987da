"""Signals that ask a process to end, and blocks that they wait for."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

ENDING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Ctrl-C, the end of a batch job, and a terminal that closes."""


@contextmanager
def signals_wait() -> Iterator[None]:
    """Signals to end that come within the block are delivered after it.

    Only the main thread is interrupted by signals; in other threads nothing changes.
    """
    came: list[int] = []
    with ExitStack() as stack:  # it restores every handler, even where one raises already
        stack.callback(_send, came)
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):
                    stack.callback(signal.signal, number, before)
                    signal.signal(number, lambda number, _frame: came.append(number))
        yield


def _send(came: list[int]) -> None:
    for number in dict.fromkeys(came):
        signal.raise_signal(number)
