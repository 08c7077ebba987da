"""Our trackers on the small public benchmark: the table of baselines in docs/benchmark.md.

    OMP_NUM_THREADS=1 python benchmarks/public_benchmark.py [OUT] [--trackers handsim paper hungarian nearest]

Makes the benchmark in OUT (a temporary folder when not given), runs every tracker with calibrated and
uncalibrated users, and prints frames and slots with right labels [%], mean distance of joints from the truth
[mm] and of joint angles [deg], each for easy, medium and hard. What is in OUT is not made again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import describe

from track.benchmark.baselines import TRACKERS, run_baseline
from track.benchmark.card import describe_captures
from track.benchmark.difficulties import DIFFICULTIES, SIZES
from track.benchmark.making import make_benchmark
from track.benchmark.score_tables import figure_text
from track.benchmark.scoring import score_results

FIGURES = ("frame_accuracy", "slot_accuracy", "mpjpe", "angle_error")
PLAN = SIZES["small"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--trackers", nargs="+", default=TRACKERS, choices=TRACKERS)
    arguments = parser.parse_args()
    print(describe())
    with tempfile.TemporaryDirectory() as temporary:
        measure(arguments.out or Path(temporary), arguments.trackers)


def measure(out: Path, trackers: list[str]) -> None:
    """Make the benchmark and run these trackers on it."""
    began = time.perf_counter()
    benchmark = make_benchmark(PLAN, out / PLAN.size, workers=1)
    took, files = time.perf_counter() - began, list(benchmark.folder.rglob("*.*"))
    megabytes = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
    print(f"made in {took:.0f} s by one core, {megabytes:.1f} MB")
    for name, counts in describe_captures(PLAN, benchmark.folder).items():
        print(
            f"{name}: {100 * counts.missing:.2f} % missing, {counts.gaps:.1f} gaps/s, "
            f"{counts.ghosts:.2f} ghosts"
        )
    print(f"easy, medium, hard: {', '.join(FIGURES)}")
    for tracker in trackers:
        for users in ("calibrated", "uncalibrated"):
            results = out / f"{tracker}-{users}"
            run_baseline(benchmark, tracker, results, users=users)
            score = score_results(benchmark, results)
            means = [score.mean(difficulty=name) for name in DIFFICULTIES]
            cells = " ".join(figure_text(name, one[name]) for name in FIGURES for one in means)
            kinds = [score.mean(difficulty="hard", kind=kind)["frame_accuracy"] for kind in PLAN.kinds]
            print(f"{tracker} {users}: {cells}; hard by kind {' '.join(f'{100 * one:.2f}' for one in kinds)}")
            assert not np.isnan(kinds).any()


if __name__ == "__main__":
    main()
