"""The labeler for any layout beside trained ones: slots right, clean and with drops and ghosts; its time.

Without any training of the glove (at once), after a minute of it (`train.labelers.layout_labeler`), and
with the labeler that was trained on it. People and poses are simulated, and in no training. Random layouts of
6 to 30 markers come beside the shipped ones, some even over the hand, some crowded on few bones.

python -m benchmarks.any_layout [--frames 1000] [--random 4] [--captures FOLDER]
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.people import read_markers
from benchmarks.record import describe, run, timed
from gloves import MarkerLayout, load_layout
from gloves.layout import list_layouts
from track.glove_improvement import sample_places
from train import Corruption, Labeler, evaluate_labeler, load_labeler
from train.data.batches import paper_corruption
from train.labelers.layout_labeler import LayoutLabeler, fine_tuned_labeler, sample_worn_markers
from train.labelers.storage import shipped_labelers

CAPTURE_FRAMES = 3000


def main(frames: int = 1000, random: int = 4, captures: Path | None = None) -> None:
    print(describe("torch", "numpy"))
    print("slots right [%], clean / with the paper's drops and ghosts")
    rng = np.random.default_rng(2026)
    layouts = [load_layout(name) for name in list_layouts()]
    layouts += [random_layout(number, rng) for number in range(random)]
    unseen = []
    for layout in layouts:
        labelers: dict[str, Labeler] = {"at once": LayoutLabeler.at_once(layout)}
        began = time.perf_counter()
        labelers["after a minute"] = fine_tuned_labeler(layout)
        seconds = time.perf_counter() - began
        if layout.name in shipped_labelers():
            labelers["trained"] = load_labeler(layout.name)
        markers = sample_worn_markers(layout, frames, rng=np.random.default_rng(77))
        found = {name: accuracies(labeler, markers) for name, labeler in labelers.items()}
        print(
            f"{layout.name}: {layout.num_markers} markers, {told(found)}; known after {seconds:.0f} s, "
            f"{per_cloud(labelers['at once'], markers):.1f} ms a cloud",
            flush=True,
        )
        if layout.name not in list_layouts():
            unseen.append([found["at once"], found["after a minute"]])
        if captures and "trained" in labelers:
            real = real_markers(captures, layout)
            found = {name: accuracies(labeler, real) for name, labeler in labelers.items()}
            print(f"{layout.name}, real captures: {told(found)}", flush=True)
    for name, (at_once, tuned) in (("mean", np.mean(unseen, axis=0)), ("worst", np.min(unseen, axis=0))):
        print(f"random layouts, {name}: {told({'at once': at_once, 'after a minute': tuned})}")


def random_layout(number: int, rng: np.random.Generator) -> MarkerLayout:
    """A random layout, the markers at least 10 mm apart on the flat hand."""
    count = int(rng.integers(6, 31))
    places = sample_places(200, rng=rng, apart=0.010)
    share = rng.dirichlet(np.full(16, rng.choice([0.5, 2.0])))
    bones = sorted({place.bone for place in places})
    weight = np.array([share[bones.index(place.bone)] for place in places]) + 1e-9
    chosen = rng.choice(len(places), size=count, replace=False, p=weight / weight.sum())
    markers = tuple(dataclasses.replace(places[one], name=f"M{n}") for n, one in enumerate(chosen))
    return MarkerLayout(f"random{number}", markers, 0.0032)


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


def told(found: Mapping[str, Sequence[float]]) -> str:
    return "; ".join(f"{name} {clean:.2f} / {both:.2f}" for name, (clean, both) in found.items())


def per_cloud(labeler: Labeler, markers: np.ndarray) -> float:
    """Median time of a cloud that comes alone [ms]."""
    times = [timed(lambda cloud=cloud: labeler.label_frames([cloud])) for cloud in markers[:60]]  # type: ignore[misc]
    return 1e3 * float(np.median(times))


if __name__ == "__main__":
    run(main, __doc__)
