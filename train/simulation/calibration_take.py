"""The capture that a user makes for calibration, simulated with its truth: touches, then free motion."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gloves.fit import GlovedHand, GloveFit
from gloves.takes.take import Take
from handsim._checks import check_count
from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import NUM_JOINTS
from handsim.space.rig import CameraRig, as_rig, rig_setting
from poses.motion.motions import angles_through, count_frames, sample_motion
from poses.motion.paths import MotionConfig, can_be_left
from poses.motion.wrist_paths import WristConfig, wrist_path
from poses.shapes.library import gesture
from poses.shapes.touch import FINGERS, touching_angles
from poses.shapes.validity import make_valid
from train.simulation.motion import SceneMotion
from train.simulation.room import record_take
from train.simulation.room_settings import RoomConfig

_OFFSETS: Final = (0.22, -0.22)  # of the hands from the room's middle [m], so that they do not meet
_VOLUME: Final = 0.1  # half side of the cube that a wrist stays in [m]
_MAX_DRAWS: Final = 20
_STARTS: Final = ("pinch_pad", "pinch_tip")
_JITTER: Final = np.deg2rad(8.0)
_TOUCHING: Final = MotionConfig(durations=(0.4, 0.8), hold=0.8)
_FREE: Final = MotionConfig(durations=(0.3, 0.9), hold=0.2)


@dataclass(frozen=True, slots=True)
class CalibrationTakeConfig:
    """What the user does, and the cameras that see it."""

    free: float = 40.0
    """Free motion [s]."""
    rounds: int = 3
    """How often the thumb goes to each of the other fingertips in turn."""
    rig: CameraRig | str = "figure5"
    """Camera rig: a shipped name, the path of a .toml file, or the rig itself."""
    turning: float = 0.7
    """Standard deviation of the wrist's rotation about each axis [rad]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.free < np.inf:
            raise ArgumentError(f"free is {self.free:g} s, expected a positive time")
        check_count("rounds", self.rounds, 0)


def simulate_calibration(
    hands: tuple[GloveFit, ...],
    config: CalibrationTakeConfig | None = None,
    *,
    rng: np.random.Generator,
) -> Take:
    """What cameras see of a user who makes a calibration capture with one hand or both.

    Raises:
        ArgumentError: There are no hands or more than two.
        PoseError: A hand finds no way from its touches to free motion.
    """
    config = config or CalibrationTakeConfig()
    scene = sample_calibration_scene(hands, config, rng=rng)
    rig = as_rig(config.rig)
    settings = {"kind": "calibration", **dataclasses.asdict(config), "rig": rig_setting(rig)}
    return record_take(scene, rig, RoomConfig(), settings, rng=rng)


def sample_calibration_scene(
    hands: tuple[GloveFit, ...], config: CalibrationTakeConfig, *, rng: np.random.Generator
) -> SceneMotion:
    """The motion of one hand or both in a calibration capture; without rounds, free motion alone.

    Raises:
        ArgumentError: There are no hands or more than two.
        PoseError: A hand finds no way from its touches to free motion.
    """
    if not 1 <= len(hands) <= len(_OFFSETS):
        raise ArgumentError(f"{len(hands)} hands, expected one or two")
    angles = [calibration_angles(fit.model, config, rng=rng) for fit in hands]
    frames = min(len(part) for part in angles)
    moving = []
    for fit, part, offset in zip(hands, angles, _OFFSETS, strict=False):
        wrist = WristConfig(center=(offset, 0.0, 1.1), volume=_VOLUME, turning=config.turning)
        position, quaternion = wrist_path(frames, _FREE.rate, wrist, rng=rng)
        qpos = join_qpos(part[:frames], position=position, quaternion=quaternion)
        moving.append(GlovedHand(fit, qpos))
    return SceneMotion(tuple(moving), rate=_FREE.rate)


def calibration_angles(
    model: HandModel, config: CalibrationTakeConfig, *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Joint angles (T, 20) [rad]: rounds of touches by the thumb, then free motion.

    Raises:
        PoseError: This hand finds no way from its touches to free motion.
    """
    touches = [pose for _ in range(config.rounds) for pose in _touch_fingers(model, rng)]
    free = _free_motion(model, config.free, rng)
    if not touches:
        return free
    poses = np.stack([*touches, free[0]])
    return np.concatenate([poses[:1], angles_through(model, poses, _TOUCHING, rng=rng), free])


def _free_motion(model: HandModel, seconds: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Free motion from a pose that can be reached from everywhere."""
    for _ in range(_MAX_DRAWS):
        free = sample_motion(model, seconds, _FREE, rng=rng).qpos[: count_frames(seconds, _FREE), 7:]
        if can_be_left(model, free[:1]).all():
            return free
    raise PoseError(f"this hand finds no way from its touches to a free motion in {_MAX_DRAWS} tries")


def _touch_fingers(model: HandModel, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Poses (20,) [rad] of the thumb at each fingertip that it reaches, each from a start of its own."""
    poses = []
    for finger in FINGERS:
        pinch = gesture(f"{_STARTS[rng.integers(len(_STARTS))]}_{finger}")
        start = make_valid(model, (pinch + rng.normal(scale=_JITTER, size=NUM_JOINTS))[None])
        try:
            touch = touching_angles(model, finger, start)
        except PoseError:
            continue  # another finger, or the next round, will do
        if can_be_left(model, touch[None]).all():
            poses.append(touch)
    return poses
