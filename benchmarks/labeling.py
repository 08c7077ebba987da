"""How long the shipped labeler takes, matching included, on one thread.

python benchmarks/labeling.py [--frames 2000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from machine import describe

from train.labeler import load_labeler


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    count = parser.parse_args().frames
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(describe("torch", "scipy"))
    rng, labeler = np.random.default_rng(0), load_labeler("dense19")
    frames = [rng.uniform(-0.06, 0.06, size=(rng.integers(14, 22), 3)) for _ in range(count)]
    labeler.label_frames(frames[:50])
    times = []
    for frame in frames:
        start = time.perf_counter()
        labeler.label_frames([frame])
        times.append(1e3 * (time.perf_counter() - start))
    p50, p99 = np.percentile(times, [50, 99])
    start = time.perf_counter()
    labeler.label_frames(frames)
    together = 1e3 * (time.perf_counter() - start) / count
    print(f"one frame at a time: p50 {p50:.2f} ms, p99 {p99:.2f} ms; in batches {together:.2f} ms a frame")


if __name__ == "__main__":
    main()
