"""The one progress bar of all commands; in a batch job's log, a line every ten seconds."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

_COUNTS: Final = re.compile(r"[\d.,]+")
EVERY: Final = 10.0
"""Time between two lines where there is no terminal [s]."""
_PERIOD: Final = 600.0  # [s] that speeds and the time left are means over


class ProgressBar:
    """A bar for one task: called with what is done and all there is to do, it shows both."""

    def __init__(self, bar: Progress, task: TaskID) -> None:
        self._bar, self._task = bar, task

    def __call__(self, done: int, total: int) -> None:
        """Show what is done; this is a `handsim.callbacks.Progress`."""
        self._bar.update(self._task, completed=done, total=total)

    def advance(self, count: int = 1) -> None:
        """Show that more is done."""
        self._bar.advance(self._task, count)

    def step(self, name: str) -> None:
        """Show the name of what is being done; this is a `handsim.callbacks.OnStep`."""
        self._bar.update(self._task, description=name)

    def say(self, line: str) -> None:
        """Print a line above the bar, on standard error."""
        self._bar.console.print(line, soft_wrap=True, markup=False, highlight=False)


@contextmanager
def progress_bar(unit: str) -> Iterator[ProgressBar]:
    """A progress bar on standard error."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} " + unit),
        _Speed(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=_PERIOD,
    ) as bar:
        task = bar.add_task("", total=1)
        if console.is_terminal:
            yield ProgressBar(bar, task)
        else:
            with _lines(console, bar.tasks[0], unit):
                yield ProgressBar(bar, task)


@contextmanager
def named_steps(first: str) -> Iterator[Callable[[str], None]]:
    """Names steps whose length is not known, on standard error: on a terminal the running one, else all."""
    console = Console(stderr=True)
    if console.is_terminal:
        with console.status(first) as status:
            yield status.update
        return
    last, due = "", 0.0

    def tell(step: str) -> None:
        nonlocal last, due
        name, now = _COUNTS.sub("", step), time.monotonic()
        if name != last or now >= due:
            last, due = name, now + EVERY
            console.print(step, soft_wrap=True, markup=False, highlight=False)

    tell(first)
    yield tell


@contextmanager
def _lines(console: Console, task: Task, unit: str, every: float = EVERY) -> Iterator[None]:
    """Print the state of a task now and then, so that a log shows that it lives."""
    ended = threading.Event()
    start = time.monotonic()

    def report() -> None:
        while not ended.wait(every):
            line = _line(task, unit, time.monotonic() - start)
            try:
                console.print(line, soft_wrap=True, markup=False, highlight=False)
            except (OSError, SystemExit):  # nobody reads it
                return

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()


def _line(task: Task, unit: str, seconds: float) -> str:
    """How far a task is: the share done, its speed and the time that it has taken."""
    speed = str(_Speed(unit).render(task))
    total = 0.0 if task.total is None else task.total
    if total == 1.0 and not task.completed:  # the task does not know its size yet
        done = "getting ready"
    else:
        done = f"{task.completed:,.0f} of {total:,.0f} {unit}".rstrip()
    clock = _clock(seconds)
    rest = task.time_remaining
    left = f"{_clock(rest)} left" if rest else ""
    return ", ".join(part for part in (done, task.description, speed, clock, left) if part)


def _clock(seconds: float) -> str:
    return f"{seconds // 3600:.0f}:{seconds % 3600 // 60:02.0f}:{seconds % 60:02.0f}"


class _Speed(ProgressColumn):
    """Mean speed in units per second; blank until there is something to measure."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self.unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        number = f"{speed:,.0f}" if speed >= 10.0 else f"{speed:.2g}"
        return Text(f"{number}{' ' * bool(self.unit)}{self.unit}/s", style="progress.data.speed")
