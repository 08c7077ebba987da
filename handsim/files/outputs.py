"""A check, before the work, that outputs can be written, and none of them over an input."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from handsim.errors import ArgumentError


def check_outputs(inputs: Iterable[object], outputs: Iterable[Path | None]) -> None:
    """Refuse an output that names an input, also through a link or in another spelling, or has no place.

    Args:
        inputs: Files and folders that a command reads, and names that may be none; objects are no files.
        outputs: What it writes; None where not given.

    Raises:
        ArgumentError: An output is one of the inputs, or what should be its folder is a file or is closed.
    """
    read = [Path(name) for name in inputs if isinstance(name, str | Path)]
    for output in (path for path in outputs if path is not None):
        _check_place(output)
        for source in read:
            if _same(source, output):
                raise ArgumentError(f"the output {output} is the input {source}, expected another file")


def _check_place(output: Path) -> None:
    """Refuse an output below a file, or in a folder in which this user may not write."""
    there = next((path for path in output.absolute().parents if path.exists()), None)
    if there is not None and not there.is_dir():
        raise ArgumentError(f"the output {output} lies in {there.name}, which is a file, expected a folder")
    if there is not None and not os.access(there, os.W_OK | os.X_OK):
        raise ArgumentError(f"the output {output} cannot be written: {there} is closed to this user")


def _same(source: Path, output: Path) -> bool:
    try:
        return os.path.samefile(source, output)
    except (OSError, ValueError):  # one of them does not exist
        return False
