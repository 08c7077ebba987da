"""Conversion between a capture's columns and a glove's markers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.captures.capture import Capture
from handsim.errors import CaptureError, choices

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, Int

UNLABELED: Final = "Unlabeled"
"""Columns of points without a marker are called Unlabeled1, Unlabeled2, ..."""


def select_markers(capture: Capture, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The columns of the named markers, in their order; a subject's prefix ("Anna:ThumbTip") is ignored.

    Raises:
        CaptureError: A marker is not among the columns, or is among them twice.
    """
    bare = [column.rsplit(":", 1)[-1].strip() for column in capture.names]
    for name in names:
        if name not in bare:
            raise CaptureError(
                f"the glove's marker is not among the columns: {choices(name, bare, noun='column')}"
            )
        if bare.count(name) > 1:
            raise CaptureError(f"marker '{name}' has {bare.count(name)} columns in the capture, expected one")
    return capture.positions[:, [bare.index(name) for name in names]]


def unlabeled_frames(capture: Capture) -> list[Float[np.ndarray, "N 3"]]:
    """The points of every frame [m] without their labels; an empty frame is (0, 3)."""
    there = np.isfinite(capture.positions).all(axis=-1)
    return [points[seen] for points, seen in zip(capture.positions, there, strict=True)]


def labeled_capture(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    labels: Sequence[Int[np.ndarray, "N"]],
    names: Sequence[str],
    rate: float,
) -> Capture:
    """Labeled points as a capture: one column per marker, then columns for the points without one.

    Args:
        frames: Points of every frame [m].
        labels: Marker of every point, -1 for none.
        names: Marker names in label order.
        rate: Frames per second [Hz].
    """
    extra = max((int((label < 0).sum()) for label in labels), default=0)
    positions = np.full((len(frames), len(names) + extra, 3), np.nan)
    for frame, (points, label) in enumerate(zip(frames, labels, strict=True)):
        column = label.copy()
        column[label < 0] = len(names) + np.arange((label < 0).sum())
        positions[frame, column] = points
    columns = [*names, *(f"{UNLABELED}{number + 1}" for number in range(extra))]
    return Capture(tuple(columns), positions, rate)
