"""One line of status: it fits into a terminal, and a log gets one now and then."""

from __future__ import annotations

import fcntl
import io
import os
import re
import select
import struct
import sys
import termios

import pytest
from rich.console import Console
from rich.progress import Progress

from handsim.app import messages
from handsim.app.messages import (
    LiveStatus,
    ProgressBar,
    _logged_progress,
    _progress_line,
    _speed,
    named_steps,
    progress_bar,
    show_state,
)
from tests.waiting import wait_for

LINE = "frame 1234: right tracked, left tracked, controller tracked, 12 missing; Ctrl-C ends it"


@pytest.mark.parametrize("columns", [20, 200])
def test_a_terminal_shows_what_fits_into_its_line(columns, monkeypatch):
    reader, writer = os.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("4H", 24, columns, 0, 0))
    with os.fdopen(writer, "w") as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        with LiveStatus() as status:
            status.say("recording")
            status.show(LINE)
            assert not status.due
            status.show("not yet")
        shown = b""
        while select.select([reader], [], [], 0.2)[0]:
            shown += os.read(reader, 10_000)
    os.close(reader)
    assert shown.decode() == f"recording\r\n\r{LINE[: columns - 1]}\x1b[K\r\x1b[K"


def test_a_log_gets_a_line_every_ten_seconds(monkeypatch, capsys):
    now = [50.0]
    monkeypatch.setattr(messages.time, "monotonic", lambda: now[0])
    with LiveStatus() as status:
        for _ in range(200):
            status.show(f"{now[0]:.1f}")
            now[0] += 0.125
        status.show("writing", now=True)
    assert capsys.readouterr().err == "50.0\n60.0\n70.0\nwriting\n"


def test_a_terminal_that_is_gone_ends_nothing(monkeypatch):
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(sys, "stderr", Gone())
    with LiveStatus() as status:
        status.say("recording")
        status.show("frame 1")


@pytest.mark.parametrize(
    ("steps", "text"), [([100, 2600], "1,250 frames/s"), ([1, 2], "0.5 frames/s"), ([7], ""), ([], "")]
)
def test_speed_is_of_this_run_alone(steps, text):
    """What a resumed run had before it, told by the first step, is not what it did in that time."""
    clock = [0.0]
    bar = Progress(get_time=lambda: clock[0], disable=True)
    task = bar.add_task("", total=1)
    for done in steps:
        clock[0] += 2.0
        bar.update(task, completed=done, total=5000)
    assert _speed(bar.tasks[0], "frames") == text


def test_a_log_gets_a_line_now_and_then(monkeypatch):
    log = io.StringIO()
    bar = Progress(disable=True)
    task = bar.add_task("loss 0.812", total=1)
    bar.update(task, completed=12800, total=5_000_000)
    monkeypatch.setattr(messages, "LOG_INTERVAL", 0.05)
    with _logged_progress(Console(file=log, width=20), bar.tasks[0], "samples"):
        wait_for(lambda: log.getvalue().count("\n") >= 2)
    line = log.getvalue().splitlines()[0]
    assert re.fullmatch(r"12,800 of 5,000,000 samples, loss 0\.812, 0:\d\d:\d\d", line)


def test_without_a_unit_the_step_is_what_is_counted():
    bar = Progress(disable=True)
    bar.add_task("frames", total=600, completed=600)
    assert _progress_line(bar.tasks[0], "", 10.0) == "600 of 600 frames, 0:00:10"


def test_a_line_before_anything_is_done():
    bar = Progress(disable=True)
    bar.add_task("", total=1)
    assert _progress_line(bar.tasks[0], "frames", 3661.2) == "getting ready, 1:01:01"
    assert _progress_line(bar.tasks[0], "frames", 59.7) == "getting ready, 0:01:00"


def test_a_short_command_writes_no_line(capsys):
    with progress_bar("frames") as bar:
        bar(1, 2)
    assert capsys.readouterr().err == ""


def test_a_log_gets_a_line_a_step_and_not_one_a_count(capsys):
    with named_steps("starting") as step:
        for done in range(100):
            step(f"generating frames: {done} of 1,000")
        step("drawing")
        assert capsys.readouterr().err.splitlines() == [
            "starting", "generating frames: 0 of 1,000", "drawing"
        ]  # fmt: skip


def test_a_line_of_state_goes_where_the_command_shows_its_own(capsys):
    show_state("alone")
    with progress_bar("frames") as bar:
        show_state("compiling")
        show_state("")
        bar(1, 2)
    with named_steps("first"):
        show_state("compiling 2 kernels: 1 done")
        show_state("compiling 2 kernels: 2 done")
    lines = ["alone", "compiling", "first", "compiling 2 kernels: 1 done", "compiling 2 kernels: 2 done"]
    assert capsys.readouterr().err.splitlines() == lines


def test_a_share_is_told_where_a_command_shows_its_state(capsys, monkeypatch):
    monkeypatch.setattr(messages, "LOG_INTERVAL", 0.0)
    messages.share_of("learning")(1, 2)
    assert capsys.readouterr().err == "", "no command runs"
    with named_steps(""):
        show = messages.share_of("learning")
        for done in range(3):
            show(done, 4)
    lines = capsys.readouterr().err.splitlines()
    assert [re.sub(r"\d+ s", "N s", line) for line in lines] == [
        "learning: 25 %, about N s left",
        "learning: 50 %, about N s left",
    ]


def test_a_bar_shows_a_line_of_state_until_more_is_done():
    with Progress(disable=True) as progress:
        bar = ProgressBar(progress, progress.add_task(""))
        bar.step("drawing")
        bar.tell("compiling")
        assert progress.tasks[0].description == "compiling"
        bar(1, 2)
        assert progress.tasks[0].description == "drawing"
        bar.tell("compiling")
        bar.tell("")
        assert progress.tasks[0].description == "drawing"
