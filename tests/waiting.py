"""Waiting for what another thread or process does, however busy the machine is."""

from __future__ import annotations

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
