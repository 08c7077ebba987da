"""The motion of a take: what two gloved hands and an object do, for each kind of capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.fit import GlovedHand, GloveFit
from handsim.hand.model import HandModel
from handsim.hand.motion import BodyMotion, HandMotion
from handsim.space.objects import RigidObject, named_object
from poses.contact.keeping_apart import keep_apart, point_pen
from poses.contact.pointing import pointing_path
from poses.contact.two_hands import sample_two_hand_motion
from poses.grasps.object_motion import sample_object_motion
from poses.motion.scripts import scripted_motion
from poses.motion.wrist_paths import WristConfig, wrist_path
from train.simulation.room_settings import Kind

RATE: Final = 120.0
"""Frames per second of simulated takes [Hz]."""
_HAND_OFFSET: Final = 0.22  # from the middle to a hand that touches nothing [m]
_RETREAT_DIRECTION: Final = np.array([1.0, 0.0, 0.0])  # where a right hand makes room
_PAUSE_BETWEEN_CONTACTS: Final = (2.0, 4.0)  # [s]
_WRIST_ROTATION: Final = 0.5  # standard deviation about each axis [rad]
_FREE_SCRIPT, _RESTING_SCRIPT = "piano", "typing"


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """An object and its path through the room."""

    rigid_object: RigidObject
    motion: BodyMotion


@dataclass(frozen=True, slots=True, eq=False)
class SceneMotion:
    """Everything that moves in a take; all motions have one length."""

    hands: tuple[GlovedHand, ...]
    moving_object: MovingObject | None = None
    rate: float = RATE
    """Frames per second [Hz]."""
    skin: tuple[Float[np.ndarray, "T M 3"], ...] = ()
    """Displacement of each hand's markers by its skin, in the world [m]; none when empty."""
    others: Float[np.ndarray, "T Q 3"] | None = None
    """Markers that belong to no hand and to no tracked object [m]."""

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.hands[0].qpos)

    def faster(self, times: int) -> SceneMotion:
        """The same motion this many times as fast: of so many frames only the first is kept.

        Displacements by the skin and markers of others are not kept.

        Args:
            times: Whole number from 1.
        """
        hands = tuple(GlovedHand(hand.fit, hand.qpos[::times]) for hand in self.hands)
        held = self.moving_object
        if held is not None:
            motion = BodyMotion(held.motion.T_world_body[::times], held.motion.rate)
            held = dataclasses.replace(held, motion=motion)
        return SceneMotion(hands, held, self.rate)


def sample_scene_motion(
    kind: Kind, fits: Sequence[GloveFit], num_frames: int, *, rng: np.random.Generator
) -> SceneMotion:
    """Random motion of a right and a left hand, and of the object that the right hand holds.

    Args:
        fits: A right and a left hand in their gloves.
        num_frames: Frames at `RATE`.

    Raises:
        PoseError: These hands cannot do this: they do not grasp the object, say.
    """
    right, left = fits
    if kind == "hand-hand":
        return _two_hands(right, left, num_frames, rng)
    if kind == "single-hand":
        motions = (
            _free_hand(right.model, _FREE_SCRIPT, _HAND_OFFSET, num_frames, rng),
            _free_hand(left.model, _FREE_SCRIPT, -_HAND_OFFSET, num_frames, rng),
        )
        return SceneMotion(_gloved(fits, motions, num_frames))
    return _hand_with_object(kind, right, left, num_frames, rng)


def _two_hands(right: GloveFit, left: GloveFit, num_frames: int, rng: np.random.Generator) -> SceneMotion:
    """Hands that meet and part."""
    motions = sample_two_hand_motion(
        right.model, left.model, num_frames / RATE, pause=_PAUSE_BETWEEN_CONTACTS, rng=rng
    )
    return SceneMotion(_gloved((right, left), motions, num_frames))


def _hand_with_object(
    kind: Kind, right: GloveFit, left: GloveFit, num_frames: int, rng: np.random.Generator
) -> SceneMotion:
    """The right hand holds a pen that points at the left hand's markers, or a controller."""
    rigid_object = named_object("pen" if kind == "hand-pen" else "controller")
    holding, body = sample_object_motion(right.model, rigid_object, num_frames / RATE, rng=rng)
    held = HandMotion(holding.qpos[:num_frames], RATE), BodyMotion(body.T_world_body[:num_frames], RATE)
    other = _free_hand(left.model, _RESTING_SCRIPT, -_HAND_OFFSET, num_frames, rng)
    if kind == "hand-pen":
        path = pointing_path(*left.markers(other.qpos), RATE, rng=rng)
        holding, body = point_pen(right.model, left.model, rigid_object, held, other, path)
    else:
        direction = np.tile(_RETREAT_DIRECTION, (num_frames, 1))
        holding, body = keep_apart(right.model, left.model, rigid_object, held, other, direction)
    return SceneMotion(_gloved((right, left), (holding, other), num_frames), MovingObject(rigid_object, body))


def _free_hand(
    model: HandModel, script: str, offset: float, num_frames: int, rng: np.random.Generator
) -> HandMotion:
    """One hand in the air, palm mostly down, that touches nothing; `offset` is its side of the room [m]."""
    qpos = scripted_motion(model, script, num_frames / RATE, rng=rng).qpos[:num_frames].copy()
    config = WristConfig(center=(offset, 0.0, 1.1), volume=0.1, turning=_WRIST_ROTATION)
    qpos[:, :3], qpos[:, 3:7] = wrist_path(num_frames, RATE, config, rng=rng)
    return HandMotion(qpos, RATE)


def _gloved(
    fits: Sequence[GloveFit], motions: Sequence[HandMotion], num_frames: int
) -> tuple[GlovedHand, ...]:
    return tuple(GlovedHand(fit, motion.qpos[:num_frames]) for fit, motion in zip(fits, motions, strict=True))
