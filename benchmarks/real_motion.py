"""The tracker on real hands in motion: published poses, two hands, made into captures without names.

python -m benchmarks.real_motion DATA [--conditions clean gaps close new-ids exchanged-ids]
    [--frames 0] [--label]

DATA is a folder of Mocap_SIG18_Data (Han et al. 2018), with User1/capture1 and so on in it. The left and the
right file of a sequence are one person's two hands at one time. Three captures move about three times as fast
from frame to frame as 120 Hz would show; they are played at 40 Hz. There is about 1.5 mm of noise per axis in
the data. Conditions:

clean          every marker in every frame
gaps           each marker missing for 4 frames at a time (median), 4 % of the time, and short-lived ghosts
close          gaps, the hands' centers 8 to 12 cm apart
new-ids        gaps, every point of every frame with a new ID
exchanged-ids  gaps, and in one of 40 frames two points within 22 mm exchange their IDs for good

A frame is right if every marker of both hands has its own point, or rightly none, and no ghost is a marker.
The size of the hands is measured (`handsim track --size auto`). With --label the labels are those of
`handsim label`; it takes a point of a column for the same one as before, so that new IDs are not new to it.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from benchmarks.real_scenes import CONDITIONS, FAST, NAMES, Condition, Scene, make_scene
from benchmarks.record import Figures, describe, run, save_figures
from gloves import load_layout
from track import StreamedFrame, Tracker, label_capture
from track.hand_size import fit_size, sample_frames
from train import load_labeler

SIDES = ("right", "left")


def main(
    data: Path,
    conditions: tuple[Condition, ...] = CONDITIONS,
    frames: int = 0,
    seed: int = 0,
    label: bool = False,
    save: str | None = None,
) -> None:
    torch.set_num_threads(1)
    print(describe("torch", "numba"))
    print("frames right [%] | " + " | ".join(conditions) + " | median, p99 of the time of a frame [ms]")
    table: list[list[float]] = []
    figures: Figures = {}
    for folder in sorted(data.glob("User*/capture*")):
        name, row, times = "/".join(folder.parts[-2:]), list[float](), []
        for condition in conditions:
            scene = make_scene(folder, condition, seed=seed, frames=frames)
            right, seconds = (labeled if label else tracked)(scene)
            row.append(100.0 * right.mean())
            times.append(1e3 * seconds)
        table.append(row)
        p50, p99 = np.percentile(np.concatenate(times), [50, 99])
        print_row(f"{name}, {'40' if name in FAST else '120'} Hz", row, f" | {p50:.2f}, {p99:.1f}")
        figures[name.lower().replace("/", "_")] = (
            f"frames right [%] of {name}: {', '.join(conditions)}",
            row,
        )
    for name, values in (("mean", np.mean(table, axis=0)), ("worst", np.min(table, axis=0))):
        print_row(name, values)
        figures[name] = (f"frames right [%] over the captures, {name}: {', '.join(conditions)}", values)
    save_figures(save, figures)


def print_row(name: str, values: object, rest: str = "") -> None:
    """A row of the table."""
    print(f"{name} | " + " | ".join(f"{value:.2f}" for value in values) + rest, flush=True)  # type: ignore[attr-defined]


def labeled(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The same for `handsim label`; the computing time is the mean one, the size measured included."""
    start = perf_counter()
    take = label_capture(scene.capture(), glove="dense19")
    seconds = np.full(len(scene.points), (perf_counter() - start) / len(scene.points))
    right = ((take.labels == true_labels(scene)) | ~np.isfinite(scene.points[..., 0])).all(axis=1)
    return right[scene.counted], seconds


def true_labels(scene: Scene) -> np.ndarray:
    """Marker of each column, -1 for a ghost."""
    columns = np.arange(scene.points.shape[1])
    return np.where(columns < 2 * len(NAMES), columns, -1)


def tracker_of(scene: Scene) -> tuple[list[StreamedFrame], Tracker]:
    """The frames of a scene, and a tracker of its hands, whose size is measured."""
    seen = np.isfinite(scene.points[..., 0])
    frames = [
        StreamedFrame(t, t / scene.rate, scene.points[t, seen[t]], scene.ids[t, seen[t]])
        for t in range(len(seen))
    ]
    layout, labeler = load_layout("dense19"), load_labeler("dense19")
    size = fit_size(sample_frames(frames), layout, SIDES, labeler)
    assert size is not None
    return frames, Tracker(size.hands(SIDES), labeler)


def tracked(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Which counted frames are right, and the computing time of each frame [s]."""
    seen = np.isfinite(scene.points[..., 0])
    frames, tracker = tracker_of(scene)
    truth = true_labels(scene)
    right, seconds = np.zeros(len(frames), dtype=bool), np.zeros(len(frames))
    for t, frame in enumerate(frames):
        start = perf_counter()
        labels = tracker.step(frame.points, frame.ids, frame.time).labels
        seconds[t] = perf_counter() - start
        right[t] = (labels == truth[seen[t]]).all()
    return right[scene.counted], seconds


if __name__ == "__main__":
    run(main, __doc__)
