"""The speed that a progress bar shows, and the lines in its place where there is no terminal."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console
from rich.progress import Progress

from handsim.app.progress import _line, _lines, _Speed, named_steps, progress_bar
from tests.waiting import wait_for


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
    assert str(_Speed("frames").render(bar.tasks[0])) == text


def test_a_log_gets_a_line_now_and_then():
    log = io.StringIO()
    bar = Progress(disable=True)
    task = bar.add_task("loss 0.812", total=1)
    bar.update(task, completed=12800, total=5_000_000)
    with _lines(Console(file=log, width=20), bar.tasks[0], "samples", every=0.05):
        wait_for(lambda: log.getvalue().count("\n") >= 2)
    line = log.getvalue().splitlines()[0]
    assert re.fullmatch(r"12,800 of 5,000,000 samples, loss 0\.812, 0:\d\d:\d\d", line)


def test_a_line_before_anything_is_done():
    bar = Progress(disable=True)
    bar.add_task("", total=1)
    assert _line(bar.tasks[0], "frames", 3661.2) == "getting ready, 1:01:01"


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
