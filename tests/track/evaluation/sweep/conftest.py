"""A sweep that takes seconds, done once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from track.evaluation.sweep.results import write_results
from track.evaluation.sweep.running import run_sweep
from track.evaluation.sweep.sweep_file import load_sweep

SWEEP = """
gloves = ["sparse13"]
people = [3]
seeds = [{seeds}]
[generate]
num_frames = 600
[train]
samples = 512
network = {{ width = 16, gates = 4, depth = 2 }}
[simulate]
num_frames = 30
hands = ["right"]
[track]
users = "calibrated"
[vary]
"train.rig_share" = [0, 1]
"""


def _write(path: Path, seeds: str = "0") -> Path:
    path.write_text(SWEEP.format(seeds=seeds))
    return path


@pytest.fixture
def write_sweep() -> Callable[..., Path]:
    """Writes its file."""
    return _write


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A folder with the finished sweep, its file beside it."""
    folder = tmp_path_factory.mktemp("sweep")
    sweep = load_sweep(_write(folder / "sweep.toml"))
    write_results(run_sweep(sweep, folder / "out", workers=1), folder / "out")
    return folder / "out"
