"""From nothing to labels better than the paper's best network on each of its four kinds of test, timed.

The clock runs while frames are generated and while the network learns, and stands while it is measured.

python -m benchmarks.first_labels [--captures DATA] [--frames 100000] [--samples 400000]
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.held_out import held_out_markers
from benchmarks.paper.labeling_tables import measure_augmentations
from benchmarks.paper.printed import AUGMENTATIONS, TABLE2
from benchmarks.people import read_markers
from benchmarks.record import describe, report, run
from gloves import load_layout
from gloves.captures.formats import find_captures
from train import Dataset, GenerateSettings, TrainSettings
from train.data.batches import draw_batch
from train.fabric import start_fabric
from train.labelers.networks import labeler_of
from train.loop import TrainingState
from train.settings import batch_recipe, usual_settings
from train.simulation.generation import make_dataset

GLOVE = "dense19"
EVERY = 40_000  # samples between two looks
FRAMES = 3000  # of each test set


def main(
    captures: Path | None = None,
    frames: int = 100_000,
    samples: int = 400_000,
    save: str | None = None,
) -> None:
    print(describe("torch", "mujoco"))
    tests = {"unseen simulated": held_out_markers(GLOVE, FRAMES, seed=1)}
    if captures is not None:
        markers = read_markers(find_captures([captures]), load_layout(GLOVE).names)
        tests["captures"] = markers[:: -(-len(markers) // FRAMES)]
    with tempfile.TemporaryDirectory() as folder:
        config = dataclasses.replace(usual_settings("set"), samples=samples)
        beaten = race(tests, frames, config, Path(folder))
    for name, times in beaten.items():
        print(name + ": " + ", ".join(f"{test} after {minutes:.1f} min" for test, minutes in times.items()))
    if all(len(times) == len(AUGMENTATIONS) for times in beaten.values()):
        what = "minutes until the last of the paper's four best figures was beaten, generation included"
        report(save, {"all": (what, max(time for times in beaten.values() for time in times.values()))})


def race(
    tests: dict[str, np.ndarray], frames: int, config: TrainSettings, folder: Path
) -> dict[str, dict[str, float]]:
    """Minutes from the start until the paper's best network was beaten, by test set and kind of test."""
    start, measuring = time.perf_counter(), 0.0
    make_dataset(GenerateSettings(glove=GLOVE, num_frames=frames), folder / "set")
    dataset = Dataset(folder / "set")
    rows, names = dataset.rows(), dataset.marker_names
    recipe = batch_recipe(config, len(names))
    print(f"{(time.perf_counter() - start) / 60:5.1f} min: {frames} frames generated")
    state = TrainingState(config, start_fabric(config, folder), rows)
    beaten: dict[str, dict[str, float]] = {name: {} for name in tests}
    while state.done < config.samples:
        rng = np.random.default_rng(state.done)
        state.step(draw_batch(rows, recipe, rng=rng), rng=rng)
        if state.done % EVERY >= config.batch and state.done < config.samples:
            continue
        stopped = time.perf_counter()
        minutes = (stopped - start - measuring) / 60
        labeler = labeler_of(state.averaged(), names)
        for name, markers in tests.items():
            reports = measure_augmentations(labeler, markers, seed=0)
            ours = {test: report.figures["slot_accuracy"] for test, report in reports.items()}
            best = {test: max(TABLE2[test]) for test in ours}
            for test in AUGMENTATIONS:
                if ours[test] > best[test]:
                    beaten[name].setdefault(test, minutes)
            words = ", ".join(f"{test} {100 * ours[test]:.2f} ({100 * best[test]:.2f})" for test in ours)
            print(f"{minutes:5.1f} min, {state.done:7d} samples, {name}: {words}", flush=True)
        measuring += time.perf_counter() - stopped
        if all(len(times) == len(AUGMENTATIONS) for times in beaten.values()):
            break
    return beaten


if __name__ == "__main__":
    run(main, __doc__)
