"""A training set, a take and a store in memory, which tests of object stores share."""

from __future__ import annotations

import uuid

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from upath import UPath

from tests.folders import contents
from tests.handsim.app.object_stores.stored_set import CONFIG, ROWS
from train import simulate_take
from train.simulation import generation
from train.simulation.generation import make_dataset


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", ROWS)


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """The set as a folder has it."""
    out = tmp_path_factory.mktemp("whole") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "ROWS_PER_SHARD", ROWS)
        make_dataset(CONFIG, out, workers=1)
    return contents(out)


@pytest.fixture
def memory():
    """A folder of fsspec's store in memory."""
    yield UPath(f"memory://bucket-{uuid.uuid4().hex}/set")
    MemoryFileSystem.store.clear()


@pytest.fixture(scope="session")
def take(tmp_path_factory):
    file = tmp_path_factory.mktemp("take") / "take.truth.npz"
    simulate_take(num_frames=24).save(file)
    return file
