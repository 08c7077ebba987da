"""What tests of commands and their processes share."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from handsim.app.interrupts import ENDING


@pytest.fixture(autouse=True)
def heeded_signals() -> Iterator[None]:
    """Signals to end do what they usually do; a shell or nohup may have told them to be ignored."""
    before = {number: signal.getsignal(number) for number in ENDING}
    for number in ENDING:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
