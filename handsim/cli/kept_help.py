"""A cache of help pages, one file per command, because tyro needs a second to make a page.

The key of a page is a hash of the sources of handsim and of tyro, Python's version, and the terminal. A page
must not depend on anything else, such as the names of existing files.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import io
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from handsim._imports import SIBLINGS, user_cache

_TERMINAL_VARIABLES: Final = ("FORCE_COLOR", "NO_COLOR", "TERM")


class _Page(io.StringIO):
    """A text stream with the encoding and terminal of the standard output, for colors and boxes."""

    encoding = getattr(sys.__stdout__, "encoding", "utf-8")

    def isatty(self) -> bool:
        """Whether the page is shown by a terminal."""
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def print_help(prog: str, make: Callable[[], object]) -> None:
    """Print the help of a command: the kept page, or the one that `make` prints, which is kept.

    Raises:
        SystemExit: After a page that `make` has printed, with its exit code.
    """
    page = _Page()
    key = hashlib.sha256(repr(_page_inputs(page)).encode()).hexdigest()
    path = user_cache() / "handsim" / "help" / f"{prog.replace(' ', '-')}.txt"
    with contextlib.suppress(OSError, ValueError):
        found, _, text = path.read_text("utf-8").partition("\n")
        if found == key:
            print(text, end="")
            return
    try:
        with contextlib.redirect_stdout(page):
            make()
    except SystemExit as end:
        if not end.code:
            _keep(path, f"{key}\n{page.getvalue()}")
        raise
    finally:
        print(page.getvalue(), end="")


def _page_inputs(page: _Page) -> list[object]:
    """The inputs that a page depends on."""
    home = Path(__file__).parents[2]
    tyro = importlib.util.find_spec("tyro")
    files = [tyro.origin] if tyro is not None and tyro.origin else []
    for package in ("handsim", *SIBLINGS):
        for folder, _, names in os.walk(home / package):
            files += [os.path.join(folder, name) for name in names if name.endswith(".py")]
    times = sorted((file, os.stat(file).st_mtime_ns) for file in files)
    shown = (page.isatty(), page.encoding, shutil.get_terminal_size().columns)
    return [times, sys.version, shown, [os.environ.get(name) for name in _TERMINAL_VARIABLES]]


def _keep(path: Path, text: str) -> None:
    """Keep a page where there is room for it."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        own = path.with_name(f"{path.name}.{os.getpid()}")
        own.write_text(text, "utf-8")
        own.replace(path)
