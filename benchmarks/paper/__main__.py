"""Prints a table of Han et al. 2018 with our figures beside its own: `python -m benchmarks.paper table5`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Final

from benchmarks.paper.labeling_tables import LABELING_TABLES
from benchmarks.paper.tracking_tables import TRACKING_TABLES
from benchmarks.record import run_commands

TABLES: Final[dict[str, Callable[..., None]]] = {**LABELING_TABLES, **TRACKING_TABLES}

if __name__ == "__main__":
    sys.exit(run_commands("benchmarks.paper", __doc__, TABLES))
