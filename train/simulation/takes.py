"""Simulated takes of hands: twins of the four captures that Han et al. 2018 test on (section 5, Table 3).

A take flows one way: people in gloves, their motion, what cameras see of it, the optical system, the take.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from gloves.fit import GlovedHand, GloveFit
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.take import Take
from handsim._checks import check_choice, check_count, check_type, fill_settings
from handsim.errors import ArgumentError, LayoutError, PoseError
from handsim.hand.shape import SIDES, Side
from handsim.space.rig import ROOM_CENTER, CameraRig, as_rig, check_outside_volume, list_rigs, rig_setting
from train.simulation.room import TWINS, OpticsOptions, RoomConfig, record_take, usual_room
from train.simulation.scenes import (
    MOST_OTHERS,
    NUM_FRAMES,
    RATE,
    SIMULATED_KINDS,
    CalibrationTakeConfig,
    Kind,
    SceneMotion,
    SimulatedKind,
    other_markers,
    sample_adult_hands,
    sample_calibration_scene,
    sample_real_like_scene,
    sample_scene_motion,
    wear_gloves,
)

WRIST_VOLUME: Final = 0.5
"""Half side of the cube that wrists stay in [m]; no camera may stand there."""
BOTH: Final[tuple[Side, Side]] = ("right", "left")
APART: Final = ("single-hand", "calibration", "free")
"""Kinds of capture in which a hand may be alone."""
_MAX_PEOPLE: Final = 10
_SLIP_ALONG, _SLIP_AROUND = 0.05, np.deg2rad(5.0)


@dataclass(frozen=True, slots=True)
class TakeConfig:
    """Everything that decides the bytes of a simulated take; takes have 120 frames per second [Hz]."""

    kind: SimulatedKind = "single-hand"
    num_frames: int | None = None
    """Frames; when not given the paper's number for this kind, 3000 for real-like and free, and for
    calibration touches and 40 s of free motion."""
    glove: MarkerLayout | str | Path = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    rig: CameraRig | str | Path = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    seed: int = 0
    optics: OpticsOptions = field(default_factory=OpticsOptions)
    """The optical system, where it differs from the one fitted to this kind of capture."""
    hands: tuple[Side, ...] = BOTH
    """Hands to simulate: right, left, or both, which meet or hold an object together in the kinds hand-hand,
    hand-pen, hand-controller and real-like. Of a glove for one hand that hand alone."""
    others: int = 0
    """Markers that are not the hands', up to 60: those nearest to them first: on the wearer's arms, a thing
    in a hand, the wearer's head and back, and a person beside."""

    def __post_init__(self) -> None:
        check_type("kind", self.kind, str, "the name of a kind of capture", SIMULATED_KINDS)
        wanted = "a MarkerLayout, or the name or path of one"
        check_type("glove", self.glove, (MarkerLayout, str, Path), wanted, list_layouts())
        wanted = "a CameraRig, or the name or path of one"
        check_type("rig", self.rig, (CameraRig, str, Path), wanted, list_rigs())
        check_count("seed", self.seed, 0)
        if self.num_frames is not None:
            check_count("num_frames", self.num_frames, 1)
        check_count("others", self.others, 0, MOST_OTHERS)
        check_type("hands", self.hands, (str, tuple, list), "right, left or both", SIDES)
        object.__setattr__(self, "hands", (self.hands,) if isinstance(self.hands, str) else tuple(self.hands))
        fill_settings(self)
        check_choice(self.kind, SIMULATED_KINDS, noun="kind of capture")
        for side in self.hands:
            check_choice(side, SIDES, noun="hand")
        if set(self.hands) != set(BOTH) and (self.kind not in APART or len(self.hands) != 1):
            raise ArgumentError(
                f"hands are {' '.join(self.hands) or 'none'}, expected right and left, or one of them for "
                f"the kinds {', '.join(APART)}"
            )
        self.optics.applied(self.room.optics)  # raises what is out of range

    @property
    def room(self) -> RoomConfig:
        """The room of this kind."""
        return usual_room(self.kind)


def simulate_take(
    kind: SimulatedKind = "single-hand",
    *,
    glove: MarkerLayout | str | Path = "dense19",
    num_frames: int | None = None,
    rig: CameraRig | str | Path = "figure5",
    seed: int = 0,
    hands: Sequence[Side] = BOTH,
    optics: Mapping[str, Any] | None = None,
    others: int = 0,
) -> Take:
    """A simulated capture of one hand or two with its truth: points (T, N, 3) [m], labels, IDs and motion.

    Args:
        kind: What the hands do: single-hand, hand-hand, hand-pen or hand-controller, as in the paper's
            captures; real-like; calibration, what a user does to be calibrated by; or free.
        glove: The marker layout, or its name or path.
        num_frames: Frames; when not given the paper's number for this kind, 3000 for real-like and free, and
            for calibration touches and 40 s of free motion.
        rig: The cameras, or the name or path of a rig.
        seed: Seed of people, motion and losses.
        hands: Both, or for single-hand, calibration and free one of them; of a glove for one hand that hand.
        optics: What differs from the optical system fitted to this kind, as `handsim simulate --help` lists
            it: `{"blob_loss": 0.1}`.
        others: Markers that are not the hands', up to 60: on the wearer's arms, a thing in a hand, the
            wearer's head and back, and a person beside. Their label is -1.

    Returns:
        A take at 120 [Hz]; the same arguments give the same take.

    Raises:
        LayoutError: The glove is unknown, does not fit, or is for one hand and the other is simulated too.
        RigError: The rig is unknown or damaged.
        ArgumentError: An argument is of another type or out of range, or a camera stands in the hands' way.
        PoseError: None of the people drawn can do what this kind of capture asks for.
    """
    options: Any = {} if optics is None else optics
    return record_config(TakeConfig(kind, num_frames, glove, rig, seed, options, hands, others))  # type: ignore[arg-type]


def record_config(config: TakeConfig) -> Take:
    """As `simulate_take`.

    Args:
        config: What the hands do, for how long, in which glove and under which cameras.

    Returns:
        A take at 120 [Hz]; the same configuration gives the same take.

    Raises:
        LayoutError: The glove is unknown, does not fit, or is for one hand and the other is simulated too.
        ArgumentError: The rig is unknown, damaged or stands in the hands' way.
        PoseError: None of the people drawn can do what this kind of capture asks for.
    """
    kind = config.kind
    key = SIMULATED_KINDS.index(kind), TWINS[kind].draw if kind in TWINS else 0
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=key))
    rig, layout = as_rig(config.rig), load_layout(config.glove)
    config = dataclasses.replace(config, hands=_worn_hands(config, layout))
    check_outside_volume(rig, np.array(ROOM_CENTER), WRIST_VOLUME)
    scene = _sample_scene(config, layout, rng)
    if config.others:
        scene = dataclasses.replace(scene, others=other_markers(scene, config.others, rng=rng))
    optics = config.optics.applied(config.room.optics).worn(layout.radius)
    room = dataclasses.replace(config.room, optics=optics)
    named = dataclasses.replace(
        config,
        glove=layout.name if isinstance(config.glove, MarkerLayout) else str(config.glove),
        rig=rig.name,
    )
    settings = dataclasses.asdict(named) | {"rig": rig_setting(rig), "room": dataclasses.asdict(room)}
    del settings["optics"]  # the room has all of them
    if set(config.hands) == set(BOTH):
        del settings["hands"]
    if not config.others:
        del settings["others"]
    return record_take(scene, rig, room, settings, rng=rng)


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


def _worn_hands(config: TakeConfig, layout: MarkerLayout) -> tuple[Side, ...]:
    """The hands that a capture asks for and the glove is for; a `LayoutError` if there are none."""
    if len(layout.sides) == 1 and set(config.hands) == set(BOTH):
        if config.kind not in APART:
            raise LayoutError(
                f"glove '{layout.name}' is for a {layout.sides[0]} hand only (its file's `sides`), and "
                f"{config.kind} needs both; kinds of capture for one hand: {', '.join(APART)}"
            )
        return layout.sides
    for side in config.hands:
        layout.check_side(side)
    return config.hands


def sample_scene(
    kind: Kind, layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator
) -> SceneMotion:
    """A random person in gloves who does what this kind of capture asks for.

    Args:
        layout: The glove on both hands.
        num_frames: Frames at `train.simulation.scenes.RATE`.

    Raises:
        LayoutError: The glove does not fit.
        PoseError: None of the people drawn can do this.
    """
    return _by_somebody(kind, layout, lambda fits: sample_scene_motion(kind, fits, num_frames, rng=rng), rng)


def _sample_scene(config: TakeConfig, layout: MarkerLayout, rng: np.random.Generator) -> SceneMotion:
    kind = config.kind
    if kind == "real-like":
        return sample_real_like_scene(layout, config.num_frames or NUM_FRAMES, rng=rng)
    if kind not in TWINS:
        return _by_somebody(kind, layout, functools.partial(_exercise, config, rng=rng), rng)
    scene = sample_scene(cast("Kind", kind), layout, config.num_frames or TWINS[kind].paper.frames, rng=rng)
    return dataclasses.replace(scene, hands=tuple(hand for hand in scene.hands if hand.side in config.hands))


def _exercise(config: TakeConfig, fits: Sequence[GloveFit], *, rng: np.random.Generator) -> SceneMotion:
    """What a calibration asks for, or free motion, cut to its number of frames."""
    count = config.num_frames or (NUM_FRAMES if config.kind == "free" else None)
    made = CalibrationTakeConfig()
    if config.kind == "free":
        made = dataclasses.replace(made, rounds=0)
    if count is not None:
        made = dataclasses.replace(made, free=(count + 1) / RATE)
    worn = tuple(fit for fit in fits if fit.side in config.hands)
    scene = sample_calibration_scene(worn, made, rng=rng)
    return dataclasses.replace(
        scene, hands=tuple(GlovedHand(hand.fit, hand.qpos[:count]) for hand in scene.hands)
    )


def _by_somebody(
    kind: SimulatedKind,
    layout: MarkerLayout,
    act: Callable[[Sequence[GloveFit]], SceneMotion],
    rng: np.random.Generator,
) -> SceneMotion:
    """What the first person does who can."""
    reason: PoseError | None = None
    for _ in range(_MAX_PEOPLE):
        models = sample_adult_hands(rng=rng)
        fits = wear_gloves(layout, models, along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)
        try:
            return act(fits)
        except PoseError as error:
            reason = error
    raise PoseError(f"none of {_MAX_PEOPLE} people can do '{kind}'; the last: {reason}") from reason
