"""Motions of hands and of rigid objects: poses at a steady rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.topology import NUM_QPOS


@dataclass(frozen=True, slots=True, eq=False)
class HandMotion:
    """Poses of one hand, frame by frame.

    Raises:
        ArgumentError: `qpos` is not (T, 27), empty or not finite, or the rate is not positive.
    """

    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]."""
    rate: float
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "qpos", check_array("qpos", self.qpos, (None, NUM_QPOS)))
        if self.qpos.ndim != 2 or len(self.qpos) == 0:
            raise ArgumentError(
                f"a motion needs frames: qpos has shape {self.qpos.shape}, expected (T, {NUM_QPOS})"
            )
        if not 0.0 < self.rate < np.inf:
            raise ArgumentError(f"the rate is {self.rate:g} Hz, expected a positive number")

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.qpos) - 1) / self.rate

    def speeds(self) -> Float[np.ndarray, "S 20"]:
        """Joint speeds between frames [rad/s]."""
        speeds: np.ndarray = np.diff(self.qpos[:, 7:], axis=0) * self.rate
        return speeds


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """Poses of one rigid object, frame by frame.

    Raises:
        ArgumentError: `T_world_body` is not (T, 4, 4), empty or not rigid, or the rate is not positive.
    """

    T_world_body: Float[np.ndarray, "T 4 4"]
    """The object's frame seen from the world [m]."""
    rate: float
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_body", check_array("T_world_body", self.T_world_body, (None, 4, 4)))
        if self.T_world_body.ndim != 3 or len(self.T_world_body) == 0:
            raise ArgumentError(
                f"a motion needs frames: T_world_body has shape {self.T_world_body.shape}, expected (T, 4, 4)"
            )
        rotations = self.T_world_body[:, :3, :3]
        square = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max()
        last_row = np.abs(self.T_world_body[:, 3] - np.eye(4)[3]).max()
        if max(square, last_row) > 1e-5 or not (np.linalg.det(rotations) > 0.0).all():
            raise ArgumentError("T_world_body is not rigid transforms, expected rotations and positions")
        if not 0.0 < self.rate < np.inf:
            raise ArgumentError(f"the rate is {self.rate:g} Hz, expected a positive number")

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.T_world_body) - 1) / self.rate


def bridge_gaps(times: Float[np.ndarray, "T"], qpos: Float[np.ndarray, "T 27"], rate: float) -> HandMotion:
    """A motion from poses some of which are missing: linear from the pose before to the pose after.

    The hand keeps its first pose before it, and its last pose after it.

    Args:
        times: Time of each pose [s], increasing.
        qpos: Poses, NaN where there is none; at least one must be there.
        rate: Frames per second of the motion [Hz].
    """
    there = np.flatnonzero(np.isfinite(qpos[:, 0]))
    known = times[there]
    asked = np.clip(times, known[0], known[-1])
    bridged = np.empty_like(qpos)
    for column in (*range(3), *range(7, NUM_QPOS)):
        bridged[:, column] = np.interp(asked, known, qpos[there, column])
    rotations = Rotation.from_quat(qpos[there, 3:7], scalar_first=True)
    bridged[:, 3:7] = (Slerp(known, rotations)(asked) if len(known) > 1 else rotations).as_quat(
        scalar_first=True
    )
    bridged[there] = qpos[there]
    return HandMotion(bridged, rate)
