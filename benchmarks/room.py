"""How fast whole captures of the room are: people, gloves, motions, lines of sight and optics.

    python -m benchmarks.room [--frames 2048 --repeats 5]

Two hands, also with a pen or a controller, in one process and in two side by side, each on one core. Each
figure is the median of the repeats, each with people and motions of its own; the compiled code is warm.
"""

from __future__ import annotations

import multiprocessing
import time
from typing import Any

import numpy as np

from benchmarks.record import Figures, describe, report, run
from train import simulate_take

KINDS = ("hand-pen", "hand-controller", "hand-hand")


def worker(kind: str, frames: int, seeds: list[int], barrier: Any, queue: Any) -> None:
    """Wall and processor time [s] of captures that begin together with those of the other processes."""
    simulate_take(kind=kind, num_frames=256, seed=99)  # compiled code is loaded, trees are built
    for seed in seeds:
        barrier.wait()
        start, busy = time.perf_counter(), time.process_time()
        simulate_take(kind=kind, num_frames=frames, seed=seed)
        queue.put((seed, time.perf_counter() - start, time.process_time() - busy))


def side_by_side(kind: str, processes: int, frames: int, repeats: int) -> tuple[float, float]:
    """Frames a second of all processes together, and processor time a frame [us]; medians."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(processes), context.Queue()
    jobs = [
        context.Process(
            target=worker, args=(kind, frames, [10 * r + p for r in range(repeats)], barrier, queue)
        )
        for p in range(processes)
    ]
    for job in jobs:
        job.start()
    results = [queue.get(timeout=600) for _ in range(processes * repeats)]
    for job in jobs:
        job.join()
    slowest = [max(wall for seed, wall, _ in results if seed // 10 == r) for r in range(repeats)]
    busy = [cpu / frames for *_, cpu in results]
    return processes * frames / float(np.median(slowest)), 1e6 * float(np.median(busy))


def main(frames: int = 2048, repeats: int = 5, save: str | None = None) -> None:
    print(describe("mujoco", "numba", "scipy"))
    print(f"\nwhole captures of {frames} frames, people and motions included, medians of {repeats}")
    figures: Figures = {}
    for kind in KINDS:
        rates = []
        for processes in (1, 2):
            rate, busy = side_by_side(kind, processes, frames, repeats)
            rates.append((rate, busy))
            print(
                f"  {kind:16s} {processes} process(es): {rate:6,.0f} frames/s on the clock, {busy:5.0f} us "
                "of processor time a frame"
            )
        what = f"{kind}: frames/s of one process | processor time [us] | frames/s of two processes together"
        figures[kind.split("-")[1]] = (what, [*rates[0], rates[1][0]])
    report(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
