"""Space on the disk, asked for before the work."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Final

from handsim.errors import HandSimError

_UNITS: Final = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")


def check_free(folder: Path, needed: int, what: str, remedy: str, *, error: type[HandSimError]) -> None:
    """Refuse work that the disk has no space for.

    Args:
        folder: Where files will be; it need not exist yet.
        needed: Bytes still to be written.
        what: What needs them, for the message, in the plural.
        remedy: What to do beside freeing space, as in `ask for fewer frames`.
        error: Class of the error.
    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if needed > free:
        raise error(
            f"{what} need {shown_bytes(needed)}, but the disk of {folder} has {shown_bytes(free)} free; "
            f"{remedy} or name a folder on another disk"
        )


def shown_bytes(count: float) -> str:
    """A number of bytes with a unit that suits it."""
    unit = 0
    while count >= 1000.0 and unit < len(_UNITS) - 1:
        count, unit = count / 1000.0, unit + 1
    return f"{count:.3g} {_UNITS[unit]}"
