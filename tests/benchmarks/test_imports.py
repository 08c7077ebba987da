"""Every benchmark can be imported, and is called on pages as it is called."""

from __future__ import annotations

import functools
import importlib
import re
import shlex
import sys
from pathlib import Path

import pytest

from benchmarks import record

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
MODULES = sorted(
    ".".join(("benchmarks", *path.relative_to(FOLDER).with_suffix("").parts))
    for path in FOLDER.rglob("*.py")
    if path.name != "__init__.py"
)
ELSEWHERE = ("embreex",)  # that only single benchmarks need


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_can_be_imported(name):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in ELSEWHERE:
            raise
        pytest.skip(f"{error.name} is not here")


def commands_of_pages() -> list[str]:
    """Commands of benchmarks between backticks in pages, options in brackets among them."""
    pages = (FOLDER.parent / "docs").rglob("*.md")
    texts = [path.read_text("utf-8") for path in (FOLDER.parent / "README.md", *pages)]
    return sorted({found for text in texts for found in re.findall(r"`python -m (benchmarks\.[^`]+)`", text)})


@pytest.mark.parametrize("command", commands_of_pages())
def test_a_page_calls_a_benchmark_as_it_is_called(command, monkeypatch):
    name, *words = shlex.split(re.sub(r"[\[\]]", "", command))
    module = importlib.import_module(name)
    if not hasattr(module, "run"):
        pytest.skip("reads its command line in another way")
    monkeypatch.setattr(sys, "argv", [name, *words])
    record.run(functools.wraps(module.main)(lambda *_, **__: None), module.__doc__)
