"""What a command says: lines as they are, and warnings in the form of its errors."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from handsim.errors import HandSimWarning


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
