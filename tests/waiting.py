"""Waiting for what another thread or process does, however busy the machine is."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

LONG = 120.0
"""How long something may take on a busy machine before it counts as never [s]."""


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until something is so.

    Raises:
        AssertionError: It was not within two minutes.
    """
    end = time.monotonic() + LONG
    while not condition():
        if time.monotonic() > end:
            raise AssertionError("it never came")
        time.sleep(0.01)


def signal_once(condition: Callable[[], object], number: int = signal.SIGINT) -> threading.Thread:
    """Send this process a signal, Ctrl-C by default, once something is so and a command handles it."""
    before = signal.getsignal(number)

    def send() -> None:
        try:
            wait_for(lambda: condition() and signal.getsignal(number) is not before)
        finally:
            os.kill(os.getpid(), number)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    return thread
