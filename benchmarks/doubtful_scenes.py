"""Captures with errors of all kinds: simulated, and tracked ones of real hands in motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.real_motion import tracker_of, true_labels
from benchmarks.real_scenes import CONDITIONS, make_scene
from gloves import Take
from track.label_confidence import label_confidence
from track.recorder import TakeRecorder
from train import OpticsOptions, simulate_take

KINDS = ("single-hand", "hand-hand", "hand-pen", "hand-controller")
POOR = OpticsOptions(blob_loss=0.08, dropout=0.004, noise=0.25)  # the usual: 0.002, 0.0002, 0.12


def simulate(glove: str, kind: str, seed: int, frames: int = 600) -> Take:
    """A capture with its truth, in which errors are likely."""
    turn, rng = (seed + KINDS.index(kind)) % 4, np.random.default_rng(seed)
    optics, others = POOR if turn in (1, 2) else OpticsOptions(), (20, 0, 10, 0)[turn]
    take = simulate_take(kind=kind, glove=glove, num_frames=frames, seed=seed, optics=optics, others=others)
    take = take.without_body()
    points, labels = take.points.copy(), take.labels.copy()
    if turn == 3:
        points += rng.normal(0.0, rng.uniform(0.0005, 0.0015), points.shape)
    for t in np.flatnonzero(rng.random(frames) < 1.0 / 60.0) if turn == 1 else ():
        seen = np.flatnonzero(labels[t] >= 0)
        near = np.linalg.norm(points[t, seen, None] - points[t, seen], axis=-1) < 0.03
        if len(pairs := np.argwhere(np.triu(near, 1))):
            pair = seen[pairs[rng.integers(len(pairs))]]
            for values in (points, labels):
                values[t:, pair] = values[t:, pair[::-1]]
    confidence = np.where(np.isfinite(points[..., 0]), 1.0, np.nan)
    return dataclasses.replace(take, points=points, labels=labels, confidence=confidence)


def real_takes(data: Path, frames: int) -> Iterator[tuple[str, Take, np.ndarray]]:
    """What each scene of real hands is, its tracked take, and the true labels."""
    for folder in sorted(data.glob("User*/capture*")):
        for condition in CONDITIONS:
            scene = make_scene(folder, condition, seed=1, frames=frames)
            stream, tracker = tracker_of(scene)
            recorder, there = TakeRecorder(tracker), np.isfinite(scene.points[..., 0])
            for frame in stream:
                recorder.add(frame, tracker.step(frame.points, frame.ids, frame.time))
            take = recorder.take(scene.capture())
            sure = dataclasses.replace(take.point_list, confidence=label_confidence(take))
            take = dataclasses.replace(take, point_list=sure)
            yield f"{folder.parent.name} {condition}", take, np.where(there, true_labels(scene), -1)
