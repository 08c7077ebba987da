"""What a benchmark ran on."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

from handsim import __version__


def describe(*packages: str) -> str:
    """One line: versions, processor, cores."""
    versions = [f"handsim {__version__}"]
    versions += [f"{name} {metadata.version(name)}" for name in ("numpy", *packages)]
    cpuinfo = Path("/proc/cpuinfo")
    models = [line.split(":")[1].strip() for line in _lines(cpuinfo) if line.startswith("model name")]
    processor = models[0] if models else platform.processor() or platform.machine()
    return f"Python {platform.python_version()}, {', '.join(versions)}; {processor}, {os.cpu_count()} cores"


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []
