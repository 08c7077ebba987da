"""`HandsInMotion`: hands and rigid things over time, the one source of all motion files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.errors import ArgumentError
from handsim.hand.model import HandModel
from handsim.hand.topology import NUM_QPOS, Side
from handsim.space.objects import RigidObject
from handsim.space.transforms import quaternion_matrix, rotation_quaternions

UpAxis = Literal["y", "z"]
_MOST_FRAMES: Final = 1 << 22
_STEADY: Final = 0.01  # of a frame, by which times may differ from those of a steady rate
_LONGEST_GAP: Final = 0.1  # [s] that a new frame may bridge,
_LONGEST_GAP_FRAMES: Final = 2.5  # or so many old frames


@dataclass(frozen=True, slots=True, eq=False)
class MovingHand:
    """A hand and its poses."""

    model: HandModel
    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN in frames without a pose."""

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.model.shape.side

    @property
    def present(self) -> Bool[np.ndarray, "T"]:
        """The frames with a pose."""
        present: NDArray[np.bool_] = np.isfinite(self.qpos[:, 0])
        return present

    @property
    def held_qpos(self) -> Float[np.ndarray, "T 27"]:
        """The poses [m, rad]; without one the last pose, and before the first one that."""
        return _held(self.qpos, self.present)


@dataclass(frozen=True, slots=True, eq=False)
class MovingThing:
    """A rigid thing and its poses."""

    name: str
    shape: RigidObject | None
    """Its surface; None where only its poses are known."""
    T_world_thing: Float[np.ndarray, "T 4 4"]
    """Its frame seen from the world [m]; NaN in frames without a pose."""

    @property
    def present(self) -> Bool[np.ndarray, "T"]:
        """The frames with a pose."""
        present: NDArray[np.bool_] = np.isfinite(self.T_world_thing[:, 0, 0])
        return present

    @property
    def held_poses(self) -> Float[np.ndarray, "T 4 4"]:
        """The poses [m]; without one the last pose, and before the first one that."""
        return _held(self.T_world_thing, self.present)


@dataclass(frozen=True, slots=True, eq=False)
class HandsInMotion:
    """Hands and rigid things, frame by frame.

    Raises:
        ArgumentError: There is no hand or no frame, two hands are of one side, an array has another shape, a
            hand or a thing has no pose in any frame, or times do not increase.
    """

    rate: float
    """Frames per second [Hz]; of a stream, the usual one."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s], increasing."""
    hands: tuple[MovingHand, ...]
    things: tuple[MovingThing, ...] = ()
    up: UpAxis = "z"
    """The axis of the world that points up."""

    def __post_init__(self) -> None:
        frames, sides = len(self.times), [hand.side for hand in self.hands]
        if not frames or not sides or len(set(sides)) < len(sides):
            raise ArgumentError(
                f"{frames} frames of the hands {sides}, expected frames and one hand per side"
            )
        for name, array, shape in (
            *((f"the {hand.side} hand's qpos", hand.qpos, (frames, NUM_QPOS)) for hand in self.hands),
            *((f"T_world_thing of {one.name}", one.T_world_thing, (frames, 4, 4)) for one in self.things),
        ):
            if array.shape != shape:
                raise ArgumentError(f"{name} has shape {array.shape}, expected {shape}")
        for name, present in (
            *((f"the {hand.side} hand", hand.present) for hand in self.hands),
            *((thing.name, thing.present) for thing in self.things),
        ):
            if not present.any():
                raise ArgumentError(f"{name} has no pose in any frame, expected one at least")
        if not 0.0 < self.rate < np.inf or not (np.diff(self.times) > 0.0).all():
            raise ArgumentError("the rate is not positive or times do not increase, expected both")

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @property
    def seconds(self) -> Float[np.ndarray, "T"]:
        """Time since the first frame [s]."""
        seconds: NDArray[np.float64] = self.times - self.times[0]
        return seconds

    @property
    def R_file_world(self) -> Float[np.ndarray, "3 3"]:
        """Turns the world into axes with y up, as glTF, BVH and OpenXR have them; x stays."""
        if self.up == "y":
            return np.eye(3)
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

    def steady(self) -> HandsInMotion:
        """The same frames where they come at the steady rate, else frames at that rate."""
        drift = np.abs(self.seconds * self.rate - np.arange(self.num_frames))
        return self if (drift < _STEADY).all() else self.resampled(self.rate)

    def resampled(self, rate: float) -> HandsInMotion:
        """The motion at another rate: positions and angles linear, rotations on the shortest way.

        A new frame has no pose where an old one beside it has none, or where the old ones are more than a
        tenth of a second apart.

        Args:
            rate: Frames per second [Hz].

        Raises:
            ArgumentError: The rate is not positive, or there would be too many frames.
        """
        if not 0.0 < rate < np.inf:
            raise ArgumentError(f"the rate is {rate:g} Hz, expected a positive number")
        last = self.seconds[-1] * rate + _STEADY
        if last >= _MOST_FRAMES:
            raise ArgumentError(f"{last:.3g} frames at {rate:g} Hz, expected at most {_MOST_FRAMES}")
        seconds = np.arange(int(last) + 1) / rate
        before, share = _brackets(self.seconds, seconds, max(_LONGEST_GAP, _LONGEST_GAP_FRAMES / self.rate))
        hands = tuple(
            MovingHand(hand.model, _between(hand.qpos, before, share, slice(3, 7))) for hand in self.hands
        )
        things = tuple(
            MovingThing(one.name, one.shape, _poses_between(one.T_world_thing, before, share))
            for one in self.things
        )
        return dataclasses.replace(
            self,
            rate=rate,
            times=self.times[0] + seconds,
            hands=tuple(hand for hand in hands if hand.present.any()),
            things=tuple(thing for thing in things if thing.present.any()),
        )


def changes(present: Bool[np.ndarray, "T"]) -> Int[np.ndarray, "K"]:
    """The first frame, and every frame from which on something appears or disappears."""
    indices: NDArray[np.intp] = np.flatnonzero(np.diff(present, prepend=not present[0]))
    return indices


def _held(values: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rows, with the last row that is present in the place of each that is not."""
    last = np.maximum.accumulate(np.where(present, np.arange(len(present)), -1))
    held: NDArray[np.float64] = values[np.where(last < 0, np.argmax(present), last)]
    return held


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
    rows: NDArray[np.float64], before: NDArray[np.intp], share: NDArray[np.float64], quaternions: slice
) -> NDArray[np.float64]:
    """Rows between each old frame and the next; NaN where one that counts is."""
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


def _poses_between(
    poses: NDArray[np.float64], before: NDArray[np.intp], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Transforms between each old frame and the next; NaN where one that counts is."""
    rows, there = np.full((len(poses), 7), np.nan), np.isfinite(poses[:, 0, 0])
    rows[there, :3], rows[there, 3:] = poses[there, :3, 3], rotation_quaternions(poses[there, :3, :3])
    between = _between(rows, before, share, slice(3, 7))
    result, there = np.full((len(between), 4, 4), np.nan), np.isfinite(between[:, 0])
    result[there] = np.eye(4)
    result[there, :3, :3], result[there, :3, 3] = quaternion_matrix(between[there, 3:]), between[there, :3]
    return result
