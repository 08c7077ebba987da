"""What benchmarks keep: their figures as JSON, with the commit, the machine and the date."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import tyro
from rich.markup import escape
from rich.table import Table

from handsim import HandSimError, __version__
from handsim.app.messages import warnings_as_lines
from handsim.cli.parsing import run_command

FOLDER: Final = Path(__file__).with_name("figures")
Figures = dict[str, tuple[str, Any]]
"""What each figure is, with its unit, and its value, by its name: a number, or lists of numbers."""


def describe(*packages: str) -> str:
    """One line: versions, processor, cores."""
    versions = [f"handsim {__version__}"]
    versions += [f"{name} {metadata.version(name)}" for name in ("numpy", *packages)]
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = models[0] if models else platform.processor() or platform.machine()
    return f"Python {platform.python_version()}, {', '.join(versions)}; {processor}, {os.cpu_count()} cores"


def run(main: Callable[..., None], description: str | None) -> None:
    """Call a benchmark's function with the words of the command line.

    Args:
        main: Parameters without a default are positional, others options; `save` is for `save_figures`.
        description: What the help begins with.
    """
    tyro.cli(
        main, description=description, config=(tyro.conf.PositionalRequiredArgs, tyro.conf.FlagCreatePairsOff)
    )


def run_commands(
    module: str,
    description: str | None,
    commands: Mapping[str, Callable[..., Any]],
    args: Sequence[str] | None = None,
) -> int:
    """Run one function of a table, and return the exit code: 1, and one sentence, for a user's mistake."""
    program = f"python -m {module}"
    try:
        with warnings_as_lines(program):
            run_command(dict(commands), prog=program, help_line=description or "", args=args)
    except HandSimError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 1
    return 0


def report(save: str | None, figures: Figures) -> None:
    """Print the figures of a benchmark and keep them, see `save_figures`."""
    for what, value in figures.values():
        print(f"{what}: {_rounded(value)}")
    save_figures(save, figures)


def number_table(title: str, first: Iterable[str], columns: Iterable[str]) -> Table:
    """A table of numbers, whose first columns name the rows."""
    table = Table(title=escape(title))
    for name in first:
        table.add_column(name, no_wrap=True)
    for name in columns:
        table.add_column(escape(name), justify="right")
    return table


def timed(job: Callable[[], object]) -> float:
    """Time of a job [s]."""
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def resident_memory(process: int) -> int:
    """Memory of a process [bytes], by its number."""
    statm = Path("/proc", str(process), "statm").read_text()
    return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE")


def save_figures(
    name: str | None, figures: Figures, folder: Path = FOLDER, conditions: str | None = None
) -> Path | None:
    """Write the figures of one benchmark, in place of those that its file had.

    Args:
        name: Name of the file, without its ending; None writes nothing.
        figures: The figures.
        folder: Folder of the files.
        conditions: What they depend on, in sentences.

    Returns:
        The file.
    """
    if name is None:
        return None
    path = folder / f"{name}.json"
    # Where somebody keeps data is nobody's business, and tells nothing.
    words = [Path(word).name if os.path.isabs(word) else word for word in sys.argv[1:]]
    main = getattr(sys.modules["__main__"], "__spec__", None)
    module = main.name.removesuffix(".__main__") if main is not None else sys.argv[0]
    commit = subprocess.run(
        ["git", "rev-parse", "--short=7", "HEAD"], cwd=FOLDER, capture_output=True, text=True, check=True
    )
    head: dict[str, Any] = {
        "command": f"python -m {module} {shlex.join(words)}".strip(),
        "commit": commit.stdout.strip(),
        "machine": describe(),
        "date": date.today().isoformat(),
    }
    if conditions is not None:
        head["conditions"] = conditions
    rows = {key: {"what": what, "value": _rounded(value)} for key, (what, value) in figures.items()}
    path.write_text(file_text(head, rows), "utf-8")
    return path


def file_text(head: Mapping[str, Any], figures: Mapping[str, Any]) -> str:
    """A file's JSON, a line for each figure."""
    lines = [f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}," for key, value in head.items()]
    rows = [f"  {json.dumps(key)}: {json.dumps(one, ensure_ascii=False)}" for key, one in figures.items()]
    return "\n".join(["{", *lines, ' "figures": {', ",\n".join(rows), " }", "}", ""])


def _rounded(value: Any) -> Any:
    """Numbers to six digits, also in lists; None where there is no number."""
    if isinstance(value, str | None):
        return value
    if isinstance(value, list | tuple | np.ndarray):
        return [_rounded(one) for one in value]
    number = float(f"{float(value):.6g}")
    if not np.isfinite(number):
        return None
    return int(number) if number.is_integer() else number


def kept(path: Path, make: Callable[[], Any]) -> Any:
    """What a JSON file holds; where it is missing, it is made and kept there."""
    if not path.exists():
        made = json.dumps(make())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(made)
    return json.loads(path.read_text())


def load_figures(folder: Path = FOLDER) -> dict[str, SimpleNamespace]:
    """The values of all figures: `load_figures()["table5"].right_size[1]`."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        figures = json.loads(path.read_text("utf-8"))["figures"]
        found[path.stem] = SimpleNamespace(**{name: one["value"] for name, one in figures.items()})
    return found
