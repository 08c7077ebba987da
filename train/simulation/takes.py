"""Simulated takes of hands, such as twins of the four test captures of Han et al. 2018 (section 5, Table 3).

A take is made in steps: people in gloves, their motion, the cameras' views, the optical system, the take.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Final, cast

import numpy as np

from gloves.fit import GlovedHand, GloveFit
from gloves.layout import AnyLayout, MarkerLayout, load_layout
from gloves.takes.take import Take
from handsim.errors import ArgumentError, LayoutError, PoseError
from handsim.hand.shape import Side
from handsim.settings import Limits, Settings
from handsim.space.rig import ROOM_CENTER, AnyRig, Center, check_outside_volume, load_rig, rig_setting
from poses.motion import RATE
from train.simulation.room import (
    TWINS,
    OpticsOptions,
    RoomConfig,
    StrayOptions,
    record_take,
    usual_room,
    with_given,
)
from train.simulation.scenes import (
    MAX_OTHERS,
    NUM_FRAMES,
    SIMULATED_KINDS,
    CalibrationTakeConfig,
    Kind,
    SceneMotion,
    SimulatedKind,
    other_markers,
    sample_calibration_scene,
    sample_forearms,
    sample_real_like_scene,
    sample_scene_motion,
)
from train.simulation.training_frames import sample_adult_hands, wear_gloves

WRIST_VOLUME: Final = 0.5
"""Half side of the cube in which wrists stay [m]; no camera may be there."""
BOTH_SIDES: Final[tuple[Side, Side]] = ("right", "left")
ONE_HAND_KINDS: Final = ("single-hand", "calibration", "free")
"""Kinds of capture that one hand alone can do."""
_MAX_PEOPLE: Final = 10
_SLIP_ALONG, _SLIP_AROUND = 0.05, np.deg2rad(5.0)  # slip of a glove [bone lengths, rad]


@dataclass(frozen=True, slots=True)
class SimulateSettings(Settings):
    """Everything that determines the bytes of a simulated take, which has 120 frames per second [Hz]."""

    noun: ClassVar[str] = "setting of a simulated take"
    kind: SimulatedKind = "single-hand"
    """What the hands do: single-hand, hand-hand, hand-pen or hand-controller, as in the paper's captures;
    real-like; calibration, the exercises for a user's calibration; or free."""
    num_frames: Annotated[int, Limits(1)] | None = None
    """Number of frames; when not given the paper's number for this kind, 3000 for real-like and free, and for
    calibration touches and 40 s of free motion."""
    glove: AnyLayout = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    rig: AnyRig = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    seed: Annotated[int, Limits(0)] = 0
    """Seed of people, motion and losses."""
    center: Center = ROOM_CENTER
    """Center of the space in which hands move, in the rig's room [m]."""
    optics: OpticsOptions = field(default_factory=OpticsOptions)
    """Settings of the optical system that differ from those fitted to this kind of capture."""
    strays: StrayOptions = field(default_factory=StrayOptions)
    """Stray reflections, where they differ from those fitted to this kind of capture."""
    hands: tuple[Side, ...] = BOTH_SIDES
    """Hands to simulate: right, left, or both, which meet or hold an object together in the kinds hand-hand,
    hand-pen, hand-controller and real-like. A glove for one hand simulates that hand alone."""
    others: Annotated[int, Limits(0, MAX_OTHERS)] = 0
    """Number of markers that are not the hands', up to 60, with label -1. The nearest come first: on the
    wearer's arms, a thing in a hand, the wearer's head and back, and a person nearby."""

    def check(self) -> None:
        """Refuse one hand where two are needed, and optics out of range."""
        if set(self.hands) != set(BOTH_SIDES) and (self.kind not in ONE_HAND_KINDS or len(self.hands) != 1):
            raise ArgumentError(
                f"hands are {' '.join(self.hands) or 'none'}, expected right and left, or one of them for "
                f"the kinds {', '.join(ONE_HAND_KINDS)}"
            )
        room_of(self)


def room_of(settings: SimulateSettings) -> RoomConfig:
    """The room of this kind of capture with these optics and strays."""
    usual = usual_room(settings.kind)
    optics, strays = settings.optics.applied(usual.optics), with_given(usual.strays, settings.strays)
    return dataclasses.replace(usual, optics=optics, strays=strays)


def simulate_take(
    kind: SimulatedKind | None = None, settings: SimulateSettings | None = None, **options: Any
) -> Take:
    """Simulate a capture of one or two hands with its truth: points (T, N, 3) [m], labels, IDs and motion.

    Args:
        kind: What the hands do, one of the kinds of `SimulateSettings`.
        settings: The settings; the defaults when not given.
        options: Settings by name, such as `glove="sparse13"`, `num_frames=600`, `seed=3` or
            `optics={"blob_loss": 0.1}`.

    Returns:
        A take at 120 [Hz]; the same settings give the same take.

    Raises:
        LayoutError: The glove is unknown, does not fit, or is for one hand while the other is simulated, too.
        RigError: The rig is unknown or damaged.
        ArgumentError: A setting is unknown or out of range, or a camera is inside the hands' volume.
        PoseError: None of the random people can do what this kind of capture needs.
    """
    given = SimulateSettings.of(settings, options if kind is None else {"kind": kind, **options})
    rig, layout = load_rig(given.rig), load_layout(given.glove)
    given = dataclasses.replace(given, hands=_simulated_sides(given, layout))
    check_outside_volume(rig, np.array(given.center), WRIST_VOLUME)
    draw = TWINS[given.kind].draw if given.kind in TWINS else 0
    seeds = np.random.SeedSequence(given.seed, spawn_key=(SIMULATED_KINDS.index(given.kind), draw))
    rng = np.random.default_rng(seeds)
    scene = _scene_of_take(given, layout, rng)
    if given.center != ROOM_CENTER:
        scene = scene.moved(np.subtract(given.center, ROOM_CENTER))
    if given.others:
        scene = dataclasses.replace(scene, others=other_markers(scene, given.others, rng=rng))
    if layout.forearm:
        scene = dataclasses.replace(scene, forearms=sample_forearms(scene, rng=rng))
    room = room_of(given)
    room = dataclasses.replace(room, optics=room.optics.worn(layout.radius))
    record = given.record() | {"rig": rig_setting(rig), "room": room.record()}
    del record["optics"], record["strays"]  # the room has all of them
    usual = {
        "center": given.center == ROOM_CENTER,
        "hands": set(given.hands) == set(BOTH_SIDES),
        "others": not given.others,
    }
    kept = {name: value for name, value in record.items() if not usual.get(name, False)}
    return record_take(scene, rig, room, kept, rng=rng)


def simulate_calibration(
    hands: tuple[GloveFit, ...], config: CalibrationTakeConfig, *, rng: np.random.Generator
) -> Take:
    """A calibration capture of one or both of the given hands in their gloves, before the rig figure5."""
    scene, rig = sample_calibration_scene(hands, config, rng=rng), load_rig("figure5")
    settings = {"kind": "calibration", **config.record(), "rig": rig_setting(rig)}
    return record_take(scene, rig, RoomConfig(), settings, rng=rng)


def sample_scene(
    kind: Kind, layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator
) -> SceneMotion:
    """A random person in gloves, with the motion of a kind of capture, at `RATE` frames per second."""
    return first_capable_person(
        kind, lambda: sample_scene_motion(kind, _sample_gloves(layout, rng), num_frames, rng=rng)
    )


def _simulated_sides(settings: SimulateSettings, layout: MarkerLayout) -> tuple[Side, ...]:
    """The hands to simulate; a `LayoutError` if the glove is not for them."""
    if len(layout.sides) == 1 and set(settings.hands) == set(BOTH_SIDES):
        if settings.kind not in ONE_HAND_KINDS:
            raise LayoutError(
                f"glove '{layout.name}' is for a {layout.sides[0]} hand only (its file's `sides`), and "
                f"{settings.kind} needs both; kinds of capture for one hand: {', '.join(ONE_HAND_KINDS)}"
            )
        return layout.sides
    for side in settings.hands:
        layout.check_side(side)
    return settings.hands


def _scene_of_take(settings: SimulateSettings, layout: MarkerLayout, rng: np.random.Generator) -> SceneMotion:
    """Scene of a take with these settings, without markers of others."""
    kind, count = settings.kind, settings.num_frames
    if kind == "real-like":
        return sample_real_like_scene(layout, count or NUM_FRAMES, rng=rng)
    if kind in TWINS:
        scene = sample_scene(cast("Kind", kind), layout, count or TWINS[kind].num_frames, rng=rng)
        worn = tuple(hand for hand in scene.hands if hand.side in settings.hands)
        return dataclasses.replace(scene, hands=worn)
    made = CalibrationTakeConfig()
    if kind == "free":
        count, made = count or NUM_FRAMES, dataclasses.replace(made, rounds=0)
    if count is not None:
        made = dataclasses.replace(made, free=(count + 1) / RATE)

    def exercise() -> SceneMotion:
        worn = tuple(fit for fit in _sample_gloves(layout, rng) if fit.side in settings.hands)
        scene = sample_calibration_scene(worn, made, rng=rng)
        hands = tuple(GlovedHand(hand.fit, hand.qpos[:count]) for hand in scene.hands)
        return dataclasses.replace(scene, hands=hands)

    return first_capable_person(kind, exercise)


def _sample_gloves(layout: MarkerLayout, rng: np.random.Generator) -> Sequence[GloveFit]:
    """A random adult's hands in gloves."""
    models = sample_adult_hands(rng=rng)
    return wear_gloves(layout, models, along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)


def first_capable_person(kind: SimulatedKind, act: Callable[[], SceneMotion]) -> SceneMotion:
    """Scene of the first person who can do this kind of capture; `act` draws a person, and may raise."""
    reason: PoseError | None = None
    for _ in range(_MAX_PEOPLE):
        try:
            return act()
        except PoseError as error:
            reason = error
    raise PoseError(f"none of {_MAX_PEOPLE} people can do '{kind}'; the last: {reason}") from reason
