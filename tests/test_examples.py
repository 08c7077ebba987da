"""Every example runs and says something."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


SLOW = ("05", "06", "07", "11", "14", "15")


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * path.name.startswith(SLOW))
        for path in sorted((ROOT / "examples").glob("*.py"))
    ],
)
def test_example_runs(path, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(path.parent)
    monkeypatch.setattr(sys, "argv", [str(path)])
    try:
        runpy.run_path(str(path), run_name="__main__")
    finally:
        for other in path.parent.glob("*.py"):
            sys.modules.pop(other.stem, None)
    assert capfd.readouterr().out.strip()
    assert not list(tmp_path.iterdir()), "examples leave nothing behind"
