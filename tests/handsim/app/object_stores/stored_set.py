"""A small training set, and what a folder or a store holds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from upath import UPath

from tests.folders import contents
from train import GenerateSettings, SceneMix

ROWS = 100
PRELOAD = f"from train.simulation import generation\ngeneration.ROWS_PER_SHARD = {ROWS}\n"
ALONE = SceneMix(alone=1.0, together=0.0, holding=0.0)
CONFIG = GenerateSettings(num_frames=4 * ROWS - 30, seed=5, frames_per_hand=50, scenes=ALONE)


def names(store: UPath) -> set[str]:
    """Names of all that a store's folder holds."""
    return {path.path.removeprefix(store.path + "/") for path in store.rglob("*") if path.is_file()}


def copied(store: UPath, folder: Path) -> dict[str, bytes]:
    """The same as `contents` of what a store holds, copied into a folder."""
    for name in names(store):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((store / name).read_bytes())
    return contents(folder)


def write_three(folder: Path, number: int) -> int:
    (folder / "part").mkdir()
    for name in ("a", "part/b", "part/c"):
        (folder / f"{name}-{number}").write_text(name * number)
    return number


@contextmanager
def two_workers(folder: Path) -> Iterator[object]:
    """A Dask cluster of two worker processes with one thread each, which write small shards."""
    distributed = pytest.importorskip("distributed", reason="needs `pip install 'handsim[cluster]'`")
    (folder / "small_shards.py").write_text(PRELOAD)
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        preload=[str(folder / "small_shards.py")],
        silence_logs="CRITICAL",
    ) as started:
        yield started
