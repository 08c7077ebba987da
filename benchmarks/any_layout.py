"""The labeler for any layout beside trained ones: slots right, clean and with drops and ghosts; its time.

The shipped layouts, after a minute of training (`train.labelers.layout_labeler`), and with the labeler that
was trained on the layout. People and poses are simulated, and in no training.

python -m benchmarks.any_layout [--frames 1000] [--captures FOLDER]
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.people import read_markers
from benchmarks.record import describe, run, timed
from gloves import MarkerLayout, load_layout
from gloves.layout import list_layouts
from train import Corruption, Labeler, evaluate_labeler, load_labeler
from train.data.batches import paper_corruption
from train.labelers.layout_labeler import fine_tuned_labeler, sample_worn_markers
from train.labelers.storage import shipped_labelers

CAPTURE_FRAMES = 3000


def main(frames: int = 1000, captures: Path | None = None) -> None:
    print(describe("torch", "numpy"))
    print("slots right [%], clean / with the paper's drops and ghosts")
    for layout in map(load_layout, list_layouts()):
        began = time.perf_counter()
        labelers: dict[str, Labeler] = {"after a minute": fine_tuned_labeler(layout)}
        seconds = time.perf_counter() - began
        if layout.name in shipped_labelers():
            labelers["trained"] = load_labeler(layout.name)
        markers = sample_worn_markers(layout, frames, rng=np.random.default_rng(77))
        found = {name: accuracies(labeler, markers) for name, labeler in labelers.items()}
        print(
            f"{layout.name}: {layout.num_markers} markers, {told(found)}; known after {seconds:.0f} s, "
            f"{per_cloud(labelers['after a minute'], markers):.1f} ms a cloud",
            flush=True,
        )
        if captures and "trained" in labelers:
            real = real_markers(captures, layout)
            found = {name: accuracies(labeler, real) for name, labeler in labelers.items()}
            print(f"{layout.name}, real captures: {told(found)}", flush=True)


def accuracies(labeler: Labeler, markers: np.ndarray) -> tuple[float, float]:
    """Slot accuracy, clean and with the paper's recipe [%]."""
    recipe = paper_corruption(markers.shape[1])
    reports = [
        evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(3))
        for corruption in (Corruption(0, 0), recipe)
    ]
    clean, both = (100.0 * report.figures["slot_accuracy"] for report in reports)
    return clean, both


def real_markers(captures: Path, layout: MarkerLayout) -> np.ndarray:
    """Frames of real captures whose markers are those of a layout [m]."""
    markers = read_markers(sorted(captures.rglob("*.trc")), layout.names)
    return markers[:: max(1, len(markers) // CAPTURE_FRAMES)]


def told(found: Mapping[str, tuple[float, float]]) -> str:
    return "; ".join(f"{name} {clean:.2f} / {both:.2f}" for name, (clean, both) in found.items())


def per_cloud(labeler: Labeler, markers: np.ndarray) -> float:
    """Median time of a cloud that comes alone [ms]."""
    times = [timed(lambda cloud=cloud: labeler.label_frames([cloud])) for cloud in markers[:60]]  # type: ignore[misc]
    return 1e3 * float(np.median(times))


if __name__ == "__main__":
    run(main, __doc__)
