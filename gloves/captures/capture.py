"""The content of a marker file: named trajectories at a frame rate, and their gaps.

Gaps are counted as in Table 3 of Han et al. 2018, and per marker.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.frame_times import check_rate
from handsim.errors import CaptureError


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Trajectories of a marker file: at least one frame and one trajectory.

    Raises:
        CaptureError: The arrays do not fit together, a position is infinite, or the rate is not from 1 to
            5,000 Hz.
    """

    names: tuple[str, ...]
    """One name per trajectory, never empty; it need not name a marker ("*12", "Unlabeled 2379")."""
    positions: Float[np.ndarray, "T N 3"]
    """Positions [m] in the file's axes; NaN, always in all three coordinates, where a marker was not seen."""
    rate: float
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)  # a copy: the next lines change it
        if positions.ndim != 3 or positions.shape[1:] != (len(self.names), 3):
            raise CaptureError(
                f"positions have shape {positions.shape}, expected (T, {len(self.names)}, 3) for "
                f"{len(self.names)} names"
            )
        if 0 in positions.shape:
            raise CaptureError(
                f"a capture needs at least one frame and one marker, got {len(positions)} frames of "
                f"{len(self.names)} markers"
            )
        if np.isinf(positions).any():
            raise CaptureError("positions hold infinite values, expected finite numbers or NaN")
        check_rate(self.rate)
        positions[np.isnan(positions).any(axis=-1)] = np.nan  # two coordinates do not make a point
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "rate", float(self.rate))

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.positions)


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


def runs_of(flags: Bool[np.ndarray, "T"]) -> list[tuple[int, int]]:
    """The first and the last frame of each unbroken stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]
