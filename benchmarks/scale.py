"""What a million and a billion cost: processor time and bytes of each item, and how far a scheduler reaches.

python -m benchmarks.scale [--core-hour 0.045] [--gigabyte-month 0.023] [--workers 4 16]

Items are made in this process by one thread, and processor time counts, so that other work on the machine
matters little. Prices are dollars per core-hour and per gigabyte and month. For the scheduler's part a Dask
cluster of many workers with one thread each runs in this process; its shards sleep for a second, and what
takes longer than that is the scheduler's, and that of this machine's cores, which all workers share.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.held_out import held_out_markers
from benchmarks.record import describe, run
from handsim.app.workers import chosen_workers, run_jobs
from render import RenderConfig, render_take
from train import Corruption, GenerateSettings, corrupt, load_labeler, simulate_take
from train.simulation.generation import make_dataset

SHARD = 1.0  # [s] that a shard sleeps
EACH = 8  # shards of each worker
PICTURES = 192
PERFECT = RenderConfig(depth_sensor=None, color_sensor=None)


class Cost(NamedTuple):
    """Of one item, on one core."""

    seconds: float
    num_bytes: float


def main(core_hour: float = 0.045, gigabyte_month: float = 0.023, workers: tuple[int, ...] = (4, 16)) -> None:
    print(describe("dask", "torch"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        items = {
            "training frames": cost(lambda out: frames(out, 24_576), folder / "frames"),
            "pictures": cost(lambda out: pictures(out, PERFECT), folder / "plain"),
            "pictures with sensors": cost(lambda out: pictures(out, RenderConfig()), folder / "sensed"),
            "labeled hands": label_cost(),
        }
        for kind, one in items.items():
            print_cost(kind, one, core_hour, gigabyte_month)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"largest memory so far: {peak / 1e6:.2g} GB")
        for count in workers:
            share = efficiency(count)
            print(f"{count} workers: {100 * share:.0f} % of their time in shards of a second", flush=True)


def cost(make: Callable[[Path], int], out: Path) -> Cost:
    """Processor time and bytes of an item; `make` returns how many it made."""
    make(out.with_name(f"{out.name}-first"))  # kernels and tables are loaded
    start = time.process_time()
    count = make(out)
    seconds = time.process_time() - start
    files = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
    return Cost(seconds / count, sum(files) / count)


def frames(out: Path, count: int) -> int:
    make_dataset(GenerateSettings(num_frames=count, seed=1), out, workers=1)
    return count


def pictures(out: Path, config: RenderConfig) -> int:
    """Two hands, with colors, depth, normals, ids and keypoints."""
    take = out.parent / "take.npz"
    if not take.exists():
        simulate_take(kind="hand-hand", num_frames=PICTURES, seed=1).save(take)
    return render_take(take, out, ("webdataset",), config, workers=1)


def label_cost(count: int = 6000) -> Cost:
    """Corrupted clouds of the dense19 glove in batches, without files."""
    cloud = corrupt(held_out_markers("dense19", count, seed=1), Corruption(), rng=np.random.default_rng(0))
    hands = [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]
    labeler = load_labeler("dense19")
    labeler.label_frames(hands[:256])
    start = time.process_time()
    labeler.label_frames(hands)
    return Cost((time.process_time() - start) / count, 0.0)


def print_cost(kind: str, one: Cost, core_hour: float, gigabyte_month: float) -> None:
    hours = one.seconds / 3600.0
    print(f"{kind}: {1e-3 / hours:.0f} thousand a core-hour, {one.num_bytes / 1e3:.2f} kB each")
    for name, count in (("million", 1e6), ("billion", 1e9)):
        core_hours, gigabytes = count * hours, count * one.num_bytes / 1e9
        print(
            f"  {name}: {plain(core_hours)} core-hours, {plain(gigabytes)} GB; "
            f"${plain(core_hour * core_hours)}, "
            f"and ${plain(gigabyte_month * gigabytes)} a month"
        )


def plain(number: float) -> str:
    """Two figures that count, without an exponent."""
    rounded = float(f"{number:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10.0 else f"{rounded:g}"


def rest(number: int) -> int:
    time.sleep(SHARD)
    return number


def efficiency(count: int) -> float:
    """Share of the workers' time that is spent in shards."""
    from distributed import LocalCluster

    options = {"n_workers": count, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with LocalCluster(**options, protocol="tcp://", host="127.0.0.1", silence_logs="CRITICAL") as cluster:
        with chosen_workers(cluster.scheduler_address, None, lambda line: None) as executor:
            start = time.perf_counter()
            done = sum(1 for _ in run_jobs(rest, range(EACH * count), executor))
            return done * SHARD / count / (time.perf_counter() - start)


if __name__ == "__main__":
    run(main, __doc__)
