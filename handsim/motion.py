"""A hand in motion: poses at a steady rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from handsim._checks import check_array
from handsim.errors import ShapeError
from handsim.topology import NUM_QPOS

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True, slots=True, eq=False)
class HandMotion:
    """Poses of one hand, frame by frame."""

    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), hinge angles [rad]."""
    rate: float
    """Frames a second [Hz]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "qpos", check_array("qpos", self.qpos, (None, NUM_QPOS)))
        if self.qpos.ndim != 2 or len(self.qpos) == 0:
            raise ShapeError(
                f"a motion needs frames: qpos has shape {self.qpos.shape}, wanted (T, {NUM_QPOS})"
            )
        if not 0.0 < self.rate < np.inf:
            raise ShapeError(f"the rate is {self.rate:g} Hz, wanted a positive number")

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.qpos) - 1) / self.rate

    def speeds(self) -> Float[np.ndarray, "S 20"]:
        """Hinge speeds between frames [rad/s]."""
        speeds: np.ndarray = np.diff(self.qpos[:, 7:], axis=0) * self.rate
        return speeds
