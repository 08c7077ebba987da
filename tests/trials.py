"""The labeled trial that docs/tutorials/my_trial.md learns a glove from, and how right its labels are."""

from __future__ import annotations

import numpy as np

from gloves import Capture, load_layout, read_capture, write_capture
from train import simulate_take

NAMES = tuple(f"RH{number}" for number in range(1, 20))
TRUTH = "truth.npy"


def write_trial() -> None:
    """Write trial.c3d and second.c3d, which are labeled, and next.c3d, which is not."""
    take = simulate_take(kind="calibration", hands=("right",), num_frames=2000, seed=2)
    order = np.random.default_rng(0).permutation(len(NAMES))
    elbow = take.qpos[:, :1, :3] + [-0.28, 0.0, 0.0]
    points = np.concatenate([take.labeled_capture(sides=False).positions[:, order], elbow], axis=1)
    write_capture("trial.c3d", Capture((*NAMES, "Elbow"), points[:1200], take.rate))
    write_capture("second.c3d", Capture((*NAMES, "Elbow"), points[1200:1600], take.rate))
    shuffled = np.random.default_rng(1).permutation(points.shape[1])
    unknown = tuple(f"*{number}" for number in range(points.shape[1]))
    write_capture("next.c3d", Capture(unknown, points[1600:, shuffled], take.rate))
    np.save(TRUTH, points[1600:, : len(NAMES)])


def share_right() -> float:
    """Share of the markers of next_labeled.c3d that have their own names, which mine.toml must have too."""
    truth, found = np.load(TRUTH), read_capture("next_labeled.c3d")
    assert set(load_layout("mine.toml").names) == set(NAMES)
    given = found.positions[:, [found.names.index(name) for name in NAMES]]
    there = np.isfinite(truth[..., 0])
    return float((np.linalg.norm(given - truth, axis=2)[there] < 1e-4).mean())
