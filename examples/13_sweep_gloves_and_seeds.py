"""A study over gloves and seeds: one function a cell, done by Dask's workers, or one by one without Dask.

    python examples/13_sweep_gloves_and_seeds.py [tcp://scheduler:8786]

A cell simulates a capture and counts the labels of each hand. Put in its place what you want to know, such as
another rig or a labeler that is trained first; whatever it returns becomes a row.
"""

from __future__ import annotations

import itertools
import sys
from statistics import mean

from train import evaluate_labeler, load_labeler, simulate_take

GLOVES = ("dense19", "sparse13")
SEEDS = (0, 1, 2)


def cell(glove: str, seed: int) -> float:
    """Share of the label slots that are right."""
    take = simulate_take(kind="hand-hand", glove=glove, num_frames=60, seed=seed)
    return evaluate_labeler(load_labeler(glove), [take]).figures["slot_accuracy"]


def run(scheduler: str | None, cells: list[tuple[str, int]]) -> list[float]:
    """The value of every cell, in order."""
    if scheduler is None:
        return [cell(*one) for one in cells]
    from distributed import Client

    with Client(scheduler) as client:
        return client.gather(client.map(cell, *zip(*cells, strict=True)))


def main() -> None:
    cells = list(itertools.product(GLOVES, SEEDS))
    values = dict(zip(cells, run(*sys.argv[1:2] or [None], cells), strict=True))
    for glove in GLOVES:
        of_seeds = [values[glove, seed] for seed in SEEDS]
        row = " ".join(f"{100 * value:.2f}" for value in of_seeds)
        print(f"{glove}: {100 * mean(of_seeds):.2f} % of the slots right (by seed {row})")


if __name__ == "__main__":
    main()
