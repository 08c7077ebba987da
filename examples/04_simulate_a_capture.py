"""Simulate a capture of two hands and a pen, count its gaps, save it and label it.

    python examples/04_simulate_a_capture.py

The simulated optical system loses markers and makes ghosts. The take knows the truth, so the labels that the
shipped labeler gives to each frame can be counted. `handsim simulate` writes the same two files.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gloves import Capture, Take, load_take, read_capture, write_capture
from track import label_capture
from train import evaluate_labeler, evaluate_labels, load_labeler, simulate_take


def main() -> None:
    simulated = simulate_take(kind="hand-pen", num_frames=300)  # 2.5 s at 120 Hz
    with TemporaryDirectory() as folder:
        write_capture(Path(folder) / "pen.trc", simulated.capture())  # points without labels
        simulated.save(Path(folder) / "pen.truth.npz")  # labels, IDs and motion as well
        capture: Capture = read_capture(Path(folder) / "pen.trc")
        take: Take = load_take(Path(folder) / "pen.truth.npz")
    print(f"{capture.num_frames} frames of {len(capture.names)} columns at {capture.rate:g} Hz")
    present = take.markers_present()  # (300, 38)
    gaps = (present[:-1] & ~present[1:]).sum()  # a marker disappears
    ghosts = np.isfinite(take.points[..., 0]) & (take.labels < 0)  # (300, N)
    print(f"{gaps} gaps, {100 * (1 - present.mean()):.2f} % of the markers missing")
    print(f"{ghosts.sum() / take.num_frames:.2f} ghosts per frame")
    figures = evaluate_labeler(load_labeler("dense19"), [take]).figures
    for name in ("slot_accuracy", "occlusion_recall", "ghost_recall"):
        print(f"{name.replace('_', ' ')}: {100 * figures[name]:.2f} %")
    labeled = label_capture(capture, glove="dense19").labeled_capture()  # frames with those before and after
    report = evaluate_labels(labeled, take)
    print(f"slot accuracy in motion: {100 * report.figures['slot_accuracy']:.2f} %")


if __name__ == "__main__":
    main()
