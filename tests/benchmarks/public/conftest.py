"""A benchmark of four captures of thirty frames, made once."""

from __future__ import annotations

import pytest

from benchmarks.public.difficulties import Plan
from benchmarks.public.making import make_benchmark
from benchmarks.public.manifest import Benchmark


@pytest.fixture(scope="session")
def plan() -> Plan:
    return Plan(
        "tiny",
        people=1,
        num_frames=30,
        kinds=("single-hand", "hand-controller"),
        difficulties=("easy", "hard"),
    )


@pytest.fixture(scope="session")
def benchmark(plan, tmp_path_factory) -> Benchmark:
    return make_benchmark(plan, tmp_path_factory.mktemp("benchmark") / "tiny", workers=1)
