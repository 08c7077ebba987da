"""Labeled captures of a lab: markers under names of its own, beside columns of other things."""

from __future__ import annotations

import numpy as np

from gloves import Capture, load_layout
from train import simulate_take

OTHERS = ("Elbow", "Wand1", "Wand2", "Wand3")
"""Columns that are no markers of the hand."""


def lab_trial(kind: str, num_frames: int, seed: int) -> tuple[Capture, dict[str, str]]:
    """A capture of a right hand in dense19, and the marker of each of the columns A0 to A18."""
    take = simulate_take(kind=kind, glove="dense19", num_frames=num_frames, hands=("right",), seed=seed)
    return renamed(take.labeled_capture(sides=False), take.qpos[:, 0, :3], seed)


def renamed(capture: Capture, wrists: np.ndarray, seed: int = 0) -> tuple[Capture, dict[str, str]]:
    """A labeled capture of dense19 with names A0 to A18 in random order, and other columns among them."""
    rng, markers = np.random.default_rng(seed), load_layout("dense19").names
    order = rng.permutation(len(markers))
    own = [capture.positions[:, capture.names.index(markers[number])] for number in order]
    elbow = wrists + [-0.28, 0.0, 0.02] + rng.normal(0.0, 0.01, (len(wrists), 3))
    wand = [np.tile(corner, (len(wrists), 1)) for corner in np.array([0.9, 0.4, 1.0]) + 0.1 * np.eye(3)]
    columns = [*own[:7], elbow, *wand, *own[7:]]
    names = [f"A{number}" for number in range(len(markers))]
    named = (*names[:7], *OTHERS, *names[7:])
    truth = {name: markers[number] for name, number in zip(names, order, strict=True)}
    return Capture(named, np.stack(columns, axis=1), capture.rate), truth
