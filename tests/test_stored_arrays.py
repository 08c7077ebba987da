"""docs/stored_arrays.md names every array of the files, with its type and shape."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from handsim.cli.main import main
from train import generate_dataset

PAGE = Path(__file__).resolve().parents[1] / "docs" / "stored_arrays.md"
ROW = re.compile(r"^\| `(\w+)` \| (\S+) \| \(([^)]*)\) \|", re.M)
ONE_CAPTURE = {"T": 40, "H": 2, "M": 38, "B": 1, "Q": 6}  # two hands and a controller of six markers


def stated(after: str, before: str, sizes: dict[str, int]) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Type and shape of each name in the tables between two texts of the page."""
    text = PAGE.read_text(encoding="utf-8").partition(after)[2].partition(before)[0]
    return {
        name: (kind, tuple(sizes[size] if size in sizes else int(size) for size in re.findall(r"\w+", shape)))
        for name, kind, shape in ROW.findall(text)
    }


def kind_of(dtype: np.dtype[np.generic]) -> str:
    return "record" if dtype.names else dtype.str.lstrip("<|").replace("b1", "?")


def fields(dtype: np.dtype[np.void]) -> dict[str, tuple[str, tuple[int, ...]]]:
    assert dtype.names is not None
    return {name: (kind_of(dtype[name].base), dtype[name].shape) for name in dtype.names}


def arrays(path: Path) -> dict[str, tuple[str, tuple[int, ...]]]:
    with np.load(path) as stored:
        content = {name: stored[name] for name in stored.files if name != "header"}
    return {name: (kind_of(array.dtype), array.shape) for name, array in content.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    take, tracked = str(folder / "take.c3d"), str(folder / "tracked.npz")
    assert main(["simulate", "--kind", "hand-controller", "--num-frames", "40", "--out", take]) == 0
    assert main(["track", take, "--size", "M", "--body", "controller", "--out", tracked]) == 0
    generate_dataset(folder / "set", num_frames=60, workers=1)
    return folder


def test_rows_and_hands_of_a_training_set(folder: Path) -> None:
    rows, hands = (np.load(folder / "set" / f"{name}-00000.npy") for name in ("rows", "hands"))
    assert fields(rows.dtype) == stated("A row:", "A hand,", {"M": 19})
    assert fields(hands.dtype) == stated("A hand,", "## Takes", {"M": 19})


@pytest.mark.parametrize("file", ["tracked.npz", "take.truth.npz"])
def test_arrays_of_a_take(file: str, folder: Path) -> None:
    found = arrays(folder / file)
    spreads = {name: found.pop(name) for name in ("angle_spread", "keypoint_spread") if name in found}
    frames, hands = found["status"][1]
    told = {"angle_spread": ("f4", (frames, hands, 20)), "keypoint_spread": ("f4", (frames, hands, 21))}
    assert spreads == (told if file == "tracked.npz" else {})
    assert found == stated("## Takes", "\0", {**ONE_CAPTURE, "P": found["points"][1][0]})
