"""Memory of the machine, asked for before the work."""

from __future__ import annotations

import os
from pathlib import Path

from handsim.errors import ArgumentError
from handsim.files.disk import shown_bytes


def check_memory(needed: int, what: str, remedy: str) -> None:
    """Refuse work that the machine has no memory for.

    Args:
        needed: Bytes that will be held at a time.
        what: What needs them, for the message, in the plural.
        remedy: What to do, as in `ask for fewer frames`.

    Raises:
        ArgumentError: The machine has less than that free.
    """
    free = available_bytes()
    if needed > free:
        raise ArgumentError(
            f"{what} need {shown_bytes(needed)} of memory, but {shown_bytes(free)} are free; {remedy}"
        )


def available_bytes() -> int:
    """Memory to be had without swapping [bytes]; all that is built in where the system tells no more."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
