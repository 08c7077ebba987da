"""What benchmarks keep: their figures as JSON, with the commit, the machine and the date."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import date
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from handsim import __version__

FOLDER: Final = Path(__file__).with_name("figures")
SAVE: Final = "keep the figures in benchmarks/figures; docs/results.md is made from them (make results)"
"""Help of the option `--save`, for benchmarks that have it."""


def describe(*packages: str) -> str:
    """One line: versions, processor, cores."""
    versions = [f"handsim {__version__}"]
    versions += [f"{name} {metadata.version(name)}" for name in ("numpy", *packages)]
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = models[0] if models else platform.processor() or platform.machine()
    return f"Python {platform.python_version()}, {', '.join(versions)}; {processor}, {os.cpu_count()} cores"


def save_figures(name: str, figures: Mapping[str, tuple[str, Any]], folder: Path = FOLDER) -> Path:
    """Write the figures of one benchmark, in place of those that its file had.

    Args:
        name: Name of the file, without its ending.
        figures: What each figure is, with its unit, and its value: a number, or lists of numbers.
        folder: Folder of the files.

    Returns:
        The file.
    """
    path = folder / f"{name}.json"
    words = " ".join(map(shlex.quote, sys.argv[1:]))
    main = getattr(sys.modules["__main__"], "__spec__", None)
    module = main.name.removesuffix(".__main__") if main is not None else sys.argv[0]
    commit = subprocess.run(
        ["git", "rev-parse", "--short=7", "HEAD"], cwd=FOLDER, capture_output=True, text=True, check=True
    )
    content = {
        "command": f"python -m {module} {words}".strip(),
        "commit": commit.stdout.strip(),
        "machine": describe(),
        "date": date.today().isoformat(),
        "figures": {key: {"what": what, "value": value} for key, (what, value) in figures.items()},
    }
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return path


def load_figures(folder: Path = FOLDER) -> dict[str, SimpleNamespace]:
    """The values of all figures: `load_figures()["table5"].right_size[1]`."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        figures = json.loads(path.read_text("utf-8"))["figures"]
        found[path.stem] = SimpleNamespace(**{name: one["value"] for name, one in figures.items()})
    return found
