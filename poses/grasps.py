"""Grasps settled by dynamics: fingers close around an object until it stays even when shaken."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim._checks import check_choice
from handsim.errors import PoseError
from handsim.files.inputs import package_data
from handsim.hand.model import HandModel, build_spec, join_qpos, skinned_jacobian
from handsim.hand.shape import (
    BONE_NAMES,
    BONES,
    DIGITS,
    JOINTS,
    NUM_JOINTS,
    PALM,
    bones_of,
    shape_from_measures,
)
from handsim.space.objects import RigidObject
from handsim.space.transforms import (
    MIRROR,
    pose_matrices,
    quaternion_matrix,
    rigid,
    rotation_quaternions,
    transform_poses,
    vector_quaternions,
)
from poses.shapes import HIGH, LOW, gesture, is_valid

MAX_OBJECT_PENETRATION: Final = 0.0015
"""Deepest overlap [m] of a hand and the object it holds that counts as valid."""
_MOTOR_STIFFNESS: Final = 2.0  # [N m/rad]
_DAMPING: Final = 0.04  # [N m s/rad]
_ARMATURE: Final = 1e-4  # inertia of tendons and muscles [kg m^2]
# Largest torques [N m] of a finger's abduction, MCP, PIP and DIP, and of the thumb's four hinges.
_FINGER_TORQUES: Final = (0.20, 0.30, 0.16, 0.06)
_THUMB_TORQUES: Final = (0.40, 0.40, 0.25, 0.10)
_FRICTION: Final = (1.2, 0.01, 0.001)  # palm on plastic: sliding, twisting (by the pad's size), rolling
_CONTACT_TIME: Final = (0.005, 1.0)  # MuJoCo's solref of contacts: time constant [s], damping ratio
_GUIDE_TIME: Final = (0.03, 1.0)  # solref of the soft constraint that holds the object while fingers close
_MAX_DISTANCE: Final = 0.5  # largest distance of a capsule from the object that is measured [m]

_PALM_GAP: Final = 0.0005  # gap between palm and object before the fingers close [m]
_MAX_RAISE: Final = 0.15  # distance below the palm from which an object is raised [m]
_ANY_OBJECT: Final = "any"  # library entry for objects without an entry of their own
_ANGLE_WEIGHT: Final = 0.006  # weight of joint deviations against residuals of the tips [m/rad]
_MAX_STEP: Final = 0.2  # largest change of an angle in an iteration [rad]

_MAX_TRIES: Final = 40
_TRY_SPREADS: Final = np.deg2rad([1.0, 2.0, 3.0, 4.0, 5.0])  # deviation of angles in tries 1, 2, 3, 4, later
_RAMP_STEPS: Final = 10  # number of steps of the motors' targets from open to closed
_CLOSE_STEPS, _SETTLE_STEPS, _SHAKE_STEPS, _REST_STEPS = 400, 200, 60, 60  # steps of 2 ms
_GRAVITY: Final = 9.81
_TETRAHEDRON: Final = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
_MAX_DRIFT: Final = 0.004  # largest displacement of the shaken object [m]
_MAX_ROTATION: Final = np.deg2rad(8.0)  # largest rotation of the shaken object
_MAX_CONTACT_GAP: Final = 0.0005  # largest distance of two bodies in contact [m]
_MAX_SETTLED_DEPTH: Final = MAX_OBJECT_PENETRATION - 1e-5  # [m]
_MAX_FINAL_SPEED: Final = 0.5  # [rad/s] of the hinges

_MAX_HELD_DEPTH: Final = MAX_OBJECT_PENETRATION - 1e-6  # [m], with a margin for rounding in the world's frame
_LIFT_CHANCE: Final = 0.55  # chance that a free digit lifts off the object
_TAP_CHANCE: Final = 0.3  # chance that a digit that may tap taps
_STILL_CHANCE: Final = 0.3  # chance that the object does not move in the hand
# Largest opening of a lifted or tapping thumb (first row) and finger: abduction (both ways), MCP, PIP, DIP.
_MAX_LIFT: Final = np.deg2rad([[14.0, 30.0, 20.0, 25.0], [5.0, 45.0, 45.0, 30.0]])
_MAX_TAP: Final = np.deg2rad([[4.0, 10.0, 6.0, 8.0], [1.0, 14.0, 10.0, 6.0]])
_JOINT_TREMBLE: Final = np.deg2rad([0.5, 1.2, 1.8, 1.8])  # standard deviations of joints of digits that hold
_OBJECT_WOBBLE: Final = (0.0006, np.deg2rad(1.2))  # standard deviations of the object in the hand: [m], [rad]


class GraspScene:
    """A compiled model of one hand and one object, without a state; poses are in the wrist's frame."""

    def __init__(self, model: HandModel, obj: RigidObject) -> None:
        self.hand = model
        self.obj = obj
        self.mj_model: mujoco.MjModel = _build_scene_spec(model, obj).compile()
        geoms = [self.mj_model.geom(number) for number in range(self.mj_model.ngeom)]
        self.object_geoms = [geom.id for geom in geoms if geom.name.startswith("object_")]
        self.hand_geoms = [geom.id for geom in geoms if not geom.name.startswith("object_")]

    def new_data(
        self, angles: Float[np.ndarray, "20"], T_wrist_object: Float[np.ndarray, "4 4"]
    ) -> mujoco.MjData:
        """New MuJoCo state at a pose [rad], [m], with kinematics and contacts computed."""
        data = mujoco.MjData(self.mj_model)
        data.eq_active[:] = 0
        data.qpos[:NUM_JOINTS] = angles
        data.qpos[NUM_JOINTS:] = transform_poses(T_wrist_object[None])[0]
        data.ctrl[:] = angles
        mujoco.mj_forward(self.mj_model, data)
        return data

    def object_pose(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """`T_wrist_object` of a state."""
        return np.asarray(pose_matrices(data.qpos[None, NUM_JOINTS:])[0])

    def distances(self, data: mujoco.MjData, geoms: Sequence[int] | None = None) -> NDArray[np.float64]:
        """Distance [m] of some of the hand's capsules, or all, to the object (K,), negative inside it."""

        def distance(geom: int, part: int) -> float:
            return float(mujoco.mj_geomDistance(self.mj_model, data, geom, part, _MAX_DISTANCE, None))

        hand = self.hand_geoms if geoms is None else geoms
        return np.array([min(distance(geom, part) for part in self.object_geoms) for geom in hand])

    def touching(
        self, angles: Float[np.ndarray, "20"], T_wrist_object: Float[np.ndarray, "4 4"], gap: float
    ) -> tuple[str, ...]:
        """Names of the hand's capsules that are nearer to the object than `gap` [m]."""
        distances = self.distances(self.new_data(angles, T_wrist_object))
        pairs = zip(self.hand_geoms, distances, strict=True)
        return tuple(self.mj_model.geom(geom).name for geom, distance in pairs if distance < gap)

    def depth(
        self, angles: Float[np.ndarray, "T 20"], T_wrist_object: Float[np.ndarray, "T 4 4"]
    ) -> NDArray[np.float64]:
        """Deepest overlap [m] of hand and object in every frame (T,)."""
        model = self._without_own_contacts
        data = mujoco.MjData(model)
        pose, depth = data.qpos, np.zeros(len(angles))
        for frame, row in enumerate(np.concatenate([angles, transform_poses(T_wrist_object)], axis=1)):
            pose[:] = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                depth[frame] = max(0.0, -float(data.contact.dist.min()))
        return depth

    @cached_property
    def _without_own_contacts(self) -> mujoco.MjModel:
        """The model without contacts of the hand with itself."""
        model = copy.copy(self.mj_model)
        model.geom_conaffinity[self.hand_geoms] = 0
        model.geom_contype[self.object_geoms] = 0
        return model


@lru_cache(maxsize=16)
def grasp_scene(model: HandModel, obj: RigidObject) -> GraspScene:
    """The scene of a hand and an object, compiled once."""
    return GraspScene(model, obj)


def object_penetration(
    model: HandModel,
    obj: RigidObject,
    qpos: Float[np.ndarray, "T 27"],
    T_world_object: Float[np.ndarray, "T 4 4"],
) -> Float[np.ndarray, "T"]:
    """Deepest overlap [m] of hand and object in each frame; 0 where they do not touch."""
    return grasp_scene(model, obj).depth(
        qpos[:, 7:], np.linalg.inv(pose_matrices(qpos[:, :7])) @ T_world_object
    )


def _build_scene_spec(model: HandModel, obj: RigidObject) -> mujoco.MjSpec:
    spec = build_spec(model.skeleton, model.capsules)
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 5.0
    spec.delete(spec.joint("wrist"))
    # With the palm fixed to the world, MuJoCo no longer treats it as the fingers' parent.
    for bone in BONES:
        if bone.parent == PALM:
            spec.add_exclude(bodyname1=BONE_NAMES[PALM], bodyname2=bone.name)
    for geom in spec.geoms:
        geom.condim, geom.friction, geom.solref = 4, _FRICTION, _CONTACT_TIME
    for number, joint in enumerate(JOINTS):
        hinge = spec.joint(joint.name)
        hinge.armature, hinge.damping = _ARMATURE, [_DAMPING, 0.0, 0.0]
        torque = (_THUMB_TORQUES if number < 4 else _FINGER_TORQUES)[number % 4]
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_position(kp=_MOTOR_STIFFNESS)
        motor.forcelimited, motor.forcerange = True, [-torque, torque]
    _add_object(spec, obj)
    return spec


def _add_object(spec: mujoco.MjSpec, obj: RigidObject) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint(name="object")
    middle = (obj.vertices.min(axis=0) + obj.vertices.max(axis=0)) / 2
    half = np.ptp(obj.vertices, axis=0) / 2
    # Inertia of the bounding box: exact enough, and never degenerate.
    squares = half**2
    body.mass, body.ipos, body.explicitinertial = obj.mass, middle, True
    body.inertia = obj.mass / 3 * (squares.sum() - squares) + 1e-6
    for number, part in enumerate(obj.parts):
        geom = body.add_geom(
            name=f"object_{number}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}"),
            pos=part.T_object_part[:3, 3],
            quat=rotation_quaternions(part.T_object_part[None, :3, :3])[0],
            condim=4,
            friction=_FRICTION,
            solref=_CONTACT_TIME,
        )
        if part.kind == "mesh":
            spec.add_mesh(name=f"object_{number}", uservert=part.vertices.ravel())
            geom.meshname = f"object_{number}"
        else:
            geom.size = part.size
    spec.worldbody.add_body(name="guide", mocap=True)
    spec.add_equality(
        name="guide",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="object",
        name2="guide",
        solref=_GUIDE_TIME,
    )


@dataclass(frozen=True, slots=True, eq=False)
class HoldStyle:
    """One way to hold one object."""

    name: str
    open: Float[np.ndarray, "20"]
    """Angles [rad] before the fingers close."""
    closed: Float[np.ndarray, "20"]
    """Angles that the motors close to [rad]."""
    strength: Float[np.ndarray, "20"]
    """Share of the motors' torques."""
    palm_up: float
    """Share of the object's weight that presses it into the palm while the fingers close."""
    needs: tuple[str, ...]
    """Bones or digits that must touch the object."""
    fingers: int
    """Number of fingers that must touch the object."""
    free: tuple[str, ...]
    """Digits that may leave the object."""
    press: tuple[str, ...]
    """Digits that may tap on the object."""
    scribble: float
    """Amplitude of a writing wrist [m]; 0 for objects that do not write."""
    entry: dict[str, Any]
    """The entry in the library, with placement, axes and variation."""


def hold_names(obj: RigidObject) -> tuple[str, ...]:
    """Names of the ways to hold an object; an object loaded from a file has one, `"grasp"`."""
    return tuple(_holds(obj))


@lru_cache(maxsize=64)
def hold_style(model: HandModel, obj: RigidObject, name: str) -> HoldStyle:
    """A way to hold an object, with the angles retargeted to this hand."""
    holds = _holds(obj)
    check_choice(name, holds, noun=f"hold of the {obj.name}")
    entry = holds[name]
    opened = _angles(gesture(entry["open"]["gesture"]), entry["open"])
    fitted = retarget_angles(model, np.stack([opened, _angles(opened, entry["closed"])]))
    return HoldStyle(
        name=name,
        open=fitted[0],
        closed=fitted[1],
        strength=np.repeat(entry["strength"], 4),
        palm_up=entry["palm_up"],
        needs=tuple(entry["needs"]),
        fingers=entry["fingers"],
        free=tuple(entry["free"]),
        press=tuple(entry["press"]),
        scribble=1e-3 * entry.get("scribble", 0.0),
        entry=entry,
    )


def _holds(obj: RigidObject) -> dict[str, Any]:
    library = package_data("poses", "holds")["objects"]
    holds: dict[str, Any] = library.get(obj.name, library[_ANY_OBJECT])
    return holds


def _angles(start: NDArray[np.float64], digits: dict[str, Any]) -> NDArray[np.float64]:
    angles = start.copy()
    for number, digit in enumerate(DIGITS):
        if digit in digits:
            angles[4 * number : 4 * number + 4] = np.deg2rad(digits[digit])
    return angles


def place_object(scene: GraspScene, style: HoldStyle, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """`T_wrist_object` (4, 4) before the fingers close, varied at random within the style."""
    model, obj, entry = scene.hand, scene.obj, style.entry
    mirror = MIRROR if model.shape.side == "left" else np.eye(3)
    placement, vary = entry["place"], entry["vary"]
    frame = np.eye(4) if obj.name in package_data("poses", "holds")["objects"] else _box_frame(obj)
    point = 1e-3 * np.array(placement["point"], dtype=np.float64)
    point[2] += 1e-3 * rng.uniform(*vary["along"])
    bones = model.forward_kinematics(join_qpos(style.open[None]))[0]
    # Everything is placed for a right hand, then mirrored.
    if "between" in placement:
        at = np.mean([_landmark(model, bones, mark) for mark in placement["between"]], axis=0) @ mirror
        back = _landmark(model, bones, placement["through"]) @ mirror
        z = back - at
        angle, axis = rng.uniform(0.0, 2 * np.pi), z / np.linalg.norm(z)
        x = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])  # perpendicular to z, at a random angle
        x /= np.linalg.norm(x)
        x = np.cos(angle) * x + np.sin(angle) * np.cross(axis, x)
    else:
        length, breadth = model.shape.length, model.shape.breadth
        at = np.array([placement["under"][0] * length, placement["under"][1] * breadth, 0.0])
        x, z = (np.array(entry["axes"][name], dtype=np.float64) for name in "xz")
    z /= np.linalg.norm(z)
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    rotation = np.stack([np.cross(y, z), y, z], axis=1)
    jitter = vector_quaternions(np.deg2rad(vary["angle"]) * np.clip(rng.standard_normal((1, 3)), -1.5, 1.5))
    rotation = quaternion_matrix(jitter)[0] @ rotation
    at = at + 1e-3 * vary["place"] * np.clip(rng.standard_normal(3), -1.5, 1.5)
    position = mirror @ (at - rotation @ point)
    rotation = mirror @ rotation @ MIRROR if model.shape.side == "left" else rotation
    pose = rigid(rotation, position) @ np.linalg.inv(frame)
    return pose if "between" in placement else _raised_to_palm(scene, style, pose)


def _box_frame(obj: RigidObject) -> NDArray[np.float64]:
    """Frame in the middle of an object's bounding box, x along its shortest side and z along its longest."""
    low, high = obj.vertices.min(axis=0), obj.vertices.max(axis=0)
    shortest, _, longest = np.argsort(high - low, kind="stable")
    x, z = np.eye(3)[shortest], np.eye(3)[longest]
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), (low + high) / 2)


def _landmark(
    model: HandModel, bones: NDArray[np.float64], mark: tuple[str, float, float, float]
) -> NDArray[np.float64]:
    """Point on a bone in the wrist's frame (3,) [m], for either side."""
    name, along, sideways, back = mark
    number = BONE_NAMES.index(name)
    radius = model.capsules.radii[model.capsules.bones == number][0]
    sideways = -sideways if model.shape.side == "left" else sideways
    local = np.array([along * model.skeleton.lengths[number], sideways * radius, back * radius])
    return np.asarray(bones[number, :3, :3] @ local + bones[number, :3, 3])


def _raised_to_palm(scene: GraspScene, style: HoldStyle, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """`T_wrist_object` (4, 4) of the object raised from below until it almost touches the palm."""
    palm = [geom for geom in scene.hand_geoms if scene.mj_model.geom(geom).name.startswith("palm")]
    data = scene.new_data(style.open, pose)
    lowest = data.qpos[NUM_JOINTS + 2]
    low, high = -_MAX_RAISE, 0.0  # heights at which the object is free, and too high
    for _ in range(12):
        middle = (low + high) / 2
        data.qpos[NUM_JOINTS + 2] = lowest + middle
        mujoco.mj_kinematics(scene.mj_model, data)
        is_free = scene.distances(data, palm).min() > _PALM_GAP
        low, high = (middle, high) if is_free else (low, middle)
    pose[2, 3] += low
    return pose


def retarget_angles(model: HandModel, angles: Float[np.ndarray, "P 20"]) -> Float[np.ndarray, "P 20"]:
    """Joint angles [rad] that bring last joints and tips to their positions in the mean hand of this size.

    `angles` are poses of the mean hand; the result stays near them.
    """
    shape = model.shape
    mean = HandModel(shape_from_measures(shape.length, shape.breadth, side=shape.side))
    targets = _marks(mean, angles)[0]
    solutions = angles.copy()
    stiff = _ANGLE_WEIGHT * np.eye(NUM_JOINTS)
    for _ in range(12):
        placed, jacobians = _marks(model, solutions)
        for number, jacobian in enumerate(jacobians):
            away = (targets - placed)[number].ravel()
            residuals = np.concatenate([away, _ANGLE_WEIGHT * (angles - solutions)[number]])
            system = np.concatenate([jacobian.reshape(-1, NUM_JOINTS), stiff])
            step = np.linalg.lstsq(system, residuals, rcond=None)[0]
            solutions[number] += np.clip(step, -_MAX_STEP, _MAX_STEP)
        solutions = np.clip(solutions, LOW, HIGH)
    return solutions


def _marks(model: HandModel, angles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Last joints and tips (P, 10, 3) in the wrist's frame [m]; Jacobians (P, 10, 3, 20) [m/rad]."""
    last = np.array([bones_of(digit)[2] for digit in DIGITS])
    rest = model.rest_transforms[last]
    tips = rest[:, :3, 3] + model.skeleton.lengths[last, None] * rest[:, :3, 0]
    points = np.concatenate([rest[:, :3, 3], tips])
    indices = np.zeros((len(points), 4), dtype=np.int64)
    indices[:, 0] = np.tile(last, 2)
    weights = np.zeros((len(points), 4))
    weights[:, 0] = 1.0
    bones = model.forward_kinematics(join_qpos(angles))
    carried = bones[:, indices[:, 0]] @ np.linalg.inv(model.rest_transforms[indices[:, 0]])
    placed = np.einsum("pmij,mj->pmi", carried[..., :3, :3], points) + carried[..., :3, 3]
    return placed, skinned_jacobian(model, bones, points, indices, weights)[..., 6:]


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """A grasp: a hand that holds an object."""

    name: str
    """One of `hold_names`."""
    angles: Float[np.ndarray, "20"]
    """Joint angles [rad]."""
    T_wrist_object: Float[np.ndarray, "4 4"]
    """Pose of the object in the wrist's frame [m]."""
    contacts: tuple[str, ...]
    """Names of the hand's capsules that touch the object."""


def settle_hold(
    model: HandModel, obj: RigidObject, *, rng: np.random.Generator, hold: str | None = None
) -> Hold:
    """Simulate grasps until one is valid: place the object, close the fingers with limited torque, shake it.

    The hold is one of `hold_names`, by default a random one.
    """
    names = hold_names(obj) if hold is None else (hold,)
    scene = grasp_scene(model, obj)
    why = ""
    for attempt in range(_MAX_TRIES):
        style = hold_style(model, obj, names[rng.integers(len(names))])
        spread = _TRY_SPREADS[min(attempt, len(_TRY_SPREADS) - 1)]
        change = spread * rng.standard_normal(NUM_JOINTS).clip(-2.0, 2.0)
        opened, closed = (np.clip(angles + change, LOW, HIGH) for angles in (style.open, style.closed))
        settled = try_hold(scene, dataclasses.replace(style, open=opened, closed=closed), rng=rng)
        if isinstance(settled, Hold):
            return settled
        why = settled
    raise PoseError(f"this hand does not get hold of the {obj.name} in {_MAX_TRIES} tries: {why}")


def try_hold(scene: GraspScene, style: HoldStyle, *, rng: np.random.Generator) -> Hold | str:
    """Try to settle a hold; returns it, or the reason why there is none."""
    start = place_object(scene, style, rng=rng)
    data = scene.new_data(style.open, start)
    _close_hand(scene, data, style, start)
    _shake_object(scene, data)  # a first shake lets the object settle
    before = scene.object_pose(data)
    _shake_object(scene, data)
    pose = scene.object_pose(data)
    drift = np.linalg.norm(pose[:3, 3] - before[:3, 3])
    rotation = np.arccos(np.clip((np.trace(pose[:3, :3].T @ before[:3, :3]) - 1) / 2, -1.0, 1.0))
    speed = np.abs(data.qvel[:NUM_JOINTS]).max()
    is_still = drift < _MAX_DRIFT and rotation < _MAX_ROTATION and speed < _MAX_FINAL_SPEED
    if not (is_still and np.isfinite(data.qpos).all()):
        return "it slips"
    angles = np.clip(data.qpos[:NUM_JOINTS], LOW, HIGH)
    if not is_valid(scene.hand, angles[None])[0]:
        return "the fingers penetrate each other"
    if scene.depth(angles[None], pose[None])[0] > _MAX_SETTLED_DEPTH:
        return "the fingers penetrate it"
    contacts = scene.touching(angles, pose, _MAX_CONTACT_GAP)
    return why_not_held(style, contacts) or Hold(style.name, angles, pose, contacts)


def why_not_held(style: HoldStyle, touching: Sequence[str]) -> str:
    """The reason why these touching capsules do not hold the object; empty if they hold it."""
    for need in style.needs:
        if not any(name.startswith(need) for name in touching):
            return f"the {need} does not touch it"
    fingers = sum(any(name.startswith(digit) for name in touching) for digit in DIGITS[1:])
    return "" if fingers >= style.fingers else "too few fingers touch it"


def _close_hand(scene: GraspScene, data: mujoco.MjData, style: HoldStyle, start: NDArray[np.float64]) -> None:
    """Close the fingers around the object, which a soft spring guides at first."""
    model = scene.mj_model
    guide = transform_poses(start[None])[0]
    data.mocap_pos[0], data.mocap_quat[0] = guide[:3], guide[3:]
    data.eq_active[:] = 1
    body = model.body("object").id
    data.xfrc_applied[body, 2] = style.palm_up * scene.obj.mass * _GRAVITY
    for share in np.arange(1, _RAMP_STEPS + 1) / _RAMP_STEPS:
        _set_targets(scene, data, style, style.open + share * (style.closed - style.open))
        mujoco.mj_step(model, data, nstep=_CLOSE_STEPS // _RAMP_STEPS)
    data.eq_active[:] = 0
    for _ in range(_SETTLE_STEPS // 25):
        _set_targets(scene, data, style, style.closed)
        mujoco.mj_step(model, data, nstep=25)
    data.xfrc_applied[body] = 0.0


def _set_targets(
    scene: GraspScene, data: mujoco.MjData, style: HoldStyle, target: NDArray[np.float64]
) -> None:
    """Set the motors' targets near the joint angles, so that torques stay within the style's strength.

    Unlike a motor at its torque limit, such a motor stays stiff in both directions.
    """
    angles = data.qpos[:NUM_JOINTS]
    limit = style.strength * scene.mj_model.actuator_forcerange[:, 1] / scene.mj_model.actuator_gainprm[:, 0]
    data.ctrl[:] = angles + np.clip(target - angles, -limit, limit)


def _shake_object(scene: GraspScene, data: mujoco.MjData) -> None:
    """Pull the object with its own weight in the four directions of a tetrahedron, then let it rest."""
    body = scene.mj_model.body("object").id
    for corner in _TETRAHEDRON:
        data.xfrc_applied[body, :3] = scene.obj.mass * _GRAVITY * corner
        mujoco.mj_step(scene.mj_model, data, nstep=_SHAKE_STEPS)
    data.xfrc_applied[body] = 0.0
    mujoco.mj_step(scene.mj_model, data, nstep=_REST_STEPS)


class Held(NamedTuple):
    """Poses of a hand and the object it holds."""

    angles: NDArray[np.float64]
    """Joint angles (B, 20) [rad]."""
    poses: NDArray[np.float64]
    """`T_wrist_object` (B, 4, 4) [m]."""


def sample_held_poses(
    model: HandModel, obj: RigidObject, hold: Hold, count: int, *, rng: np.random.Generator
) -> Held:
    """Valid variants of a hold: free digits lift, others tap or press, and the object tilts a little."""
    scene, style = grasp_scene(model, obj), hold_style(model, obj, hold.name)
    start = Held(hold.angles[None], hold.T_wrist_object[None])
    if not is_held_valid(scene, start)[0]:
        raise PoseError(f"the hold '{hold.name}' is not valid for this hand and the {obj.name}")
    angles = np.clip(hold.angles + _deviations(style, count, rng), LOW, HIGH)
    poses = np.tile(hold.T_wrist_object, (count, 1, 1))
    shift, rotation = (scale * rng.standard_normal((count, 3)).clip(-2.0, 2.0) for scale in _OBJECT_WOBBLE)
    still = rng.random(count) < _STILL_CHANCE
    shift[still], rotation[still] = 0.0, 0.0
    poses[:, :3, 3] += shift
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(rotation).as_matrix()
    target = Held(angles, poses)
    # Bisect the paths from the hold to poses that penetrate, so that they end at the contact.
    share = np.where(is_held_valid(scene, target), 1.0, 0.0)
    step = 1.0
    todo = np.flatnonzero(share == 0.0)
    for _ in range(4 if len(todo) else 0):
        step /= 2
        nearer = interpolate_held(start, Held(*(part[todo] for part in target)), share[todo] + step)
        share[todo] += np.where(is_held_valid(scene, nearer), step, 0.0)
    return interpolate_held(start, target, share)


def interpolate_held(start: Held, end: Held, share: NDArray[np.float64]) -> Held:
    """Interpolate held poses at shares (B,) of the paths from one start to one end or B ends."""
    angles = start.angles + share[:, None] * (end.angles - start.angles)
    positions = start.poses[:, :3, 3] + share[:, None] * (end.poses - start.poses)[:, :3, 3]
    rotations = Rotation.from_rotvec(share[:, None] * rotation_between(start, end)).as_matrix()
    return Held(angles, rigid(start.poses[:, :3, :3] @ rotations, positions))


def rotation_between(start: Held, end: Held) -> NDArray[np.float64]:
    """Rotation vectors (B, 3) [rad] from the start to the end, in the object's frame."""
    relative = np.swapaxes(start.poses[:, :3, :3], 1, 2) @ end.poses[:, :3, :3]
    return np.asarray(Rotation.from_matrix(relative).as_rotvec())


def is_held_valid(scene: GraspScene, held: Held) -> Bool[np.ndarray, "B"]:
    """Whether each pose is in range and penetrates neither the hand nor the object."""
    valid: NDArray[np.bool_] = is_valid(scene.hand, held.angles)
    valid[valid] = scene.depth(held.angles[valid], held.poses[valid]) <= _MAX_HELD_DEPTH
    return valid


def _deviations(style: HoldStyle, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Deviation (count, 20) [rad] of every joint from the hold: positive is flexion and abduction."""
    deviations = _JOINT_TREMBLE * rng.standard_normal((count, len(DIGITS), 4)).clip(-2.0, 2.0)
    for index, digit in enumerate(DIGITS):
        kind = min(index, 1)
        kinds = (style.press, _MAX_TAP, _TAP_CHANCE), (style.free, _MAX_LIFT, _LIFT_CHANCE)
        for digits, most, chance in kinds:
            if digit not in digits:
                continue
            lifts = rng.random(count) < chance
            opening = -most[kind] * rng.uniform(0.0, 1.0, (count, 4)) ** np.array([1.0, 0.7, 0.7, 1.0])
            opening[:, 0] = most[kind, 0] * rng.uniform(-1.0, 1.0, count)
            deviations[lifts, index] = opening[lifts]
    return np.asarray(deviations.reshape(count, NUM_JOINTS))
