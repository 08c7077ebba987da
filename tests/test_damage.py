"""Four flipped bytes in a file of what is resumed: it comes out right, or one sentence names the file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from handsim.errors import HandSimError
from train import GenerateSettings
from train.data.shards import MANIFEST
from train.simulation import generation
from train.simulation.generation import make_dataset

PLACES = (0.0, 0.4, 0.7, 1.0)
"""Where bytes are flipped, as shares of a file's length."""


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def assert_never_truth(
    folder: Path, scratch: Path, again: Callable[[Path], object], expected: dict[str, bytes]
) -> None:
    """Damage in copies of a folder is refused by name, or made good by the same command."""
    names = sorted(contents(folder))
    assert names
    for name in names:
        whole = (folder / name).read_bytes()
        for place in PLACES:
            for mask in (0x01, 0xFF):  # the first turns digits into digits
                shutil.rmtree(scratch, ignore_errors=True)
                shutil.copytree(folder, scratch)
                start = int(place * max(len(whole) - 4, 0))
                content = bytearray(whole)
                content[start : start + 4] = bytes(one ^ mask for one in content[start : start + 4])
                (scratch / name).write_bytes(content)
                try:
                    again(scratch)
                except HandSimError as error:
                    assert Path(name).name in str(error), f"{name} at {start}: {error}"
                else:
                    assert contents(scratch) == expected, f"{name} at {start}"


@pytest.mark.filterwarnings("ignore::handsim.HandSimWarning")
@pytest.mark.parametrize("state", ["finished", "half"])
def test_a_training_set(tmp_path, monkeypatch, state):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", 20)
    settings = GenerateSettings(num_frames=50, frames_per_hand=10, scenes={"alone": 1.0})

    def again(folder: Path) -> None:
        make_dataset(settings, folder, workers=1)

    again(tmp_path / "set")
    expected = contents(tmp_path / "set")
    if state == "half":
        (tmp_path / "set" / MANIFEST).unlink()
        for path in (tmp_path / "set").glob("*-00002.*"):
            path.unlink()
    assert_never_truth(tmp_path / "set", tmp_path / "damaged", again, expected)
