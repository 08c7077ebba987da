"""What a command says: lines as they are, warnings as lines, and a line of status renewed in place."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, TextIO

from handsim.callbacks import Closing
from handsim.errors import HandSimWarning

_RENEWED: Final = 0.2  # [s] between two lines on a terminal
_PRINTED: Final = 10.0  # [s] between two lines elsewhere, as in the log of a batch job
_WIDTH: Final = 80  # columns of a terminal that does not tell


def print_line(line: str) -> None:
    """Print a line as it is: no markup in brackets, no colors, no breaks; odd bytes of names as escapes."""
    from rich.console import Console

    printable = line.encode("utf-8", "backslashreplace").decode("utf-8")
    Console().print(printable, highlight=False, soft_wrap=True, markup=False)


@contextmanager
def told_warnings(program: str) -> Iterator[None]:
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
    """Shows a line on standard error until the end of a `with` block."""

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
        self._due = time.monotonic() + (_RENEWED if self._terminal else _PRINTED)
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
        return max(os.get_terminal_size(sys.stderr.fileno()).columns or _WIDTH, 2)
    except (OSError, ValueError):
        return _WIDTH
