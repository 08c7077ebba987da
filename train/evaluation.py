"""Measure a labeler: known markers, corrupted as in the paper, labelled, and counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from train.augmentation import Corruption, corrupt
from train.labeler import Labeler
from train.metrics import LabelCounts

if TYPE_CHECKING:
    from jaxtyping import Float

_CHUNK: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What an evaluation found."""

    figures: dict[str, float]
    """Shares in [0, 1], see `train.metrics`."""
    slot_accuracy_by_marker: Float[np.ndarray, "M"]
    num_frames: int


def evaluate_labeler(
    labeler: Labeler,
    markers: Float[np.ndarray, "T M 3"],
    corruption: Corruption,
    *,
    rng: np.random.Generator,
) -> Report:
    """Corrupt, label, count.

    Args:
        labeler: What to measure.
        markers: True markers [m] in the labeler's order, NaN where missing.
        corruption: What is drawn on top.
        rng: Source of all randomness.
    """
    num_labels = len(labeler.marker_names)
    counts = LabelCounts()
    right_by_marker = np.zeros(num_labels)
    for first in range(0, len(markers), _CHUNK):
        cloud = corrupt(markers[first : first + _CHUNK], corruption, rng=rng)
        frames = [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]
        truths = [truth[here] for truth, here in zip(cloud.truth, cloud.present, strict=True)]
        for labelling, truth in zip(labeler.label_frames(frames), truths, strict=True):
            right_by_marker += counts.add(labelling.labels, truth, num_labels)
    return Report(counts.figures(), right_by_marker / max(1, len(markers)), len(markers))
