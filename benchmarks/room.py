"""How fast whole captures of the room are: people, gloves, motions, lines of sight and optics.

    python -m benchmarks.room [--frames 2048 --repeats 5]

Two hands, also with a pen or a controller, in two processes side by side, each on one core. Each figure is
the median of the repeats, each with people and motions of its own; the compiled code is warm.
"""

from __future__ import annotations

import multiprocessing
from typing import Any

import numpy as np

from benchmarks.record import Figures, describe, report, run, timed
from train import simulate_take

KINDS = ("hand-pen", "hand-controller", "hand-hand")


def worker(kind: str, frames: int, seeds: list[int], barrier: Any, queue: Any) -> None:
    """Time [s] of captures that begin together with those of the other process."""
    simulate_take(kind=kind, num_frames=256, seed=99)  # compiled code is loaded, trees are built
    for seed in seeds:
        barrier.wait()
        queue.put((seed, timed(lambda: simulate_take(kind=kind, num_frames=frames, seed=seed))))  # noqa: B023


def side_by_side(kind: str, frames: int, repeats: int) -> float:
    """Frames a second of two processes together, the median of the repeats."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(2), context.Queue()
    for p in range(2):
        seeds = [10 * r + p for r in range(repeats)]
        context.Process(target=worker, args=(kind, frames, seeds, barrier, queue)).start()
    results = [queue.get(timeout=600) for _ in range(2 * repeats)]
    slowest = [max(wall for seed, wall in results if seed // 10 == r) for r in range(repeats)]
    return 2 * frames / float(np.median(slowest))


def main(frames: int = 2048, repeats: int = 5, save: str | None = None) -> None:
    print(describe("mujoco", "numba", "scipy"))
    figures: Figures = {}
    for kind in KINDS:
        what = f"{kind}: frames/s of two processes together"
        figures[kind.split("-")[1]] = what, side_by_side(kind, frames, repeats)
    report(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
