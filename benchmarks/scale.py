"""What large sets cost: processor time and bytes of each item, and how far a scheduler reaches.

python -m benchmarks.scale [--workers 4 16]

Items are made in this process by one thread, and processor time counts, so that other work on the machine
matters little. For the scheduler's part a Dask
cluster of many workers with one thread each runs in this process; its shards sleep for a second, and what
takes longer than that is the scheduler's, and that of this machine's cores, which all workers share.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.record import describe, run
from handsim.app.workers import chosen_workers, run_jobs
from render import RenderConfig, render_take
from train import GenerateSettings, simulate_take
from train.simulation.generation import make_dataset

SHARD = 1.0  # [s] that a shard sleeps
EACH = 8  # shards of each worker
PICTURES = 192
PERFECT = RenderConfig(depth_sensor=None, color_sensor=None)


def main(workers: tuple[int, ...] = (4, 16)) -> None:
    print(describe("dask"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        items = {
            "training frames": cost(lambda out: frames(out, 24_576), folder / "frames"),
            "pictures": cost(lambda out: pictures(out, PERFECT), folder / "plain"),
            "pictures with sensors": cost(lambda out: pictures(out, RenderConfig()), folder / "sensed"),
        }
        for kind, (seconds, num_bytes) in items.items():
            print(f"{kind}: {3.6 / seconds:.0f} thousand a core-hour, {num_bytes / 1e3:.2f} kB each")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"largest memory so far: {peak / 1e6:.2g} GB")
        for count in workers:
            share = efficiency(count)
            print(f"{count} workers: {100 * share:.0f} % of their time in shards of a second", flush=True)


def cost(make: Callable[[Path], int], out: Path) -> tuple[float, float]:
    """Processor time [s] and bytes of an item; `make` returns how many it made."""
    make(out.with_name(f"{out.name}-first"))  # kernels and tables are loaded
    start = time.process_time()
    count = make(out)
    seconds = time.process_time() - start
    files = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
    return seconds / count, sum(files) / count


def frames(out: Path, count: int) -> int:
    make_dataset(GenerateSettings(num_frames=count, seed=1), out, workers=1)
    return count


def pictures(out: Path, config: RenderConfig) -> int:
    """Two hands, with colors, depth, normals, ids and keypoints."""
    take = out.parent / "take.npz"
    if not take.exists():
        simulate_take(kind="hand-hand", num_frames=PICTURES, seed=1).save(take)
    return render_take(take, out, ("webdataset",), config, workers=1)


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
