"""The notebooks of examples/ run whole, and hold no outputs of somebody's machine."""

from __future__ import annotations

import json

import pytest

from tests.documents import ROOT, Block, run_blocks

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def cells_of(path):
    content = json.loads(path.read_text("utf-8"))
    assert (content["nbformat"], content["metadata"]["kernelspec"]["name"]) == (4, "python3")
    return content["cells"]


def test_there_are_three():
    assert len(NOTEBOOKS) == 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_no_outputs(path):
    cells = cells_of(path)
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_whole(path, tmp_path, tmp_path_factory):
    sources = ["".join(cell["source"]) for cell in cells_of(path) if cell["cell_type"] == "code"]
    blocks = [Block(f"{path.name}:{number}", "python", code, None) for number, code in enumerate(sources)]
    printed = run_blocks(blocks, tmp_path, tmp_path_factory.mktemp("commands"))
    assert "".join(printed).strip()
    assert not list(tmp_path.iterdir()), "notebooks leave nothing behind"
