"""Renames of finished files that fail, or during which a signal comes."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest


def fails_at(patch: pytest.MonkeyPatch, at: int, number: int | None = None) -> list[Path]:
    """Let the rename of a temporary file to its final name number `at` fail, or send a signal after it.

    Renames within hidden folders and to hidden names are not counted.

    Returns:
        The final names, as they come.
    """
    rename, finals = os.replace, list[Path]()

    def replace(source: str | Path, target: str | Path) -> None:
        counts = ".tmp-" in Path(source).name and "-older" not in Path(source).name
        counts = counts and not any(part.startswith(".") for part in Path(target).parts)
        if counts:
            finals.append(Path(target))
        if counts and len(finals) == at + 1 and number is None:
            raise OSError(errno.EPERM, "Operation not permitted", str(source), None, str(target))
        rename(source, target)
        if counts and len(finals) == at + 1 and number is not None:
            signal.raise_signal(number)

    patch.setattr(os, "replace", replace)
    return finals
