"""The content of a marker file: named trajectories at a frame rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
