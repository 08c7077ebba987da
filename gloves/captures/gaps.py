"""Gaps of a capture, counted as in Table 3 of Han et al. 2018, and per marker."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int


class GapCounts(NamedTuple):
    """One row of Table 3."""

    frames: int
    gaps: int
    """Stretches of frames in each of which at least one marker is missing."""
    average_length: float
    """Average gap length (AGL) [frames]; NaN without gaps."""
    average_missing: float
    """Average missing markers (AMF) of the frames that miss any; NaN without gaps."""


def count_gaps(present: Bool[np.ndarray, "T M"]) -> GapCounts:
    """Table 3's figures of a capture with M expected markers."""
    missing = ~present
    lacking = np.any(missing, axis=1)
    lengths = run_lengths(lacking[:, None])
    gaps = len(lengths)
    return GapCounts(
        frames=len(present),
        gaps=gaps,
        average_length=float(lengths.mean()) if gaps else float("nan"),
        average_missing=float(missing.sum() / lacking.sum()) if gaps else float("nan"),
    )


def run_lengths(flags: Bool[np.ndarray, "T M"], *, inside: bool = False) -> Int[np.ndarray, "G"]:
    """Lengths of all unbroken stretches of True, column by column [frames].

    Args:
        flags: For instance, where markers are missing.
        inside: Leave out stretches that touch the first or the last frame: their true length is unknown.
    """
    padded = np.zeros((len(flags) + 2, flags.shape[1]), dtype=np.int8)
    padded[1:-1] = flags
    steps = np.diff(padded, axis=0).T
    begins, ends = np.nonzero(steps == 1)[1], np.nonzero(steps == -1)[1]
    lengths: np.ndarray = ends - begins
    return lengths[(begins > 0) & (ends < len(flags))] if inside else lengths
