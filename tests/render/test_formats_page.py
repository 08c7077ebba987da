"""The examples of docs/formats.md run on folders that the writers wrote."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from render.formats.writer import FORMATS, open_writer

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
EXAMPLES = [code for code in re.findall(r"```python\n(.*?)```", PAGE, re.S) if '"out/' in code]


@pytest.mark.parametrize("code", EXAMPLES, ids=lambda code: code.split("\n")[-2][:24])
def test_examples_run(code: str, make_frame, tmp_path: Path) -> None:
    for module in ("webdataset", "pycocotools"):
        if module in code and importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not here")
    for name in re.findall(r'"out/(\w+)', code):
        writer = open_writer(name, tmp_path / "out" / name)
        writer.write(0, [make_frame(0, ("right", "left")), make_frame(1)])
        writer.finish()
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_the_page_names_every_format() -> None:
    assert all(f"| `{name}` |" in PAGE for name in FORMATS)
    assert len(EXAMPLES) == 5
