"""What tests of every package share."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from handsim import HandSimError
from handsim.files.signals import ENDING

ROOT = Path(__file__).resolve().parents[1]

# Two test processes with two threads each would wait for one another most of the time, and how many threads
# training uses, on which the last bits of weights depend, would be a question of what else the machine does.
# torch reads it when it is imported, which conftest.py of a folder may do before `pytest_configure`.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Hypothesis fails examples that take longer than 0.2 s: a question of what else the machine does, too.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def pytest_configure() -> None:
    """What tests learn is theirs alone; workers of pytest-xdist share it."""
    if "HANDSIM_TEST_CACHE" not in os.environ:
        os.environ["HANDSIM_TEST_CACHE"] = os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(
            prefix="handsim-cache-"
        )


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests come first, so that no process waits for the last of another.

    Tests of a folder go to one process of pytest-xdist: fixtures are then made once, and kernels that only
    they call are compiled once.
    """
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(str(item.path.parent.relative_to(ROOT))))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20180810)


@pytest.fixture(scope="session")
def sig18() -> Path:
    """The folder of the public Mocap_SIG18_Data captures, which are non-commercial and never part of this."""
    folder = Path(os.environ.get("HANDSIM_SIG18", ROOT.parent / "shared" / "sig18"))
    if not folder.is_dir():
        pytest.skip("the Mocap_SIG18_Data captures are not here; HANDSIM_SIG18 may name their folder")
    return folder


@pytest.fixture(autouse=True)
def denormals() -> Iterator[None]:
    """Training flushes denormal numbers in the whole process; hypothesis then refuses to draw any."""
    yield
    if "torch" in sys.modules:
        sys.modules["torch"].set_flush_denormal(False)


@pytest.fixture(autouse=True)
def heeded_signals() -> Iterator[None]:
    """Signals to end do what they usually do; a shell or nohup may have told them to be ignored."""
    before = {number: signal.getsignal(number) for number in ENDING}
    for number in ENDING:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def drawing() -> None:
    """Skips where nothing can be drawn."""
    from render.painting.opengl import offscreen_renderer

    try:
        offscreen_renderer(16, 16)
    except HandSimError as error:
        pytest.skip(str(error))
