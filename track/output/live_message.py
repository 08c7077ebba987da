"""Messages on tracked frames for other programs, and their documents; see docs/live_output.md."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from gloves.takes.points import Status
from gloves.takes.take import label_names
from handsim import __version__
from handsim._plugins import import_extra
from handsim.arrays import Doubles
from handsim.hand.angles import WRIST_NAMES, wrist_angles
from handsim.hand.model import KEYPOINT_NAMES, HandModel, hand_keypoints
from handsim.hand.shape import DIGITS, JOINT_NAMES, Side
from handsim.kernels import move
from handsim.motion_files.motion import OPENXR_JOINTS, joint_poses, joint_radii
from handsim.space.transforms import ProgramAxes, UpAxis, program_axes, quaternion_matrix, transform_poses
from track.bodies.rigid_body import RigidTemplate
from track.frames import StreamedFrame, TrackedBody, TrackedFrame, TrackedHand

SCHEMA: Final = 1
"""Version of the messages; a receiver of a version understands all later messages of that version."""
FORMATS: Final = ("json", "msgpack")
WORLD: Final = "world"
"""The axes of the camera system."""
LARGEST_DATAGRAM: Final = 1400
"""Largest size of a datagram that usual networks carry in one packet [bytes]."""
_DECIMALS: Final = 6  # decimals of numbers, which resolve micrometers and microradians
_VELOCITY_STEP: Final = 1e-3  # [s] Velocities are differences of poses this far apart in time.
# These entries of a hand are sent in the same part.
_POSE_ENTRIES: Final = ("side", "status", "seen", "digits", "wrist", "angles", "positions")
_HALF_JOINTS: Final = len(OPENXR_JOINTS) // 2
_HINT: Final = "a client of the path /newest gets the newest frame for each message that it sends"


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
    digits: tuple[str, ...]
    """The digits, from the thumb."""
    markers: tuple[str, ...]
    """Marker names that labels index: `right:ThumbTip`, ..., first the hands' markers, then the bodies'."""
    radii: tuple[tuple[float, ...], ...]
    """Radius of each hand at each of OpenXR's joints [m]."""
    wrist_angles: tuple[str, ...] = ()
    """The angles of wrists and forearms; none without a forearm whose axes are known."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveHand:
    """One hand; all numbers are NaN if it has no pose."""

    side: Side
    status: Status
    seen: float
    """Share of the hand's markers that were seen in the frame, from 0 to 1."""
    digits: tuple[Status, ...]
    """Status of each digit: coasting where none of its markers was seen, otherwise that of the hand."""
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
    angle_velocities: Float[np.ndarray, "20"]
    """Angular velocity of each joint [rad/s]; NaN where unknown."""
    find_velocities: Callable[[], Float[np.ndarray, "21 3"]] = field(repr=False)
    """Computes the velocity of each joint position in the world [m/s]; NaN where unknown."""
    find_joints: Callable[[], Float[np.ndarray, "26 7"]] = field(repr=False)
    """Computes positions [m] and wxyz quaternions of OpenXR's joints in the world; for a hand with a pose."""
    wrist_angles: Float[np.ndarray, "W"] = field(default_factory=lambda: np.empty(0))
    """The header's angles of wrist and forearm [rad]; each NaN while a body that it needs is lost."""

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return self.status is not Status.LOST


@dataclass(frozen=True, slots=True, eq=False)
class LiveBody:
    """One rigid body; all numbers are NaN if it is lost."""

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
    """Description of the stream: one object for all messages until the size of its hands changes."""
    number: int
    """Frame number; numbers of a stream may have gaps and may start again."""
    time: float
    """Time of the frame [s]; never goes back."""
    silent: bool
    """Whether no frame has arrived for a while; the message then holds the hands' state until now."""
    size_state: str
    """Why the hands are not measured yet, in words; empty if they are, or need not be."""
    hands: tuple[LiveHand, ...]
    bodies: tuple[LiveBody, ...]
    points: Float[np.ndarray, "N 3"]
    """All points of the frame [m]."""
    labels: Int[np.ndarray, "N"]
    """Index of each point's marker in `header.markers`; -1 for none."""
    lag: float
    """Time from the frame's arrival on this machine to this message [s]; NaN if it is not live."""
    latency: float
    """Time from the middle of the frame's exposure to this message [s]; NaN where unknown."""


class LiveSink(Protocol):
    """A destination of messages; also a class of the user's own for `handsim track --send module:name`.

    The tracker calls both methods and waits for them, so `send` must not wait itself. A sink that raises is
    closed with a warning, and tracking goes on without it.
    """

    def send(self, message: LiveMessage) -> None:
        """Receive a message: positions in [m], angles in [rad]."""
        ...

    def close(self) -> None:
        """Called once, after the last message."""
        ...


class MessageEncoder:
    """Encodes the frames of one tracker as messages."""

    def __init__(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        self._models = [hand.model for hand in hands]
        self._digits = [hand.attachment.digits for hand in hands]
        self._limbs = [body.limb if body.elbow or body.has_axes else {} for body in bodies]
        parts = {part for limb in self._limbs for part in limb}
        num_angles = len(WRIST_NAMES) if "elbow" in parts else len(WRIST_NAMES) - 1
        self.header = LiveHeader(
            tuple(hand.side for hand in hands),
            JOINT_NAMES,
            KEYPOINT_NAMES,
            tuple(body.name for body in bodies),
            DIGITS,
            label_names(hands, bodies),
            tuple(tuple(joint_radii(hand.model).tolist()) for hand in hands),
            WRIST_NAMES[:num_angles] if "forearm" in parts else (),
        )

    def encode(self, frame: StreamedFrame, tracked: TrackedFrame) -> LiveMessage:
        """Make the message on a frame."""
        lag = monotonic() - frame.arrived
        return LiveMessage(
            header=self.header,
            number=frame.number,
            time=frame.time,
            silent=frame.silent,
            size_state=tracked.size_state,
            hands=tuple(
                self._hand(number, hand, tracked.bodies) for number, hand in enumerate(tracked.hands)
            ),
            bodies=tuple(
                LiveBody(one.name, one.status, one.translation, one.rotation) for one in tracked.bodies
            ),
            points=frame.points,
            labels=tracked.labels,
            lag=lag,
            latency=frame.latency + lag,
        )

    def _hand(self, number: int, hand: TrackedHand, bodies: Sequence[TrackedBody]) -> LiveHand:
        positions = np.full((len(KEYPOINT_NAMES), 3), np.nan)
        if hand.has_pose:
            positions = hand_keypoints(self._models[number], hand.qpos[None])[0]
        pose = hand.qpos[:3], hand.qpos[3:7], hand.qpos[7:], positions
        spreads = hand.angle_spread, hand.keypoint_spread
        velocities = functools.partial(_velocities, self._models[number], hand)
        joints = functools.partial(_openxr_joints, self._models[number], hand.qpos)
        seen = np.full(len(self._digits[number]), hand.has_pose)
        seen[hand.filled] = False
        shown, unseen = set(self._digits[number][seen].tolist()), min(hand.status, Status.COASTING)
        digits = tuple(hand.status if digit in shown else unseen for digit in range(len(DIGITS)))
        doubt = float(seen.mean()), digits
        wrist = self._wrist_angles(hand, bodies)
        return LiveHand(
            hand.side, hand.status, *doubt, *pose, *spreads, hand.velocity[6:], velocities, joints, wrist
        )

    def _wrist_angles(self, hand: TrackedHand, bodies: Sequence[TrackedBody]) -> Float[np.ndarray, "W"]:
        if not self.header.wrist_angles:
            return np.empty(0)
        rotations = {"hand": hand.qpos[3:7], "forearm": np.full(4, np.nan), "elbow": np.full(4, np.nan)}
        for limb, body in zip(self._limbs, bodies, strict=True):
            rotations |= {part: body.rotation for part, side in limb.items() if side == hand.side}
        own, forearm, elbow = quaternion_matrix(np.stack([*rotations.values()]))[:, None]
        found = wrist_angles(hand.side, forearm.swapaxes(1, 2) @ own, elbow.swapaxes(1, 2) @ forearm)
        return np.asarray(found[0, : len(self.header.wrist_angles)])


def _velocities(model: HandModel, hand: TrackedHand) -> Float[np.ndarray, "21 3"]:
    if np.isnan(hand.velocity).any():
        return np.full((len(KEYPOINT_NAMES), 3), np.nan)
    steps = np.outer([-0.5 * _VELOCITY_STEP, 0.5 * _VELOCITY_STEP], hand.velocity)
    before, after = hand_keypoints(model, move(np.stack([hand.qpos] * 2), steps))
    return np.asarray((after - before) / _VELOCITY_STEP)


def _openxr_joints(model: HandModel, qpos: Float[np.ndarray, "27"]) -> Float[np.ndarray, "26 7"]:
    return transform_poses(joint_poses(model, qpos[None])[0])


_Placed = TypeVar("_Placed", LiveHand, LiveBody)


def in_axes(message: LiveMessage, axes: ProgramAxes) -> LiveMessage:
    """Convert positions, orientations and points of a message to a program's axes and unit."""

    def turned(poses: Float[np.ndarray, "K 7"]) -> Doubles:
        return np.concatenate([axes.positions(poses[:, :3]), axes.quaternions(poses[:, 3:])], axis=1)

    def placed(thing: _Placed) -> _Placed:
        place = axes.positions(thing.position), axes.quaternions(thing.quaternion)
        return dataclasses.replace(thing, position=place[0], quaternion=place[1])

    hands = (
        dataclasses.replace(
            placed(hand),
            positions=axes.positions(hand.positions),
            position_spread=axes.scale * hand.position_spread,
            find_velocities=functools.partial(lambda one: axes.positions(one.find_velocities()), hand),
            find_joints=functools.partial(lambda one: turned(one.find_joints()), hand),
        )
        for hand in message.hands
    )
    bodies, points = tuple(map(placed, message.bodies)), axes.positions(message.points)
    return dataclasses.replace(message, hands=tuple(hands), bodies=bodies, points=points)


class MessageFormat(NamedTuple):
    """Conversion of messages to bytes, each one or several datagrams."""

    header: Callable[[LiveHeader], list[bytes]]
    frame: Callable[[LiveMessage], list[bytes]]
    end: Callable[[], list[bytes]]
    lag: Callable[[float, int], bytes] = lambda lag, dropped: b""
    """Encodes a client's lag [s] and the number of frames that it missed."""
    is_text: bool = False


class Content(NamedTuple):
    """Optional contents of messages, and their axes."""

    points: bool = False
    """All points and their labels."""
    joints: bool = False
    """OpenXR's 26 joints of each hand."""
    velocities: bool = False
    """Velocities of joint angles and positions."""
    axes: str = WORLD
    """Program whose axes and unit are used, one of `PROGRAMS`, or `WORLD`, the axes of the camera system."""
    up: UpAxis = "z"
    """The axis of the camera system that points up."""
    unit: str = "auto"
    """Unit of length, m or cm; auto is the program's."""
    forward: str = "x"
    """The axis of the cameras' coordinates that points forward in the room, one of `FORWARD`."""

    @property
    def program(self) -> ProgramAxes | None:
        """The program's axes; None for those of the camera system in meters."""
        if self.axes == WORLD:
            return program_axes("ros", "z", self.unit) if self.unit == "cm" else None
        return program_axes(self.axes, self.up, self.unit, forward=self.forward)


def document_format(
    name: str,
    content: Content = Content(),  # noqa: B008 (immutable)
    *,
    largest: float = math.inf,
) -> MessageFormat:
    """Messages as documents in one of `FORMATS`, divided into parts of at most `largest` bytes."""
    encode: Callable[[dict[str, Any]], bytes]
    if name == "msgpack":
        encode = import_extra("msgpack", f"format={name}", "send").Packer().pack
    else:
        as_text = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode

        def encode(document: dict[str, Any]) -> bytes:
            return as_text(document).encode()

    return MessageFormat(
        lambda header: _encode_parts(header_document(header, content), encode, largest),
        lambda message: _encode_parts(frame_document(message, content), encode, largest),
        lambda: [encode({"type": "end", "schema": SCHEMA})],
        lambda lag, count: encode(
            {"type": "lag", "schema": SCHEMA, "lag": _seconds(lag), "dropped": count, "hint": _HINT}
        ),
        is_text=name == "json",
    )


def _encode_parts(document: dict[str, Any], encode: Callable[[Any], bytes], largest: float) -> list[bytes]:
    """Encode a document; split its lists among several parts if it is too large, see docs/live_output.md."""
    whole = encode(document)
    if len(whole) <= largest:
        return [whole]
    alike = {name: value for name, value in document.items() if not isinstance(value, list)}
    parts: list[dict[str, Any]] = [{}]
    room = 0.0
    for name in (name for name in document if name not in alike):
        for item in _split_hands(document[name]) if name == "hands" else document[name]:
            needed = len(encode({name: [item]} if name not in parts[-1] else [item]))
            if needed > room:
                parts.append({**alike, "part": len(parts), "parts": len("???")})
                room = largest - len(encode(parts[-1])) - len("???")
                needed = len(encode({name: [item]}))
            parts[-1].setdefault(name, []).append(item)
            room -= needed
    return [encode({**part, "parts": len(parts) - 1}) for part in parts[1:]]


def _split_hands(hands: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the poses of hands, then each other entry by itself, with OpenXR's joints in two halves."""
    for hand in hands:
        yield {name: hand[name] for name in _POSE_ENTRIES}
    for hand in hands:
        whose = {name: hand[name] for name in _POSE_ENTRIES[:2]}
        for name in [name for name in hand if name not in _POSE_ENTRIES]:
            halves = name == "joints" and hand[name] is not None
            for value in (hand[name][:_HALF_JOINTS], hand[name][_HALF_JOINTS:]) if halves else (hand[name],):
                yield {**whose, name: value}


def header_document(header: LiveHeader, content: Content = Content()) -> dict[str, Any]:  # noqa: B008
    """The names and units of all numbers in frames."""
    scale, unit = (1.0, "m") if content.program is None else (content.program.scale, content.program.unit)
    names = dataclasses.asdict(header)
    radii = [[round(scale * radius, _DECIMALS) for radius in hand] for hand in names.pop("radii")]
    return {
        "type": "header",
        "schema": SCHEMA,
        "source": f"handsim {__version__}",
        "axes": content.axes,
        "units": {"length": unit, "angle": "rad", "time": "s", "quaternion": "wxyz"},
        **{name: list(values) for name, values in names.items() if values or name != "wrist_angles"},
        **({"joints": list(OPENXR_JOINTS), "radii": radii} if content.joints else {}),
    }


def frame_document(message: LiveMessage, content: Content = Content()) -> dict[str, Any]:  # noqa: B008
    """A frame as a document, with null for NaN."""
    if content.program is not None:
        message = in_axes(message, content.program)
    document = {
        "type": "frame",
        "schema": SCHEMA,
        "number": int(message.number),
        "time": float(message.time),
        "silent": message.silent,
        "size_state": message.size_state,
        "lag": _seconds(message.lag),
        "latency": _seconds(message.latency),
        "hands": [_hand_document(hand, content) for hand in message.hands],
        "bodies": [
            {"name": body.name, "status": str(body.status), "pose": _pose(body)} for body in message.bodies
        ],
    }
    if content.points:
        document |= {"points": _rounded(message.points), "labels": message.labels.tolist()}
    return document


def _hand_document(hand: LiveHand, content: Content) -> dict[str, Any]:
    more = {"joints": _rounded(hand.find_joints()) if hand.has_pose else None} if content.joints else {}
    others = {"angle_spread": hand.angle_spread, "position_spread": hand.position_spread}
    if content.velocities:
        others |= {"angle_velocities": hand.angle_velocities, "velocities": hand.find_velocities()}
    if len(hand.wrist_angles):
        more["wrist_angles"] = [None if np.isnan(one) else _rounded(one) for one in hand.wrist_angles]
    return {
        "side": hand.side,
        "status": str(hand.status),
        "seen": round(hand.seen, 3),
        "digits": [str(status) for status in hand.digits],
        "wrist": _pose(hand),
        "angles": _rounded(hand.angles) if hand.has_pose else None,
        "positions": _rounded(hand.positions) if hand.has_pose else None,
        **{name: None if np.isnan(values).any() else _rounded(values) for name, values in others.items()},
        **more,
    }


def _pose(thing: LiveHand | LiveBody) -> dict[str, Any] | None:
    pose = {"position": _rounded(thing.position), "quaternion": _rounded(thing.quaternion)}
    return pose if thing.has_pose else None


def _seconds(seconds: float) -> float | None:
    return None if math.isnan(seconds) else round(seconds, _DECIMALS)


def _rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Rounded numbers as nested lists."""
    return np.round(values, _DECIMALS).tolist()
