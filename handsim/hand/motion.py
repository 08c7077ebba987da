"""Motions of hands and of rigid objects: poses at a steady rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.shape import NUM_QPOS

_MOST_FRAMES: Final = 1 << 22
_STEADY: Final = 0.01  # of a frame, by which times may differ from those of a steady rate
_LONGEST_GAP: Final = 0.1  # [s] that a new frame may bridge,
_LONGEST_GAP_FRAMES: Final = 2.5  # or so many old frames


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
        return np.diff(self.qpos[:, 7:], axis=0) * self.rate


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
    """A motion from poses some of which (NaN), but not all, are missing: linear from pose to pose.

    The hand keeps its first pose before it, and its last pose after it.
    """
    from scipy.spatial.transform import Rotation, Slerp

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


def is_steady(times: Float[np.ndarray, "T"], rate: float) -> bool:
    """Whether frames come at a steady rate [Hz]."""
    drift = np.abs((times - times[0]) * rate - np.arange(len(times)))
    return bool((drift < _STEADY).all())


def times_at(times: Float[np.ndarray, "T"], rate: float) -> Float[np.ndarray, "K"]:
    """The times [s] of frames at another rate, from the first to the last.

    Args:
        times: Time of each frame [s], increasing.
    """
    if not 0.0 < rate < np.inf:
        raise ArgumentError(f"the rate is {rate:g} Hz, expected a positive number")
    last = (times[-1] - times[0]) * rate + _STEADY
    if last >= _MOST_FRAMES:
        raise ArgumentError(f"{last:.3g} frames at {rate:g} Hz, expected at most {_MOST_FRAMES}")
    at: NDArray[np.float64] = times[0] + np.arange(int(last) + 1) / rate
    return at


def between_poses(
    times: Float[np.ndarray, "T"], new: Float[np.ndarray, "K"], poses: Float[np.ndarray, "T H W"], rate: float
) -> Float[np.ndarray, "K H W"]:
    """Poses at other times: positions and angles linear, rotations on the shortest way.

    A pose is a position, a quaternion (wxyz), then angles, if any. There is none (NaN) where an old one
    beside it is missing, or where the old ones, whose rate is given, are more than a tenth of a second apart.
    """
    longest = max(_LONGEST_GAP, _LONGEST_GAP_FRAMES / rate)
    before, share = _brackets(times - times[0], new - times[0], longest)
    between = np.empty((len(new), *poses.shape[1:]))
    for number in range(poses.shape[1]):
        between[:, number] = _between(poses[:, number], before, share)
    return between


def _brackets(
    old: NDArray[np.float64], new: NDArray[np.float64], longest: float
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The old frame before each new time, and the share of the next one; NaN in a gap."""
    if len(old) == 1:
        return np.zeros(len(new), dtype=np.intp), np.zeros(len(new))
    before = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 2)
    step = old[before + 1] - old[before]
    share = np.clip((new - old[before]) / step, 0.0, 1.0)
    exact = (share < 1e-6) | (share > 1.0 - 1e-6)
    return before, np.where(exact, np.round(share), np.where(step > longest, np.nan, share))


def _between(
    rows: NDArray[np.float64], before: NDArray[np.intp], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rows between each old frame and the next; NaN where one that counts is."""
    from scipy.spatial.transform import Rotation

    quaternions = slice(3, 7)
    after = np.minimum(before + 1, len(rows) - 1)
    first = np.where(share[:, None] == 1.0, rows[after], rows[before])
    second = np.where(share[:, None] == 0.0, rows[before], rows[after])
    between: NDArray[np.float64] = first + share[:, None] * (second - first)
    there = np.isfinite(between[:, 0])
    starts = Rotation.from_quat(first[there, quaternions], scalar_first=True)
    ends = Rotation.from_quat(second[there, quaternions], scalar_first=True)
    turns = Rotation.from_rotvec(share[there, None] * (starts.inv() * ends).as_rotvec())
    between[there, quaternions] = (starts * turns).as_quat(scalar_first=True)
    between[~there] = np.nan
    return between
