"""Hands at work: simulated motion of several people, or that of a take, wherever in the volume they go."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Final, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures.capture import runs_of
from gloves.fit import GlovedHand, GloveFit, attach
from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim._checks import check_array
from handsim.errors import ArgumentError, CaptureError, PoseError
from handsim.hand.model import BodyMotion
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import pose_matrices
from train.rig_advice.rig_faults import HALF_SIDE
from train.simulation.room import RoomConfig, usual_room
from train.simulation.scenes import (
    KINDS,
    SIMULATED_KINDS,
    MovingObject,
    SceneMotion,
    SimulatedKind,
    sample_real_like_scene,
)
from train.simulation.takes import sample_scene

GLOVE: Final = "dense19"
VOLUME: Final = (0.6, 0.6, 0.6)
"""Sides of the space that hands work in [m]."""
_LONGEST: Final = 50.0  # sides of a volume or a room [m]
_REAL_LIKE: Final = "real-like"
_MAX_PEOPLE: Final = 10
_FEWEST: Final = 12  # frames of a stretch of a take without a break
_ROUND: Final = (11.0, 14.0, 9.0)  # through the volume and back along each axis [s]


def sample_work(
    layout: MarkerLayout,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    num_frames: int,
    people: int,
    *,
    rng: np.random.Generator,
) -> dict[str, list[SceneMotion]]:
    """What several people's hands do, by kind: like real ones, alone, together, with a pen, a controller.

    Args:
        layout: The glove on both hands.
        center: Middle of the volume that hands work in [m].
        sides: Its sides [m]; where they are longer than hands reach, people walk through it.
        num_frames: Frames of each person and kind.
        people: People of each kind.

    Raises:
        LayoutError: The glove does not fit, or is for one hand.
        PoseError: None of the people drawn can do this.
    """
    work: dict[str, list[SceneMotion]] = {}
    draws: dict[str, Callable[[], SceneMotion]] = {
        _REAL_LIKE: functools.partial(_real_like, layout, num_frames, rng)
    }
    for kind in KINDS:
        draws[kind] = functools.partial(sample_scene, kind, layout, num_frames, rng=rng)
    for name, draw in draws.items():
        work[name] = []
        for _ in range(people):
            scene = draw()
            walk = _walk(scene.num_frames / scene.rate, scene.num_frames, sides, rng)
            work[name].append(moved(scene, walk + center - ROOM_CENTER))
    return work


def _real_like(layout: MarkerLayout, num_frames: int, rng: np.random.Generator) -> SceneMotion:
    """Of the first person who can bring the hands together."""
    reason: PoseError | None = None
    for _ in range(_MAX_PEOPLE):
        try:
            return sample_real_like_scene(layout, num_frames, rng=rng)
        except PoseError as error:
            reason = error
    raise PoseError(f"none of {_MAX_PEOPLE} people can do '{_REAL_LIKE}'; the last: {reason}") from reason


def moved(scene: SceneMotion, offsets: Float[np.ndarray, "T 3"]) -> SceneMotion:
    """The same motion somewhere else in each frame [m]."""
    hands = []
    for hand in scene.hands:
        qpos = hand.qpos.copy()
        qpos[:, :3] += offsets
        hands.append(GlovedHand(hand.fit, qpos))
    held = scene.moving_object
    if held is not None:
        poses = held.motion.T_world_body.copy()
        poses[:, :3, 3] += offsets
        held = dataclasses.replace(held, motion=BodyMotion(poses, held.motion.rate))
    return dataclasses.replace(scene, hands=tuple(hands), moving_object=held)


def work_of_take(take: Take, layout: MarkerLayout | None, num_frames: int) -> dict[str, list[SceneMotion]]:
    """The hands of a take where they were, in stretches in which every hand has a pose.

    Args:
        layout: Another glove for its hands; their own when not given.
        num_frames: Frames to use, from the first.

    Raises:
        CaptureError: There is no such stretch.
        LayoutError: The glove does not fit.
    """
    fits = [hand if layout is None else attach(layout, hand.model) for hand in take.hands]
    whole = np.isfinite(take.qpos).all(axis=(1, 2))
    scenes, left = [], num_frames
    for first, last in runs_of(whole):
        stretch = slice(first, last + 1)
        part = slice(stretch.start, min(stretch.stop, stretch.start + left))
        if part.stop - part.start >= _FEWEST:
            left -= part.stop - part.start
            scenes.append(_scene(take, fits, part))
    if not scenes:
        raise CaptureError(
            f"the take has no {_FEWEST} frames in a row in which every hand has a pose, expected some"
        )
    return {"the take": scenes}


def room_of_work(kind: str, scene: SceneMotion) -> RoomConfig:
    """The room of simulated takes of this kind of work, or of the kind most like it, as for a take."""
    if kind not in SIMULATED_KINDS:
        free = "hand-hand" if len(scene.hands) > 1 else "single-hand"
        kind = free if scene.moving_object is None else "hand-pen"
    return usual_room(cast("SimulatedKind", kind))


def _scene(take: Take, fits: list[GloveFit], part: slice) -> SceneMotion:
    hands = tuple(
        GlovedHand(fit, np.ascontiguousarray(take.qpos[part, number])) for number, fit in enumerate(fits)
    )
    held = None
    for number, body in enumerate(take.bodies):
        thing, poses = body.shape, take.body_poses[part, number]
        if held is None and thing is not None and np.isfinite(poses).all():
            held = MovingObject(thing, BodyMotion(pose_matrices(poses), take.rate))
    return SceneMotion(hands, held, take.rate)


def _walk(
    seconds: float, frames: int, sides: Float[np.ndarray, "3"], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Offsets (T, 3) [m] to and fro through the part of the volume that hands in its middle do not reach."""
    reach = np.maximum(0.0, np.asarray(sides) / 2 - HALF_SIDE)
    turns = seconds * np.linspace(0.0, 1.0, frames)[:, None] / _ROUND + rng.random(3)
    return np.asarray(reach * (4.0 * np.abs(turns % 1.0 - 0.5) - 1.0))


def checked_center(center: Sequence[float]) -> NDArray[np.float64]:
    """The middle of a volume (3,) [m].

    Raises:
        ArgumentError: It is not three numbers, or far from where hands and cameras are.
    """
    found = check_array("center", center, (3,))
    if (np.abs(found) >= _LONGEST).any():
        raise ArgumentError(
            f"center is {' '.join(f'{one:g}' for one in found)}, expected meters, each below {_LONGEST:g}"
        )
    return found


def checked_sides(name: str, sides: Sequence[float]) -> NDArray[np.float64]:
    """The sides of a volume or a room (3,) [m].

    Raises:
        ArgumentError: They are not three lengths.
    """
    found = check_array(name, sides, (3,))
    if not ((found > 0.0) & (found < _LONGEST)).all():
        raise ArgumentError(
            f"{name} is {' '.join(f'{one:g}' for one in found)}, expected three lengths in meters, each "
            f"above 0 and below {_LONGEST:g}"
        )
    return found
