"""Simulate a capture of two hands and a pen, count its gaps, and label it.

    python examples/04_simulate_a_capture.py

The room's optical system loses markers and makes false ones; the labeler that comes with the package names
what it put out, frame by frame, and the truth beside it says how often it is right.
"""

from __future__ import annotations

import numpy as np

from gloves.captures.gaps import count_gaps
from train.evaluation.labeler_evaluation import evaluate_takes
from train.labelers.storage import load_labeler
from train.simulation.room_settings import TWINS
from train.simulation.takes import TakeConfig, simulate_take


def main() -> None:
    take = simulate_take(TakeConfig(kind="hand-pen", num_frames=300))  # 2.5 s at 120 Hz
    ghosts = np.isfinite(take.points[..., 0]) & (take.labels < 0)  # (300, N)
    ours, paper = count_gaps(take.markers_present()), TWINS["hand-pen"].paper
    print(f"{ours.gaps} gaps in {ours.frames} frames (the paper: {paper.gaps} in {paper.frames})")
    print(f"{ours.average_length:.2f} frames a gap (the paper: {paper.average_length})")
    print(f"{ours.average_missing:.2f} markers missing in such a frame (the paper: {paper.average_missing})")
    print(f"{ghosts.sum() / ours.frames:.2f} ghosts a frame")
    figures = evaluate_takes(load_labeler("dense19"), [take]).figures
    for name in ("slot_accuracy", "occlusion_recall", "ghost_recall"):
        print(f"{name.replace('_', ' ')}: {100 * figures[name]:.2f} %")


if __name__ == "__main__":
    main()
