"""Messages of a command: plain lines, warnings as lines, progress bars, and a live line of status.

In the log of a batch job, a progress bar is a line every ten seconds. rich is imported inside functions,
because its import takes long.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Literal, TextIO

from handsim.callbacks import Closing
from handsim.errors import HandSimWarning

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task, TaskID
    from rich.text import Text

_TERMINAL_INTERVAL: Final = 0.2  # time between two lines on a terminal [s]
LOG_INTERVAL: Final = 10.0  # time between two lines elsewhere, as in the log of a batch job [s]
_DEFAULT_COLUMNS: Final = 80  # width of a terminal that does not state it
_NUMBERS: Final = re.compile(r"[\d.,]+")


def print_line(*lines: str) -> None:
    """Print lines without markup, colors and line breaks; invalid bytes of file names become escapes."""
    from rich.console import Console

    for line in lines:
        printable = line.encode("utf-8", "backslashreplace").decode("utf-8")
        Console().print(printable, highlight=False, soft_wrap=True, markup=False)


def print_table(
    rows: Sequence[Sequence[str | Text]], *, left: int = 1, wraps: bool = False, title: str | None = None
) -> None:
    """Print rows of cells, the header first; the first `left` columns are words, the others numbers.

    Unless the table `wraps`, each cell keeps to one line, and units stand below the titles, for eighty
    columns.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    header, *others = [[Text(cell) if isinstance(cell, str) else cell for cell in row] for row in rows]
    table = Table(box=None, pad_edge=False, title=None if title is None else Text(title))
    for number, column in enumerate(header):
        justify: Literal["left", "right"] = "left" if number < left else "right"
        name = column if wraps else Text(column.plain.replace(" [", "\n["))
        table.add_column(name, justify=justify, no_wrap=not wraps)
    for row in others:
        table.add_row(*row)
    Console().print(table)


@contextmanager
def warnings_as_lines(program: str) -> Iterator[None]:
    """Within the block every `HandSimWarning` is one line on the error stream, `program: warning: ...`."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", HandSimWarning)
        others = warnings.showwarning

        def tell(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, HandSimWarning):
                print(f"{program}: warning: {' '.join(str(message).splitlines())}", file=sys.stderr)
            else:
                others(message, category, filename, lineno, file, line)

        warnings.showwarning = tell
        yield


class LiveStatus(Closing):
    """A line of status on standard error, shown until the end of a `with` block."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._due = 0.0
        self._shown = False

    @property
    def due(self) -> bool:
        """Whether it is time for another line."""
        return time.monotonic() >= self._due

    def show(self, line: str, *, now: bool = False) -> None:
        """Show a line if it is time for one, or `now`."""
        if not (now or self.due):
            return
        self._due = time.monotonic() + (_TERMINAL_INTERVAL if self._terminal else LOG_INTERVAL)
        if self._terminal:
            self._write(f"\r{line[: _columns() - 1]}\x1b[K")
            self._shown = True
        else:
            self._write(line + "\n")

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self.close()
        self._write(line + "\n")

    def close(self) -> None:
        """Clear the line that is shown."""
        if self._shown:
            self._write("\r\x1b[K")
            self._shown = False

    def _write(self, text: str) -> None:
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except (OSError, ValueError):  # the terminal was closed, and the work goes on
            pass


def _columns() -> int:
    try:
        return max(os.get_terminal_size(sys.stderr.fileno()).columns or _DEFAULT_COLUMNS, 2)
    except (OSError, ValueError):
        return _DEFAULT_COLUMNS


_state_displays: list[Callable[[str], None]] = []
"""Functions that show a line in a progress bar or step; the innermost is last."""


def show_state(line: str) -> None:
    """Show a line in the progress bar or step of the running command, or without one on standard error.

    On a terminal an empty line shows the state again; elsewhere it is not printed.
    """
    if _state_displays and (line or sys.stderr.isatty()):
        _state_displays[-1](line)
    elif line:
        print(line, file=sys.stderr, flush=True)


def share_of(what: str) -> Callable[[int, int], None]:
    """A `Progress` that passes the share done and the time left to `show_state`."""
    began = last = time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        interval = _TERMINAL_INTERVAL if sys.stderr.isatty() else LOG_INTERVAL
        if _state_displays and done and now >= last + interval:
            last = now
            left = (now - began) * (total - done) / done
            show_state(f"{what}: {100.0 * done / total:.0f} %, about {left:.0f} s left")

    return show


@contextmanager
def _state_shown_by(display: Callable[[str], None]) -> Iterator[None]:
    """Within the block `show_state` passes its lines to `display`."""
    _state_displays.append(display)
    try:
        yield
    finally:
        _state_displays.remove(display)


class ProgressBar:
    """A bar for one task: called with what is done and all there is to do, it shows both."""

    def __init__(self, bar: Progress, task: TaskID) -> None:
        self._bar, self._task, self._step = bar, task, ""

    def __call__(self, done: int, total: int) -> None:
        """Show what is done, a `handsim.callbacks.Progress`; another total begins another estimate."""
        if total != self._bar.tasks[0].total:
            self._bar.reset(self._task, total=total)
        self._bar.update(self._task, completed=done, total=total, description=self._step)

    def advance(self, count: int = 1) -> None:
        """Show that more is done."""
        self._bar.update(self._task, advance=count, description=self._step)

    def step(self, name: str) -> None:
        """Show the name of what is being done; this is a `handsim.callbacks.OnStep`."""
        self._step = name
        self._bar.update(self._task, description=name)

    def tell(self, line: str) -> None:
        """Show a line until more is done."""
        self._bar.update(self._task, description=line or self._step)

    def say(self, line: str) -> None:
        """Print a line above the bar, on standard error."""
        self._bar.console.print(line, soft_wrap=True, markup=False, highlight=False)


@contextmanager
def progress_bar(unit: str) -> Iterator[ProgressBar]:
    """A progress bar on standard error."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Speed(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(_speed(task, unit), style="progress.data.speed")

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} " + unit),
        Speed(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        # Speeds and the time left are averages over ten minutes.
        speed_estimate_period=600.0,
    ) as bar:
        task = bar.add_task("", total=1)
        shown = ProgressBar(bar, task)
        if console.is_terminal:
            with _state_shown_by(shown.tell):
                yield shown
        else:
            with _logged_progress(console, bar.tasks[0], unit), _state_shown_by(shown.say):
                yield shown


@contextmanager
def named_steps(first: str) -> Iterator[Callable[[str], None]]:
    """Show names of steps of unknown length on standard error: the current one on a terminal, else all.

    If `first` is empty, nothing is shown until the first step or line of `show_state`.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        step = first

        def show(line: str) -> None:
            nonlocal step
            step = line
            status.update(line)

        with console.status(first) as status, _state_shown_by(lambda line: status.update(line or step)):
            yield show
        return
    last, due = "", 0.0

    def tell(step: str, *, always: bool = False) -> None:
        nonlocal last, due
        name, now = _NUMBERS.sub("", step), time.monotonic()
        if always or name != last or now >= due:
            last, due = name, now + LOG_INTERVAL
            console.print(step, soft_wrap=True, markup=False, highlight=False)

    if first:
        tell(first)
    with _state_shown_by(lambda line: tell(line, always=True)):
        yield tell


@contextmanager
def _logged_progress(console: Console, task: Task, unit: str) -> Iterator[None]:
    """Print the progress of a task at intervals, for a log."""
    ended = threading.Event()
    start = time.monotonic()

    def report() -> None:
        while not ended.wait(LOG_INTERVAL):
            line = _progress_line(task, unit, time.monotonic() - start)
            try:
                console.print(line, soft_wrap=True, markup=False, highlight=False)
            except (OSError, SystemExit):  # the stream was closed
                return

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()


def _progress_line(task: Task, unit: str, seconds: float) -> str:
    """A line on a task: the amount done, its speed, the elapsed time and the time left."""
    speed = _speed(task, unit)
    total = 0.0 if task.total is None else task.total
    if total == 1.0 and not task.completed:  # the task does not know its size yet
        done, step = "getting ready", task.description
    else:  # without a unit the step is what is counted
        step = task.description if unit else ""
        done = f"{task.completed:,.0f} of {total:,.0f} {unit or task.description}".rstrip()
    clock = _clock_time(seconds)
    rest = task.time_remaining
    left = f"{_clock_time(rest)} left" if rest else ""
    return ", ".join(part for part in (done, step, speed, clock, left) if part)


def _clock_time(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole % 3600 // 60:02}:{whole % 60:02}"


def _speed(task: Task, unit: str) -> str:
    """Mean speed in units per second; blank until there is something to measure."""
    speed = task.finished_speed or task.speed
    if not speed:
        return ""
    number = f"{speed:,.0f}" if speed >= 10.0 else f"{speed:.2g}"
    return f"{number}{' ' * bool(unit)}{unit}/s"
