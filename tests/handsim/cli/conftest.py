"""The capture that tests of several commands read."""

from __future__ import annotations

from pathlib import Path

import pytest

from handsim.cli.main import main


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 frames of a hand and a controller, with their truth beside them."""
    out = tmp_path_factory.mktemp("take") / "take.c3d"
    assert main(["simulate", "--kind", "hand-controller", "--num-frames", "60", "--out", str(out)]) == 0
    return out
