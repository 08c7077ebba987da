"""Simulated takes of two hands: twins of the four captures that Han et al. 2018 test on (section 5, Table 3).

A take flows one way: people in gloves, their motion, what cameras see of it, the optical system, the take.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take
from handsim.errors import ArgumentError, PoseError, choices
from handsim.space.cameras import ROOM_CENTER, check_outside_volume, load_rig
from train.simulation.motion import SceneMotion, sample_scene_motion
from train.simulation.people import sample_adult_hands, wear_gloves
from train.simulation.real_like import NUM_FRAMES, sample_real_like_scene
from train.simulation.room import record_take
from train.simulation.room_settings import (
    SIMULATED_KINDS,
    TWINS,
    Kind,
    OpticsOptions,
    RoomConfig,
    SimulatedKind,
)

WRIST_VOLUME: Final = 0.5
"""Half side of the cube that wrists stay in [m]; no camera may stand there."""
_MAX_PEOPLE: Final = 10
_SLIP_ALONG, _SLIP_AROUND = 0.05, np.deg2rad(5.0)


@dataclass(frozen=True, slots=True)
class TakeConfig:
    """Everything that decides the bytes of a simulated take; takes have 120 frames per second [Hz]."""

    kind: SimulatedKind = "single-hand"
    num_frames: int | None = None
    """Frames; the paper's number for this kind when not given, 3000 for real-like."""
    glove: str = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    rig: str = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    seed: int = 0
    optics: OpticsOptions = field(default_factory=OpticsOptions)
    """The optical system, where it differs from the one fitted to this kind of capture."""

    def __post_init__(self) -> None:
        if self.kind not in SIMULATED_KINDS:
            raise ArgumentError(choices(self.kind, SIMULATED_KINDS, noun="kind of capture"))
        if self.num_frames is not None and self.num_frames < 1:
            raise ArgumentError(f"num_frames is {self.num_frames}, expected at least 1")
        if self.seed < 0:
            raise ArgumentError(f"seed is {self.seed}, expected 0 or more")
        self.optics.applied(self.room.optics)  # raises what is out of range

    @property
    def room(self) -> RoomConfig:
        """The room of the paper's capture; of the one with two hands for real-like."""
        return TWINS["hand-hand" if self.kind == "real-like" else self.kind].room


def simulate_take(config: TakeConfig) -> Take:
    """A simulated capture of two hands with its truth: points (T, N, 3) [m], labels, IDs and motion.

    Args:
        config: What the hands do, for how long, in which glove and under which cameras.

    Returns:
        A take at 120 [Hz]; the same configuration gives the same take.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        ArgumentError: The rig is unknown, damaged or stands in the hands' way.
        PoseError: None of the people drawn can do what this kind of capture asks for.
    """
    kind = config.kind
    key = SIMULATED_KINDS.index(kind), 0 if kind == "real-like" else TWINS[kind].draw
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=key))
    rig, layout = load_rig(config.rig), load_layout(config.glove)
    check_outside_volume(rig, np.array(ROOM_CENTER), WRIST_VOLUME)
    if kind == "real-like":
        scene = sample_real_like_scene(layout, config.num_frames or NUM_FRAMES, rng=rng)
    else:
        scene = sample_scene(kind, layout, config.num_frames or TWINS[kind].paper.frames, rng=rng)
    optics = config.optics.applied(config.room.optics).worn(layout.radius)
    room = dataclasses.replace(config.room, optics=optics)
    settings = dataclasses.asdict(config) | {"room": dataclasses.asdict(room)}
    del settings["optics"]  # the room has all of them
    return record_take(scene, rig, room, settings, rng=rng)


def sample_scene(
    kind: Kind, layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator
) -> SceneMotion:
    """A random person in gloves who does what this kind of capture asks for.

    Args:
        kind: What the hands do.
        layout: The glove on both hands.
        num_frames: Frames at `train.simulation.motion.RATE`.
        rng: Source of all randomness.

    Raises:
        LayoutError: The glove does not fit.
        PoseError: None of the people drawn can do this.
    """
    reason: PoseError | None = None
    for _ in range(_MAX_PEOPLE):
        models = sample_adult_hands(rng=rng)
        fits = wear_gloves(layout, models, along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)
        try:
            return sample_scene_motion(kind, fits, num_frames, rng=rng)
        except PoseError as error:
            reason = error
    raise PoseError(f"none of {_MAX_PEOPLE} people can do '{kind}'; the last: {reason}") from reason
