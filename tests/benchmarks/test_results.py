"""The page of results and the README's table have the figures that benchmarks kept."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.record import FOLDER, kept, load_figures, save_figures
from benchmarks.results import PAGE, README, TEMPLATE, filled

ROOT = Path(__file__).resolve().parents[2]
NUMBER = re.compile(r"\d+\.\d+")


def test_the_page_is_what_the_script_writes():
    assert PAGE.read_text("utf-8") == filled(TEMPLATE.read_text("utf-8")), "`make results` puts it right"


def test_the_readme_has_the_kept_figures():
    text = (ROOT / "README.md").read_text("utf-8")
    assert "<!--" not in text
    section = text.split("\n## Results\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    assert len(rows) <= 8
    figures = [NUMBER.findall(row.strip(" |").rsplit("|", 1)[1]) for row in rows]
    assert figures == [filled(numbers).split() for numbers in README]


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_every_file_says_where_its_figures_come_from(path):
    content = json.loads(path.read_text("utf-8"))
    origin = {"command", "commit", "machine", "date", "figures"}
    assert set(content) - {"conditions"} == origin or "source" in content
    assert all(figure["what"] and figure["value"] is not None for figure in content["figures"].values())


def test_figures_are_kept_with_their_origin(tmp_path):
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if commit.returncode:
        pytest.skip("not a git checkout")
    path = save_figures(
        "speed", {"median": ("of a frame [ms]", [[0.5, np.nan], np.float64(2 / 3), 7])}, tmp_path
    )
    content = json.loads(path.read_text("utf-8"))
    assert commit.stdout.startswith(content["commit"]) and "cores" in content["machine"]
    assert content["figures"] == {"median": {"what": "of a frame [ms]", "value": [[0.5, None], 0.666667, 7]}}
    assert load_figures(tmp_path)["speed"].median[0][0] == 0.5


def test_what_was_made_is_kept(tmp_path):
    made = []

    def make():
        made.append(1)
        return {"number": 0}

    for _ in range(2):
        assert kept(tmp_path / "folder" / "one.json", make) == {"number": 0}
    assert made == [1]
