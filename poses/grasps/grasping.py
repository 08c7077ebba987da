"""Grasps settled by dynamics: fingers close around an object until it stays even when shaken."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import PoseError
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, NUM_JOINTS
from handsim.space.objects import RigidObject
from poses.grasps.grasp_scene import MAX_OBJECT_PENETRATION, GraspScene, grasp_scene, pose_to_qpos
from poses.grasps.hold_library import HoldStyle, hold_names, hold_style, place_object
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.validity import is_valid

_MOST_TRIES: Final = 40
_LOOSENESS: Final = np.deg2rad([1.0, 2.0, 3.0, 4.0, 5.0])  # spread of the angles between tries
_RAMP: Final = 10  # pieces in which the motors' targets go from open to closed
_CLOSE, _SETTLE, _SHAKE, _REST = 400, 200, 60, 60  # steps of 2 ms
_GRAVITY: Final = 9.81
_TETRAHEDRON: Final = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
_MOST_DRIFT: Final = 0.004  # [m] while shaken
_MOST_ROTATION: Final = np.deg2rad(8.0)
_TOUCHING: Final = 0.0005  # [m]
_DEEPEST: Final = MAX_OBJECT_PENETRATION - 1e-5  # [m]
_SLOW: Final = 0.5  # [rad/s], of the hinges at the end


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """A grasp: a hand that holds an object."""

    name: str
    """The style of the hold, one of `hold_names`."""
    angles: Float[np.ndarray, "20"]
    """Joint angles [rad]."""
    T_wrist_object: Float[np.ndarray, "4 4"]
    """Pose of the object in the wrist's frame [m]."""
    contacts: tuple[str, ...]
    """Names of the hand's capsules that touch the object."""


def settle_hold(
    model: HandModel, obj: RigidObject, *, rng: np.random.Generator, hold: str | None = None
) -> Hold:
    """A valid grasp of an object: it is placed, fingers close under limited torque, and it is shaken.

    The hold is one of `hold_names`, a random one when not given.

    Raises:
        ArgumentError: The object has no hold of this name.
        PoseError: This hand does not get hold of it in forty tries.
    """
    names = hold_names(obj) if hold is None else (hold,)
    scene = grasp_scene(model, obj)
    why = ""
    for attempt in range(_MOST_TRIES):
        style = hold_style(model, obj, names[rng.integers(len(names))])
        settled = try_hold(scene, _varied(style, attempt, rng), rng=rng)
        if isinstance(settled, Hold):
            return settled
        why = settled
    raise PoseError(f"this hand does not get hold of the {obj.name} in {_MOST_TRIES} tries: {why}")


def _varied(style: HoldStyle, attempt: int, rng: np.random.Generator) -> HoldStyle:
    """The style with slightly different angles; the change grows with the number of failed tries."""
    spread = _LOOSENESS[min(attempt, len(_LOOSENESS) - 1)]
    change = spread * rng.standard_normal(NUM_JOINTS).clip(-2.0, 2.0)
    opened, closed = (np.clip(angles + change, LOW, HIGH) for angles in (style.open, style.closed))
    return dataclasses.replace(style, open=opened, closed=closed)


def try_hold(scene: GraspScene, style: HoldStyle, *, rng: np.random.Generator) -> Hold | str:
    """One try: a hold, or the reason why there is none."""
    start = place_object(scene, style, rng=rng)
    data = scene.new_data(style.open, start)
    _close(scene, data, style, start)
    _shake(scene, data)  # it settles
    before = scene.object_pose(data)
    _shake(scene, data)
    if not _stayed(scene, data, before):
        return "it slips"
    angles, pose = np.clip(data.qpos[:NUM_JOINTS], LOW, HIGH), scene.object_pose(data)
    if not is_valid(scene.hand, angles[None])[0]:
        return "the fingers penetrate each other"
    if scene.depth(angles[None], pose[None])[0] > _DEEPEST:
        return "the fingers penetrate it"
    distances = scene.distances(scene.new_data(angles, pose))
    names = [scene.mj_model.geom(geom).name for geom in scene.hand_geoms]
    contacts = tuple(name for name, distance in zip(names, distances, strict=True) if distance < _TOUCHING)
    why = why_not_held(style, set(contacts))
    if why:
        return why
    return Hold(style.name, angles, pose, contacts)


def why_not_held(style: HoldStyle, touching: set[str]) -> str:
    """What a hold by these capsules of the hand lacks; an empty string if it holds."""
    for need in style.needs:
        if not any(name.startswith(need) for name in touching):
            return f"the {need} does not touch it"
    fingers = sum(any(name.startswith(digit) for name in touching) for digit in DIGITS[1:])
    return "" if fingers >= style.fingers else "too few fingers touch it"


def _close(scene: GraspScene, data: mujoco.MjData, style: HoldStyle, start: NDArray[np.float64]) -> None:
    """Close the fingers; the object is first guided by a soft spring, then free, or lies in the palm."""
    model = scene.mj_model
    guide = pose_to_qpos(start)
    data.mocap_pos[0], data.mocap_quat[0] = guide[:3], guide[3:]
    data.eq_active[:] = 1
    body = model.body("object").id
    data.xfrc_applied[body, 2] = style.palm_up * scene.obj.mass * _GRAVITY
    for share in np.arange(1, _RAMP + 1) / _RAMP:
        _set_targets(scene, data, style, style.open + share * (style.closed - style.open))
        mujoco.mj_step(model, data, nstep=_CLOSE // _RAMP)
    data.eq_active[:] = 0
    for _ in range(_SETTLE // 25):
        _set_targets(scene, data, style, style.closed)
        mujoco.mj_step(model, data, nstep=25)
    data.xfrc_applied[body] = 0.0


def _set_targets(
    scene: GraspScene, data: mujoco.MjData, style: HoldStyle, target: NDArray[np.float64]
) -> None:
    """Set the motors' targets, so near to the joint angles that no torque exceeds the style's share.

    A motor at its torque limit would yield to any push; these keep their stiffness in both directions.
    """
    here = data.qpos[:NUM_JOINTS]
    limit = style.strength * scene.mj_model.actuator_forcerange[:, 1] / scene.mj_model.actuator_gainprm[:, 0]
    data.ctrl[:] = here + np.clip(target - here, -limit, limit)


def _shake(scene: GraspScene, data: mujoco.MjData) -> None:
    """Pull the object by its own weight towards the four corners of a tetrahedron, then let it rest."""
    body = scene.mj_model.body("object").id
    for corner in _TETRAHEDRON:
        data.xfrc_applied[body, :3] = scene.obj.mass * _GRAVITY * corner
        mujoco.mj_step(scene.mj_model, data, nstep=_SHAKE)
    data.xfrc_applied[body] = 0.0
    mujoco.mj_step(scene.mj_model, data, nstep=_REST)


def _stayed(scene: GraspScene, data: mujoco.MjData, before: NDArray[np.float64]) -> bool:
    """Whether the object is where it was, and the fingers are still."""
    after = scene.object_pose(data)
    drift = np.linalg.norm(after[:3, 3] - before[:3, 3])
    rotation = np.arccos(np.clip((np.trace(after[:3, :3].T @ before[:3, :3]) - 1) / 2, -1.0, 1.0))
    slow = np.abs(data.qvel[:NUM_JOINTS]).max() < _SLOW
    return bool(drift < _MOST_DRIFT and rotation < _MOST_ROTATION and slow and np.isfinite(data.qpos).all())
