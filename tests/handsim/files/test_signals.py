"""Interrupts that wait."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time

import pytest

import handsim.cli.main as command
from handsim.files.signals import Stopped, interrupt_flag, interrupts_bare, signals_raise
from tests.waiting import LONG


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


def test_the_flag_names_the_signal_and_covers_the_end_of_a_batch_job():
    for number in (signal.SIGTERM, signal.SIGHUP):
        with interrupt_flag() as interrupted:
            os.kill(os.getpid(), number)
            assert interrupted() and interrupted.number == number
            with pytest.raises(Stopped):
                os.kill(os.getpid(), number)
                signal.sigtimedwait([], 1.0)


def test_the_end_of_a_batch_job_raises_like_ctrl_c():
    before = signal.getsignal(signal.SIGTERM)
    with signals_raise(), pytest.raises(KeyboardInterrupt) as caught:
        os.kill(os.getpid(), signal.SIGTERM)
        signal.sigtimedwait([], 1.0)
    assert isinstance(caught.value, Stopped) and caught.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with signals_raise(), interrupt_flag() as interrupted:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupted()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_whose_exception_is_lost_comes_again():
    with pytest.raises(Stopped) as caught, signals_raise():
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            pass  # as compiled code does
        try:
            time.sleep(LONG)
        except KeyboardInterrupt:
            pass
        time.sleep(LONG)
    assert caught.value.number == signal.SIGTERM


def test_a_signal_that_is_lost_where_nothing_can_be_raised_comes_again_without_a_traceback(capsys):
    class Swallowing:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped), signals_raise():
        Swallowing()
        time.sleep(LONG)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("levels", [1, 4])
@pytest.mark.parametrize("error", [SystemError("returned a result"), ImportError("initialization failed")])
def test_an_interrupt_in_compiled_code_is_no_mistake_of_ours(error, levels, monkeypatch, capsys):
    def interrupted(*_: object) -> int:
        cause: BaseException = KeyboardInterrupt()
        for _ in range(levels - 1):
            inner = SystemError("returned a result")
            inner.__cause__ = cause
            cause = inner
        raise error from cause

    monkeypatch.setattr(command, "_dispatch", interrupted)
    assert command.run({}, []) == 130
    assert capsys.readouterr().err == "handsim: interrupted\n"


def test_what_fails_because_an_interrupt_was_kept_is_no_mistake_of_ours(monkeypatch, capsys):
    def interrupted(*_: object) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except BaseException as error:  # as trimesh does while it loads
            kept = error
        return kept | None  # type: ignore[operator]

    monkeypatch.setattr(command, "_dispatch", interrupted)
    assert command.run({}, []) == 143
    assert capsys.readouterr().err == "handsim: ended by SIGTERM\n"


def test_a_full_disk_that_an_interrupt_met_is_told(monkeypatch, capsys):
    def interrupted(*_: object) -> int:
        try:
            raise KeyboardInterrupt
        finally:
            raise OSError(errno.ENOSPC, "no space", "take.npz")

    monkeypatch.setattr(command, "_dispatch", interrupted)
    assert command.run({}, []) == 1
    assert "take.npz: the disk is full" in capsys.readouterr().err


def test_an_interrupt_that_was_wrapped_leaves_as_itself():
    stop = Stopped(signal.SIGTERM, "3 of 8")
    with pytest.raises(Stopped) as caught, interrupts_bare():
        raise SystemError("returned a result") from stop
    assert caught.value is stop
