"""The documents: their pages, and the blocks of them that tests run.

A page's blocks of Python and of the shell run in order, in one namespace and one empty folder. A comment
`<!-- test: CODE -->` is a block of Python that readers do not see; it makes the files that the next block
reads.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
MADE = {"api", "help"}  # folders that the build of the site writes
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.relative_to(DOCS).parts[0] not in MADE]
BLOCK = re.compile(
    r"^```(?P<kind>python|sh)\n(?P<shown>.*?)^```\n(?:\s*prints\s+```\n(?P<prints>.*?)^```)?"
    r"|^<!-- test:(?P<hidden>.*?)-->",
    re.S | re.M,
)
RUNNER = """
import contextlib, io, json, subprocess, sys
printed, namespace = [], {"__name__": "__main__"}
for name, kind, code in json.load(sys.stdin):
    if kind == "sh":
        shell = ["bash", "-euo", "pipefail", "-c", code]
        done = subprocess.run(shell, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{name}: exit code {done.returncode}\\n{done.stdout}{done.stderr}")
        printed.append(done.stdout)
        continue
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(code, name, "exec"), namespace)
    printed.append(out.getvalue())
print(json.dumps(printed))
"""
HANDSIM = """#!/bin/sh
exec '{python}' -c 'import sys; from handsim.cli.main import main; sys.exit(main())' "$@"
"""


class Block(NamedTuple):
    """Some Python, or some lines for the shell, of a page."""

    name: str
    kind: str
    code: str
    prints: str | None


def name_of(page: Path) -> str:
    """A page's path in the folder of documents, without its ending."""
    return page.relative_to(DOCS).with_suffix("").as_posix()


def blocks_of(page: Path) -> list[Block]:
    """The blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            f"{page.name}:{text[: match.start()].count(chr(10)) + 2}",
            match["kind"] or "python",
            match["shown"] if match["hidden"] is None else match["hidden"],
            match["prints"],
        )
        for match in BLOCK.finditer(text)
    ]


def run_blocks(
    blocks: list[Block], folder: Path, commands: Path, python: str = sys.executable, path: str = str(ROOT)
) -> list[str]:
    """What each block prints; `commands` is a folder for the command handsim of this Python and path."""
    command = commands / "handsim"
    command.write_text(HANDSIM.format(python=python))
    command.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{commands}:{Path(python).parent}:{os.environ['PATH']}",
        "PYTHONPATH": path,
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [python, "-c", RUNNER],
        input=json.dumps([(block.name, block.kind, block.code) for block in blocks]),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed: list[str] = json.loads(done.stdout.splitlines()[-1])
    return printed
