"""Interrupts that wait."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from handsim.app.interrupts import interrupt_flag


def test_the_first_interrupt_is_told_and_the_second_raises():
    before = signal.getsignal(signal.SIGINT)
    with interrupt_flag() as interrupted:
        assert not interrupted()
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            signal.sigtimedwait([], 1.0)
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_are_never_told():
    answers: list[bool] = []

    def ask() -> None:
        with interrupt_flag() as interrupted:
            answers.append(interrupted())

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert answers == [False]
