"""What is sent of a tracked frame: names that never change, and numbers that do. Nothing here is a format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from gloves.takes.points import Status
from gloves.takes.take import label_names
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import JOINT_NAMES, Side
from track.bodies.rigid_body import RigidTemplate
from track.frames import TrackedFrame, TrackedHand
from track.streams.frame_source import StreamedFrame

SCHEMA: Final = 1
"""Version of what is sent; a receiver that knows it knows every later message of the same version."""


@dataclass(frozen=True, slots=True)
class LiveHeader:
    """The names of the numbers in every message of a stream."""

    sides: tuple[Side, ...]
    """The hands in their order."""
    angles: tuple[str, ...]
    """The joint angles."""
    positions: tuple[str, ...]
    """The joint positions: the wrist, and the joints and the tip of each digit."""
    bodies: tuple[str, ...]
    """The rigid bodies in their order."""
    markers: tuple[str, ...]
    """What a point's label counts through: `right:ThumbTip`, ..., the hands' markers before the bodies'."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveHand:
    """One hand; all numbers are NaN where it has no pose."""

    side: Side
    status: Status
    position: Float[np.ndarray, "3"]
    """Wrist position in the world [m]."""
    quaternion: Float[np.ndarray, "4"]
    """Wrist orientation in the world, wxyz."""
    angles: Float[np.ndarray, "20"]
    """Joint angles [rad]."""
    positions: Float[np.ndarray, "21 3"]
    """Joint positions in the world [m]."""
    angle_spread: Float[np.ndarray, "20"]
    """Standard deviation of each joint angle [rad]."""
    position_spread: Float[np.ndarray, "21"]
    """Standard deviation of each joint position in each direction [m]."""

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return self.status is not Status.LOST


@dataclass(frozen=True, slots=True, eq=False)
class LiveBody:
    """One rigid body; all numbers are NaN where it is lost."""

    name: str
    status: Status
    position: Float[np.ndarray, "3"]
    """Position in the world [m]."""
    quaternion: Float[np.ndarray, "4"]
    """Orientation in the world, wxyz."""

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return self.status is not Status.LOST


@dataclass(frozen=True, slots=True, eq=False)
class LiveMessage:
    """A tracked frame as it is sent."""

    header: LiveHeader
    """The same object in every message of a stream."""
    number: int
    """The frame's number; those of a stream may have gaps and may start again."""
    time: float
    """Time of the frame [s]; never runs back."""
    silent: bool
    """No frame arrives; this message says what has become of the hands until now."""
    hands: tuple[LiveHand, ...]
    bodies: tuple[LiveBody, ...]
    points: Float[np.ndarray, "N 3"]
    """All points of the frame [m]."""
    labels: Int[np.ndarray, "N"]
    """Marker of each point, an index into `header.markers`; -1 for none."""
    lag: float
    """Time from the frame's arrival on this machine to this message [s]; NaN where it did not come live."""


class LiveSink(Protocol):
    """Takes messages somewhere; a class of the user's own for `handsim track --send module:name`.

    Both methods are called by the tracker, which waits for them: `send` must not wait itself. A sink that
    raises is told and closed, and tracking goes on without it.
    """

    def send(self, message: LiveMessage) -> None:
        """Take a message: positions in [m], angles in [rad]."""
        ...

    def close(self) -> None:
        """No further message comes."""
        ...


class MessageEncoder:
    """Makes messages of the frames of one tracker."""

    def __init__(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        self._models = [hand.model for hand in hands]
        self.header = LiveHeader(
            tuple(hand.side for hand in hands),
            JOINT_NAMES,
            KEYPOINT_NAMES,
            tuple(body.name for body in bodies),
            label_names(hands, bodies),
        )
        """The names in its messages."""

    def encode(self, frame: StreamedFrame, tracked: TrackedFrame) -> LiveMessage:
        """The message of a frame.

        Args:
            frame: The frame, with the tracker's time.
            tracked: What the tracker made of it.
        """
        hands = tuple(self._hand(number, hand) for number, hand in enumerate(tracked.hands))
        bodies = tuple(
            LiveBody(body.name, body.status, body.translation, body.rotation) for body in tracked.bodies
        )
        return LiveMessage(
            self.header,
            frame.number,
            frame.time,
            frame.silent,
            hands,
            bodies,
            frame.points,
            tracked.labels,
            monotonic() - frame.arrived,
        )

    def _hand(self, number: int, hand: TrackedHand) -> LiveHand:
        positions = np.full((len(KEYPOINT_NAMES), 3), np.nan)
        if hand.has_pose:
            positions = hand_keypoints(self._models[number], hand.qpos[None])[0]
        wrist, angles = (hand.qpos[:3], hand.qpos[3:7]), hand.qpos[7:]
        spreads = hand.angle_spread, hand.keypoint_spread
        return LiveHand(hand.side, hand.status, *wrist, angles, positions, *spreads)
