"""Take part in the public benchmark with a labeler of your own: read points, write labels, get a score.

    python examples/13_score_your_own_labeler.py

The labeler here splits a frame's points at the widest gap between right and left and asks a network for each
half; put yours in its place. That works for hands that stay apart, so only captures of this kind are labeled;
the others count as zero, and the score says so. docs/benchmark.md reads the points without handsim.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gloves import read_capture
from train import load_labeler

HANDSIM = shutil.which("handsim") or str(Path(sys.executable).with_name("handsim"))
LABELER = load_labeler("dense19")


def label_frame(points: np.ndarray) -> list[str]:
    """A label for each of some points (N, 3) [m]; empty for a point of no marker."""
    order = np.argsort(points[:, 0])
    split = 1 + np.argmax(np.diff(points[order, 0]))
    labels = [""] * len(points)
    for side, half in (("left", order[:split]), ("right", order[split:])):
        for point, label in zip(half, LABELER.label_frames([points[half]])[0].labels, strict=True):
            labels[point] = f"{side}:{LABELER.marker_names[label]}" if label >= 0 else ""
    return labels


def label_capture(path: Path, out: Path) -> None:
    capture = read_capture(path)
    with out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["frame", "point", "label"])
        for number, points in enumerate(capture.positions, 1):
            there = np.flatnonzero(np.isfinite(points[:, 0]))
            for column, label in zip(there, label_frame(points[there]), strict=True):
                table.writerow([number, capture.names[column], label])


def main() -> None:
    with TemporaryDirectory() as name:
        folder, results = Path(name) / "benchmark", Path(name) / "results"
        subprocess.run([HANDSIM, "benchmark", "make", "--out", folder], check=True)
        results.mkdir()
        for path in sorted(folder.glob("captures/single-hand-*.trc")):
            label_capture(path, results / f"{path.stem}.csv")
        score = Path(name) / "score.json"
        subprocess.run([HANDSIM, "benchmark", "score", folder, results, "--json", score], check=True)
        captures = json.loads(score.read_text())["captures"]
    for capture, figures in captures.items():
        if capture.startswith("single-hand"):
            print(f"{capture}: {100 * figures['frame_accuracy']:.1f} % of the frames all right")


if __name__ == "__main__":
    main()
