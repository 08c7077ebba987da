"""The Python of the documents runs as it stands and prints what the documents say.

A page's blocks run in order, in one process, one namespace and one empty folder. A comment
`<!-- test: CODE -->` is a block that readers do not see; it makes the files that the next block reads.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from poses.shapes.sampling import SAMPLERS
from track.sinks.addresses import GROUP as SINKS
from track.streams.addresses import GROUP as SOURCES
from train.data.own_corruption import CORRUPTIONS
from train.labelers.protocol import LABELERS

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"^```python\n(?P<shown>.*?)^```\n(?:\s*prints\s+```\n(?P<prints>.*?)^```)?"
    r"|^<!-- test:(?P<hidden>.*?)-->",
    re.S | re.M,
)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
SLOW = {"calibration", "formats", "tracking_commands"}
RUNNER = """
import contextlib, io, json, sys
printed, namespace = [], {"__name__": "__main__"}
for name, code in json.load(sys.stdin):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(code, name, "exec"), namespace)
    printed.append(out.getvalue())
print(json.dumps(printed))
"""


class Block(NamedTuple):
    """Some Python of a page."""

    name: str
    code: str
    prints: str | None


def blocks_of(path: Path) -> list[Block]:
    text = path.read_text(encoding="utf-8")
    return [
        Block(
            f"{path.name}:{text[: match.start()].count(chr(10)) + 2}",
            match["shown"] if match["hidden"] is None else match["hidden"],
            match["prints"],
        )
        for match in BLOCK.finditer(text)
    ]


def run_blocks(blocks: list[Block], folder: Path) -> list[str]:
    """What each block prints."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", RUNNER],
        input=json.dumps([(block.name, block.code) for block in blocks]),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed: list[str] = json.loads(done.stdout.splitlines()[-1])
    return printed


PAGES = [path for path in sorted((ROOT / "docs").glob("*.md")) if blocks_of(path)]


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SLOW)) for path in PAGES],
)
def test_the_python_of_a_page_runs_and_prints_what_the_page_says(path, tmp_path):
    blocks = blocks_of(path)
    for block, printed in zip(blocks, run_blocks(blocks, tmp_path), strict=True):
        if block.prints is None:
            continue
        assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", block.prints).split(), block.name
        for ours, stated in zip(NUMBER.findall(printed), NUMBER.findall(block.prints), strict=True):
            # the last digits depend on the machine
            assert float(ours) == pytest.approx(float(stated), rel=0.05, abs=0.2), block.name


def test_every_python_block_of_the_documents_is_run():
    for path in sorted((ROOT / "docs").glob("*.md")):
        text = path.read_text(encoding="utf-8")
        shown = [
            block for block in blocks_of(path) if block.code in text and f"```python\n{block.code}" in text
        ]
        assert len(shown) == text.count("```python"), path.name


def test_a_block_that_fails_is_named(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\n<!-- test:\nvalue = 3\n-->\n\n```python\nprint(value)\nraise ValueError(value)\n```\n"
    )
    hidden, shown = blocks_of(page)
    assert run_blocks([hidden], tmp_path) == [""]
    with pytest.raises(AssertionError, match=r'page\.md:8", line 2(.|\n)*ValueError: 3'):
        run_blocks([hidden, shown], tmp_path)


GROUPS = {CORRUPTIONS, LABELERS, SAMPLERS, SINKS, SOURCES}  # of entry points


def test_every_module_that_a_page_names_exists():
    missing = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for name in re.findall(
            r"`((?:handsim|poses|gloves|render|train|track)(?:\.(?!(?:py|json|jpg|npz)\b)\w+)+)",
            path.read_text(),
        ):
            if name not in GROUPS and not _exists(name):
                missing.append(f"{path.name}: {name}")
    assert missing == []


def _exists(name: str) -> bool:
    """Whether a dotted name is a module, or something that a module has."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            thing: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if not hasattr(thing, part) and part not in getattr(thing, "__annotations__", {}):
                return False
            thing = getattr(thing, part, None)
        return True
    return False
