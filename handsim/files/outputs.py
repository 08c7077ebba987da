"""A check that no output is written over an input."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from handsim.errors import ArgumentError


def check_outputs(inputs: Iterable[object], outputs: Iterable[Path | None]) -> None:
    """Refuse an output that names an input, also through a link or in another spelling.

    Args:
        inputs: Files and folders that a command reads, and names that may be none; objects are no files.
        outputs: What it writes; None where not given.

    Raises:
        ArgumentError: An output is one of the inputs.
    """
    read = [Path(name) for name in inputs if isinstance(name, str | Path)]
    for output in (path for path in outputs if path is not None):
        for source in read:
            if _same(source, output):
                raise ArgumentError(f"the output {output} is the input {source}, expected another file")


def _same(source: Path, output: Path) -> bool:
    try:
        return os.path.samefile(source, output)
    except (OSError, ValueError):  # one of them does not exist
        return False
