"""`handsim report` from the file of a take: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path

import pytest

import gloves
from handsim.cli.main import main

FRAMES = 60
DENSE19 = Path(gloves.__file__).parent / "layouts" / "dense19.toml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated take's truth, and the take that was tracked of its points."""
    folder = tmp_path_factory.mktemp("takes")
    capture, out = str(folder / "take.c3d"), str(folder / "tracked.npz")
    assert main(["simulate", "--kind", "hand-pen", "--num-frames", str(FRAMES), "--out", capture]) == 0
    assert main(["track", capture, "--size", "M", "--out", out]) == 0
    return folder


def test_a_page_and_its_tables_are_written(folder, tmp_path, capsys):
    name, out = "tracked.npz", tmp_path / "new" / "page.html"
    assert main(["report", str(folder / name), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{out}: page on {folder / name}; tables in ") and said.count("\n") == 1
    names = {path.name for path in out.parent.iterdir()}
    endings = ("html", "frames.csv", "joints.csv", "markers.csv", "doubts.csv", "reach.csv", "angles.csv")
    assert names == {f"page.{ending}" for ending in endings}
    assert all(one in said for one in names)
    with (out.parent / "page.frames.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 2 * FRAMES
    page = out.read_text(encoding="utf-8")
    assert f"<h1>Take {name}</h1>" in page and "Right hand: joint angles" in page
    assert "mean hands of size M" in page
    sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (folder / "take.c3d", DENSE19)]
    with (out.parent / "page.angles.csv").open(newline="") as file:
        made = next(csv.DictReader(file))["made of"]
    for text in (made, page):
        assert f"capture take.c3d (SHA-256 {sums[0]}), glove dense19 (SHA-256 {sums[1]})" in text
