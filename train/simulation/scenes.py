"""Scenes in motion: people in gloves, objects that they hold, and motions of each kind of capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gloves.fit import GlovedHand, GloveFit, forearm_markers
from gloves.layout import MarkerLayout
from gloves.takes.bodies import RigidBody
from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import BodyMotion, HandModel, HandMotion, join_qpos
from handsim.hand.shape import EVERYBODY, NUM_JOINTS, SIDES
from handsim.settings import Limits, Settings
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices
from poses.motion import (
    RATE,
    MotionConfig,
    angles_through,
    can_be_left,
    count_frames,
    sample_motion,
    scripted_motion,
    wrist_path,
)
from poses.object_motion import keep_apart, point_pen, pointing_path, sample_object_motion
from poses.shapes import gesture, make_valid
from poses.touch import FINGERS, touching_angles
from poses.two_hands import sample_two_hand_motion
from train.simulation.training_frames import (
    GenerateSettings,
    MovingObject,
    move_skin,
    sample_hands,
    wear_gloves,
)

Kind = Literal["single-hand", "hand-hand", "hand-pen", "hand-controller"]
"""A kind of capture: what the hands do (section 5 of Han et al. 2018)."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
SimulatedKind = Literal[
    "single-hand", "hand-hand", "hand-pen", "hand-controller", "real-like", "calibration", "free"
]
"""The paper's kinds, realistic hands, the exercises for a user's calibration, and freely moving hands."""
SIMULATED_KINDS: Final[tuple[SimulatedKind, ...]] = get_args(SimulatedKind)

_HAND_OFFSET: Final = 0.22  # [m] distance of a hand that touches nothing from the center of the room
_VOLUME: Final = 0.1  # [m] half side of the cube around the wrist of such a hand
_RETREAT_DIRECTION: Final = np.array([1.0, 0.0, 0.0])  # in which the right hand avoids the left
_WRIST_ROTATION: Final = 0.5  # [rad] standard deviation about each axis
_FREE_SCRIPT, _RESTING_SCRIPT = "piano", "typing"

# A calibration capture.
_MAX_DRAWS: Final = 20
_TOUCH_GESTURES: Final = ("pinch_pad", "pinch_tip")  # gestures before touches
_WRIST_TURNING: Final = 0.7  # [rad] standard deviation of a calibrated wrist's turns about each axis
_JITTER: Final = np.deg2rad(8.0)  # [rad] standard deviation of these gestures' joint angles
_TOUCHING: Final = MotionConfig(durations=(0.4, 0.8), hold=0.8)
_FREE: Final = MotionConfig(durations=(0.3, 0.9), hold=0.2)

# Realistic hands, after the published captures of Han et al. 2018 (docs/room.md): no pose of our hand model
# comes closer to the markers than 1.5 mm per axis, similar poses share three tenths of that variance, and
# half of the captures are about twice as fast as simulated hands.
NUM_FRAMES: Final = 3000
"""Default number of frames of real-like and free takes."""
SPEED: Final = 2
"""Speed of realistic hands relative to the other takes."""

# Markers of others move rigidly with an arm, a thing or a person.
MAX_OTHERS: Final = 60
"""Largest number of markers of others."""
_HAND_WEIGHT: Final = 0.6  # weight of the hand's direction in that of the forearm
_SHOULDER_OFFSET: Final = (0.45, 0.18, 0.25)  # [m] behind the hands, beside and above them
_WRIST_MARKERS: Final = ((0.03, 0.028, 0.02), (0.035, -0.028, 0.02))  # [m] behind the wrist, across, above
_ELBOW_MARKER: Final = (0.26, 0.03, 0.02)
_FOREARM_MARKERS: Final = ((0.12, 0.0, 0.03), (0.2, -0.03, 0.02))
_THING: Final = ((0.10, 0.0, -0.06), (0.14, 0.03, -0.09), (0.17, -0.02, -0.07), (0.21, 0.01, -0.12))  # [m]
_HEAD_MARKERS: Final = ((0.09, 0.0, 0.25), (-0.09, 0.0, 0.25), (0.0, 0.08, 0.27), (0.0, -0.08, 0.2))  # [m]
_BACK_MARKERS: Final = ((-0.12, 0.05, -0.1), (-0.12, -0.05, -0.25))
_OTHER_PERSON_DISTANCE: Final = 1.2  # [m] distance of the other person
_GLUED: Final = 0.004  # [m] standard deviation of a forearm's markers from their layout, along each axis
_BENDS: Final = np.array([0.1, 1.0, 0.4])  # shares of these turns that twist, flex and deviate a wrist
_BENDING: Final = 0.3  # [rad] standard deviation of turns about each axis
_SWAY: Final = 0.03  # [m] half side of the cube in which a swaying body stays
_BODY_SIZE: Final = (0.3, 0.3, 0.7)  # [m] half sides of the box of the other person's markers


class MovingForearm(NamedTuple):
    """A forearm with markers, and where it is in each frame."""

    body: RigidBody
    normals: Float[np.ndarray, "Q 3"]
    """Outward directions of the skin under its markers, in its frame."""
    T_world_body: Float[np.ndarray, "T 4 4"]
    """Poses [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneMotion:
    """Everything that moves in a take; all motions have the same length."""

    hands: tuple[GlovedHand, ...]
    moving_object: MovingObject | None = None
    rate: float = RATE
    """Frames per second [Hz]."""
    skin: tuple[Float[np.ndarray, "T M 3"], ...] = ()
    """Displacement of each hand's markers by its skin, in the world [m]; empty for none."""
    others: Float[np.ndarray, "T Q 3"] | None = None
    """Markers that belong to no hand and no tracked object [m]."""
    forearms: tuple[MovingForearm, ...] = ()
    """Forearms with markers."""

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.hands[0].qpos)

    def faster(self, times: int) -> SceneMotion:
        """The same motion at `times` the speed, without displacements by the skin and markers of others."""
        hands = tuple(GlovedHand(hand.fit, hand.qpos[::times]) for hand in self.hands)
        held = self.moving_object
        moving = held and MovingObject(held.rigid_object, held.T_world_body[::times])
        return SceneMotion(hands, moving, self.rate)

    def moved(self, offsets: Float[np.ndarray, "*T 3"]) -> SceneMotion:
        """The scene moved by one offset [m], or by one per frame; without markers of others."""
        hands = []
        for hand in self.hands:
            qpos = hand.qpos.copy()
            qpos[:, :3] += offsets
            hands.append(GlovedHand(hand.fit, qpos))
        held = self.moving_object
        if held is not None:
            held = MovingObject(held.rigid_object, held.T_world_body.copy())
            held.T_world_body[:, :3, 3] += offsets
        return dataclasses.replace(self, hands=tuple(hands), moving_object=held, others=None)


def sample_scene_motion(
    kind: Kind, fits: Sequence[GloveFit], num_frames: int, *, rng: np.random.Generator
) -> SceneMotion:
    """Random motion of a right and a left hand, and of the object in the right hand, if any."""
    right, left = fits
    if kind == "hand-hand":
        both = sample_two_hand_motion(right.model, left.model, num_frames / RATE, rng=rng)
        return SceneMotion(_wear_motions(fits, both, num_frames))
    if kind == "single-hand":
        sides = zip(fits, (_HAND_OFFSET, -_HAND_OFFSET), strict=True)
        free = [_hand_in_air(fit.model, _FREE_SCRIPT, offset, num_frames, rng) for fit, offset in sides]
        return SceneMotion(_wear_motions(fits, free, num_frames))
    rigid_object = named_object("pen" if kind == "hand-pen" else "controller")
    holding, body = sample_object_motion(right.model, rigid_object, num_frames / RATE, rng=rng)
    held = HandMotion(holding.qpos[:num_frames], RATE), BodyMotion(body.T_world_body[:num_frames], RATE)
    other = _hand_in_air(left.model, _RESTING_SCRIPT, -_HAND_OFFSET, num_frames, rng)
    if kind == "hand-pen":
        path = pointing_path(*left.markers(other.qpos), RATE, rng=rng)
        holding, body = point_pen(right.model, left.model, rigid_object, held, other, path)
    else:
        direction = np.tile(_RETREAT_DIRECTION, (num_frames, 1))
        holding, body = keep_apart(right.model, left.model, rigid_object, held, other, direction)
    hands = _wear_motions(fits, (holding, other), num_frames)
    return SceneMotion(hands, MovingObject(rigid_object, body.T_world_body))


def _hand_in_air(
    model: HandModel, script: str, offset: float, num_frames: int, rng: np.random.Generator
) -> HandMotion:
    """Motion of a hand in the air, palm mostly down, at `offset` from the center of the room [m]."""
    qpos = scripted_motion(model, script, num_frames / RATE, rng=rng).qpos[:num_frames].copy()
    qpos[:, :3], qpos[:, 3:7] = wrist_path(
        num_frames, RATE, center=(offset, 0.0, 1.1), volume=_VOLUME, turning=_WRIST_ROTATION, rng=rng
    )
    return HandMotion(qpos, RATE)


def _wear_motions(
    fits: Sequence[GloveFit], motions: Sequence[HandMotion], num_frames: int
) -> tuple[GlovedHand, ...]:
    """Hands in their gloves with the first frames of their motions."""
    return tuple(GlovedHand(fit, motion.qpos[:num_frames]) for fit, motion in zip(fits, motions, strict=True))


@dataclass(frozen=True, slots=True)
class CalibrationTakeConfig(Settings):
    """Exercises of a calibration capture."""

    free: Annotated[float, Limits(0.0, above=True)] = 40.0
    """Duration of free motion [s]."""
    rounds: Annotated[int, Limits(0)] = 3
    """Number of rounds in which the thumb touches each of the other fingertips."""


def sample_calibration_scene(
    hands: tuple[GloveFit, ...], config: CalibrationTakeConfig, *, rng: np.random.Generator
) -> SceneMotion:
    """Motion of one or both hands in a calibration capture."""
    if not 1 <= len(hands) <= len(SIDES):
        raise ArgumentError(f"{len(hands)} hands, expected one or two")
    angles = [calibration_angles(fit.model, config, rng=rng) for fit in hands]
    frames = min(len(part) for part in angles)
    moving = []
    for fit, part, offset in zip(hands, angles, (_HAND_OFFSET, -_HAND_OFFSET), strict=False):
        position, quaternion = wrist_path(
            frames, _FREE.rate, center=(offset, 0.0, 1.1), volume=_VOLUME, turning=_WRIST_TURNING, rng=rng
        )
        qpos = join_qpos(part[:frames], position=position, quaternion=quaternion)
        moving.append(GlovedHand(fit, qpos))
    return SceneMotion(tuple(moving), rate=_FREE.rate)


def calibration_angles(
    model: HandModel, config: CalibrationTakeConfig, *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Joint angles (T, 20) [rad]: rounds of touches by the thumb, then free motion."""
    touches = [pose for _ in range(config.rounds) for pose in _touch_fingers(model, rng)]
    free = _free_motion(model, config.free, rng)
    if not touches:
        return free
    poses = np.stack([*touches, free[0]])
    return np.concatenate([poses[:1], angles_through(model, poses, _TOUCHING, rng=rng), free])


def _free_motion(model: HandModel, seconds: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Joint angles (T, 20) [rad] of free motion from a pose that can be reached from touches."""
    for _ in range(_MAX_DRAWS):
        free = sample_motion(model, seconds, _FREE, rng=rng).qpos[: count_frames(seconds, _FREE), 7:]
        if can_be_left(model, free[:1]).all():
            return free
    raise PoseError(f"this hand finds no way from its touches to a free motion in {_MAX_DRAWS} tries")


def _touch_fingers(model: HandModel, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Poses (20,) [rad] in which the thumb touches each reachable fingertip, from random starts."""
    poses = []
    for finger in FINGERS:
        pinch = gesture(f"{_TOUCH_GESTURES[rng.integers(len(_TOUCH_GESTURES))]}_{finger}")
        start = make_valid(model, (pinch + rng.normal(scale=_JITTER, size=NUM_JOINTS))[None])
        try:
            touch = touching_angles(model, finger, start)
        except PoseError:
            continue  # Calibration does not need every finger in every round.
        if can_be_left(model, touch[None]).all():
            poses.append(touch)
    return poses


def sample_real_like_scene(layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator) -> SceneMotion:
    """Two hands of an adult or a child that meet and part, with markers that move with the skin."""
    models = sorted(sample_hands(EVERYBODY, rng=rng), key=lambda model: model.shape.side, reverse=True)
    fits = wear_gloves(layout, models, **GenerateSettings().slips, rng=rng)
    fast = sample_scene_motion("hand-hand", fits, SPEED * num_frames, rng=rng).faster(SPEED)
    return dataclasses.replace(fast, skin=tuple(move_skin(hand, rng=rng) for hand in fast.hands))


def other_markers(scene: SceneMotion, count: int, *, rng: np.random.Generator) -> Float[np.ndarray, "T Q 3"]:
    """Positions of `count` markers of others [m]: on the arms, a thing, head and back, and another person."""
    wrists = np.stack([hand.qpos[:, :3] for hand in scene.hands], axis=1)
    ahead = np.stack(
        [hand.fit.model.forward_kinematics(hand.qpos)[:, 0, :3, :3] for hand in scene.hands], axis=1
    )
    middle = wrists.mean(axis=(0, 1))
    front = ahead[..., 0].mean(axis=(0, 1)) * [1.0, 1.0, 0.0] + [1e-6, 0.0, 0.0]
    front /= np.linalg.norm(front)
    trunk = np.stack([front, [-front[1], front[0], 0.0], [0.0, 0.0, 1.0]], axis=1)
    sway = _slow_path(scene, middle, _SWAY, rng) - middle
    back, side, above = _SHOULDER_OFFSET
    arms, bodies = [], []
    for number, hand in enumerate(scene.hands):
        lateral = -side if hand.fit.side == "right" else side
        shoulder = middle + trunk @ [-back, lateral, above] + sway
        arms.append(_arm(wrists[:, number], ahead[:, number], shoulder))
        bodies.append(shoulder[:, None])
    places = np.array(_THING) + rng.normal(0.0, 0.01, (4, 3))
    thing = wrists[:, :1] + np.einsum("tij,kj->tki", ahead[:, 0], places)
    body = np.array([*_HEAD_MARKERS, *_BACK_MARKERS]) @ trunk.T
    torso = middle + body + trunk @ [-back, 0.0, above] + sway[:, None]
    own = [*[part[:, :3] for part in arms], *bodies, *[part[:, 3:] for part in arms], thing, torso]
    markers = np.concatenate(own, axis=1)
    left = max(0, count - markers.shape[1])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    place = middle + _OTHER_PERSON_DISTANCE * (trunk @ [np.cos(angle), np.sin(angle), 0.0])
    person = _slow_path(scene, place, 0.1, rng)[:, None] + rng.uniform(-1.0, 1.0, (left, 3)) * _BODY_SIZE
    return np.concatenate([markers, person], axis=1)[:, :count]


def _arm(
    wrist: Float[np.ndarray, "T 3"], ahead: Float[np.ndarray, "T 3 3"], shoulder: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 5 3"]:
    """Markers of an arm [m]: two at the wrist, one on the elbow, two on the forearm."""
    reach = wrist - shoulder
    reach /= np.linalg.norm(reach, axis=1, keepdims=True)
    along = _HAND_WEIGHT * ahead[..., 0] + (1.0 - _HAND_WEIGHT) * reach
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(ahead[..., 2], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frame = np.stack([-along, across, np.cross(along, across)], axis=2)
    places = np.array([*_WRIST_MARKERS, _ELBOW_MARKER, *_FOREARM_MARKERS])
    return np.asarray(wrist[:, None] + np.einsum("tij,kj->tki", frame, places))


def sample_forearms(scene: SceneMotion, *, rng: np.random.Generator) -> tuple[MovingForearm, ...]:
    """Forearms of the hands whose layout has markers there: wrists bend, and markers are glued freely."""
    found = []
    for hand in (one for one in scene.hands if one.fit.layout.forearm):
        layout, side = hand.fit.layout, hand.side
        positions, normals = forearm_markers(layout, hand.fit.shape.length, side)
        glued = positions + rng.normal(scale=_GLUED, size=positions.shape)
        names = tuple(one.name for one in layout.forearm)
        body = RigidBody(f"{side}_forearm", names, glued, None, side, has_axes=True)
        _, turned = wrist_path(scene.num_frames, scene.rate, turning=_BENDING, rng=rng)
        turn = Rotation.from_quat(turned, scalar_first=True)
        bends = Rotation.from_rotvec(_BENDS * (turn * turn[0].inv()).as_rotvec()).as_matrix()
        poses = pose_matrices(hand.qpos[:, :7])
        poses[:, :3, :3] @= bends.swapaxes(1, 2)
        found.append(MovingForearm(body, normals, poses))
    return tuple(found)


def _slow_path(
    scene: SceneMotion, center: Float[np.ndarray, "3"], volume: float, rng: np.random.Generator
) -> Float[np.ndarray, "T 3"]:
    """Slow motion in a cube of half side `volume` around a center [m]."""
    return wrist_path(scene.num_frames, scene.rate, center=center, volume=volume, turning=0.0, rng=rng)[0]
