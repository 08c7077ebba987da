"""Conversion between a capture's columns and a glove's markers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture
from handsim.errors import CaptureError, choices

UNLABELED: Final = "Unlabeled"
"""Columns of points without a marker are called Unlabeled1, Unlabeled2, ..."""


def select_markers(capture: Capture, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The columns of the named markers, in their order; a subject's prefix ("Anna:ThumbTip") is ignored."""
    bare = [column.rsplit(":", 1)[-1].strip() for column in capture.names]
    for name in names:
        if name not in bare:
            raise CaptureError(
                f"the glove's marker is not among the columns: {choices(name, bare, noun='column')}"
            )
        if bare.count(name) > 1:
            raise CaptureError(f"marker '{name}' has {bare.count(name)} columns in the capture, expected one")
    return capture.positions[:, [bare.index(name) for name in names]]


def select_hands(capture: Capture, names: Sequence[str]) -> list[Float[np.ndarray, "T M 3"]]:
    """The named markers of every hand of a labeled capture, in their order.

    A capture of one hand has one column per marker, as `select_markers` takes it. One of two hands, as
    `handsim track` and `handsim label` write it, has a set of columns for each: "right:ThumbTip" and so on.
    Of such a set, the frames without a marker are left out: the hand was not there.
    """
    columns = [_split_name(column) for column in capture.names]
    sets = list(dict.fromkeys(prefix for prefix, name in columns if name in names))
    held = [name for _, name in columns if name in names]
    if len(sets) < 2 or len(held) == len(set(held)):
        return [select_markers(capture, names)]
    hands = []
    for prefix in sets:
        mine = [number for number, (other, _) in enumerate(columns) if other == prefix]
        part = Capture(tuple(columns[number][1] for number in mine), capture.positions[:, mine], capture.rate)
        try:
            markers = select_markers(part, names)
        except CaptureError as error:
            raise CaptureError(f"columns '{prefix}:...': {error}") from error
        hands.append(markers[np.isfinite(markers[..., 0]).any(axis=1)])
    return hands


def _split_name(column: str) -> tuple[str, str]:
    """What is before the last colon of a column's name, and what is behind it."""
    prefix, _, name = column.rpartition(":")
    return prefix.strip(), name.strip()


def unlabeled_frames(capture: Capture) -> list[Float[np.ndarray, "N 3"]]:
    """The points of every frame [m] without their labels; an empty frame is (0, 3)."""
    there = np.isfinite(capture.positions).all(axis=-1)
    return [points[seen] for points, seen in zip(capture.positions, there, strict=True)]


def labeled_columns(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    labels: Sequence[Int[np.ndarray, "N"]],
    names: Sequence[str],
    rate: float,
) -> Capture:
    """Labeled points as a capture: one column per marker, then columns for the points without one.

    Args:
        labels: Marker of every point, -1 for none.
        names: Marker names in label order.
    """
    extra = max((int((label < 0).sum()) for label in labels), default=0)
    positions = np.full((len(frames), len(names) + extra, 3), np.nan)
    for frame, (points, label) in enumerate(zip(frames, labels, strict=True)):
        column = label.copy()
        column[label < 0] = len(names) + np.arange((label < 0).sum())
        positions[frame, column] = points
    columns = [*names, *(f"{UNLABELED}{number + 1}" for number in range(extra))]
    return Capture(tuple(columns), positions, rate)
