"""Twins of the four captures that Han et al. 2018 test on (section 5, Table 3), simulated with their truth.

What the hands do follows the paper's words; how often cameras drop out and reflections flash is fitted to
Table 3 and to the ghost ratios of Table 4 (docs/room.md says what was fitted to what).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from gloves.attachment import wear
from gloves.captures.gaps import GapCounts
from gloves.fit import GlovedHand, GloveFit
from gloves.layout import MarkerLayout, load_layout
from gloves.optics.reconstruction import OpticsConfig
from gloves.optics.strays import StrayConfig
from gloves.takes.take import Take
from handsim.errors import ArgumentError, PoseError, choices
from handsim.hand.model import HandModel
from handsim.hand.motion import BodyMotion, HandMotion
from handsim.hand.shape import ADULTS, sample_shape
from handsim.space.cameras import ROOM_CENTER, check_outside_volume, load_rig
from handsim.space.objects import named_object
from poses.contact.keeping_apart import keep_apart, point_pen
from poses.contact.pointing import pointing_path
from poses.contact.two_hands import TwoHandConfig, sample_two_hand_motion
from poses.grasps.object_motion import sample_object_motion
from poses.motion.scripts import scripted_motion
from poses.motion.wrist_paths import WristConfig, wrist_path
from train.simulation.room import Prop, Room, RoomConfig

Kind = Literal["single-hand", "hand-hand", "hand-pen", "hand-controller"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
RATE: Final = 120.0
_APART: Final = 0.22  # from the middle to a hand that touches nothing [m]
_ASIDE: Final = np.array([1.0, 0.0, 0.0])  # where a right hand makes room
_MOST_PEOPLE: Final = 10
_SPACE: Final = 0.5  # half side of the cube that wrists stay in [m]
_APART_TIME: Final = (2.0, 4.0)
_IN_THE_AIR, _AT_REST, _TURNING = "piano", "typing", 0.5
_SLIP_ALONG, _SLIP_AROUND = 0.05, np.deg2rad(5.0)


@dataclass(frozen=True, slots=True)
class TwinConfig:
    """Everything that decides a twin's bytes."""

    kind: Kind = "single-hand"
    num_frames: int | None = None
    """Frames; the paper's number for this kind when not given."""
    glove: str = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    rig: str = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in TWINS:
            raise ArgumentError(choices(self.kind, TWINS, noun="kind of capture"))
        if self.num_frames is not None and self.num_frames < 1:
            raise ArgumentError(f"num_frames is {self.num_frames}, expected at least 1")
        if self.seed < 0:
            raise ArgumentError(f"seed is {self.seed}, expected 0 or more")


@dataclass(frozen=True, slots=True)
class Twin:
    """One of the paper's captures and what makes its simulated twin like it."""

    paper: GapCounts
    """Table 3."""
    ghost_ratio: float
    """Ghosts over expected labels; Table 4."""
    room: RoomConfig
    draw: int
    """Which of many random captures of this kind is the twin: the one nearest to the paper's figures."""


def _room(strays: float, **optics: Any) -> RoomConfig:
    return RoomConfig(
        optics=OpticsConfig(min_rays_to_start=2, **optics),
        strays=StrayConfig(number=strays),
    )


def _losses(blob_loss: float, dropout: float, length: float, cameras: int) -> dict[str, float]:
    return {
        "blob_loss": blob_loss,
        "dropout": dropout,
        "dropout_length": length,
        "dropout_cameras": cameras,
    }


TWINS: Final[dict[str, Twin]] = {
    "single-hand": Twin(
        GapCounts(4785, 44, 2.11, 1.35), 0.0001, _room(0.0, **_losses(0.01, 0.016, 2.2, 6)), draw=8
    ),
    "hand-hand": Twin(
        GapCounts(3312, 331, 4.01, 3.30), 0.1063, _room(7.0, **_losses(0.002, 0.35, 1.5, 4)), draw=8
    ),
    "hand-pen": Twin(
        GapCounts(4511, 481, 3.39, 2.31), 0.0755, _room(3.0, **_losses(0.002, 0.17, 1.4, 6)), draw=15
    ),
    "hand-controller": Twin(
        GapCounts(2645, 382, 2.65, 1.62), 0.0450, _room(1.7, **_losses(0.115, 0.0, 1.0, 1)), draw=2
    ),
}


def simulate_twin(config: TwinConfig) -> Take:
    """A simulated capture of two hands, all of whose truth is known.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        RigError: The rig is unknown or damaged.
        ArgumentError: The rig stands in the hands' way.
    """
    twin = TWINS[config.kind]
    key = list(TWINS).index(config.kind), twin.draw
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=key))
    rig, layout = load_rig(config.rig), load_layout(config.glove)
    check_outside_volume(rig, np.array(ROOM_CENTER), _SPACE)
    frames = config.num_frames or twin.paper.frames
    hands, prop = _cast(config.kind, layout, frames, rng)
    settings = dataclasses.asdict(config) | {"room": dataclasses.asdict(twin.room)}
    return Room(hands, prop, rig, twin.room, rate=RATE).take(settings, rng=rng)


def _cast(
    kind: str, layout: MarkerLayout, frames: int, rng: np.random.Generator
) -> tuple[tuple[GlovedHand, ...], Prop | None]:
    """Somebody who can do what this kind of capture asks for, doing it."""
    for _ in range(_MOST_PEOPLE - 1):
        try:
            return _play(kind, _couple(rng), layout, frames, rng)
        except PoseError:  # these hands do not get hold of the pen
            continue
    return _play(kind, _couple(rng), layout, frames, rng)


def _couple(rng: np.random.Generator) -> tuple[HandModel, HandModel]:
    """Right and left hand of somebody whom no training set knows."""
    shape = sample_shape(ADULTS, side="right", rng=rng)
    return HandModel(shape), HandModel(dataclasses.replace(shape, side="left"))


def _play(
    kind: str,
    hands: tuple[HandModel, HandModel],
    layout: MarkerLayout,
    frames: int,
    rng: np.random.Generator,
) -> tuple[tuple[GlovedHand, ...], Prop | None]:
    """What hands and object do."""
    right, left = hands
    fits = [
        GloveFit(hand, wear(layout, hand, along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)) for hand in hands
    ]
    seconds = frames / RATE
    if kind == "hand-hand":
        motions = sample_two_hand_motion(right, left, seconds, TwoHandConfig(apart=_APART_TIME), rng=rng)
        return _gloved(fits, motions, frames), None
    if kind == "single-hand":
        motions = (
            _alone(right, _IN_THE_AIR, _APART, frames, rng),
            _alone(left, _IN_THE_AIR, -_APART, frames, rng),
        )
        return _gloved(fits, motions, frames), None
    thing = named_object("pen" if kind == "hand-pen" else "controller")
    holding, body = sample_object_motion(right, thing, seconds, rng=rng)
    held = HandMotion(holding.qpos[:frames], RATE), BodyMotion(body.T_world_body[:frames], RATE)
    other = _alone(left, _AT_REST, -_APART, frames, rng)
    if kind == "hand-pen":
        places, outward = fits[1].markers(other.qpos)
        path = pointing_path(places, outward, RATE, rng=rng)
        holding, body = point_pen(right, left, thing, held, other, path)
    else:
        holding, body = keep_apart(right, left, thing, held, other, np.tile(_ASIDE, (frames, 1)))
    return _gloved(fits, (holding, other), frames), Prop(thing, body)


def _alone(hand: HandModel, script: str, aside: float, frames: int, rng: np.random.Generator) -> HandMotion:
    """One hand in the air, palm mostly down, that touches nothing."""
    qpos = scripted_motion(hand, script, frames / RATE, rng=rng).qpos[:frames].copy()
    where = WristConfig(center=(aside, 0.0, 1.1), volume=0.1, turning=_TURNING)
    qpos[:, :3], qpos[:, 3:7] = wrist_path(frames, RATE, where, rng=rng)
    return HandMotion(qpos, RATE)


def _gloved(
    fits: list[GloveFit], motions: tuple[HandMotion, HandMotion], frames: int
) -> tuple[GlovedHand, ...]:
    return tuple(GlovedHand(fit, motion.qpos[:frames]) for fit, motion in zip(fits, motions, strict=True))
