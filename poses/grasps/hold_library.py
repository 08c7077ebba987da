"""Named ways to hold objects, from `data/holds.json`, and where they put an object in a certain hand.

Their joint angles are the mean hand's; retargeting brings another hand's fingertips to the same places.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.files.json_files import package_data
from handsim.hand.model import HandModel, join_qpos, skinned_jacobian
from handsim.hand.shape import BONE_NAMES, DIGITS, NUM_JOINTS, bones_of, shape_from_measures
from handsim.space.objects import RigidObject
from handsim.space.transforms import MIRROR, quaternion_matrix, vector_quaternions
from poses.grasps.grasp_scene import GraspScene
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture

_GAP: Final = 0.0005  # [m] between palm and object before the fingers close
_SLIDE: Final = 0.15  # [m] from where an object comes up to the palm
_HALVINGS: Final = 12
_ANY: Final = "any"  # the entry for objects that have none of their own
_ROUNDS: Final = 12
_STIFFNESS: Final = 0.006  # [m/rad]: residual of a tip that weighs as much as a joint's deviation
_LONGEST_STEP: Final = 0.2  # [rad]


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
    """Share of its weight with which the object lies in the palm while the fingers close."""
    needs: tuple[str, ...]
    """Bones or digits that must touch the object."""
    fingers: int
    """Number of fingers that must touch it."""
    free: tuple[str, ...]
    """Digits that may leave the object."""
    press: tuple[str, ...]
    """Digits that may tap on it."""
    scribble: float
    """Amplitude of a writing wrist [m]; 0 for objects that do not write."""
    entry: dict[str, Any]
    """The rest of its entry: placement, axes and variation."""


def hold_names(obj: RigidObject) -> tuple[str, ...]:
    """Names of the ways to hold an object; one loaded from a file has a single way, `"grasp"`."""
    return tuple(_holds(obj))


@lru_cache(maxsize=64)
def hold_style(model: HandModel, obj: RigidObject, name: str) -> HoldStyle:
    """A way to hold an object, with the angles that bring this hand's tips where the mean hand has them."""
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
    holds: dict[str, Any] = library.get(obj.name, library[_ANY])
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
    pose = np.eye(4)
    # Everything is placed for a right hand, then mirrored.
    if "between" in placement:
        at = np.mean([_landmark(model, bones, mark) for mark in placement["between"]], axis=0) @ mirror
        back = _landmark(model, bones, placement["through"]) @ mirror
        z = back - at
        x = _perpendicular(z, rng.uniform(0.0, 2 * np.pi))
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
    pose[:3, :3] = mirror @ rotation @ MIRROR if model.shape.side == "left" else rotation
    pose[:3, 3] = mirror @ (at - rotation @ point)
    pose = pose @ np.linalg.inv(frame)
    return pose if "between" in placement else _slid_to_palm(scene, style, pose)


def _box_frame(obj: RigidObject) -> NDArray[np.float64]:
    """Middle of an object's bounding box, x along its shortest side and z along its longest."""
    low, high = obj.vertices.min(axis=0), obj.vertices.max(axis=0)
    shortest, _, longest = np.argsort(high - low, kind="stable")
    x, z = np.eye(3)[shortest], np.eye(3)[longest]
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), (low + high) / 2
    return frame


def _perpendicular(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Unit vector (3,) perpendicular to an axis, at an angle [rad] about it."""
    axis = axis / np.linalg.norm(axis)
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    rotated: NDArray[np.float64] = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    return rotated


def _landmark(
    model: HandModel, bones: NDArray[np.float64], mark: tuple[str, float, float, float]
) -> NDArray[np.float64]:
    """Point on a bone in the wrist's frame (3,) [m], for either side."""
    name, along, sideways, back = mark
    number = BONE_NAMES.index(name)
    radius = model.capsules.radii[model.capsules.bones == number][0]
    sideways = -sideways if model.shape.side == "left" else sideways
    local = np.array([along * model.skeleton.lengths[number], sideways * radius, back * radius])
    world: NDArray[np.float64] = bones[number, :3, :3] @ local + bones[number, :3, 3]
    return world


def _slid_to_palm(scene: GraspScene, style: HoldStyle, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """`T_wrist_object` (4, 4) of the object raised from below until it almost touches the palm."""
    palm = [geom for geom in scene.hand_geoms if scene.mj_model.geom(geom).name.startswith("palm")]
    data = scene.new_data(style.open, pose)
    lowest = data.qpos[NUM_JOINTS + 2]

    def gap(height: float) -> float:
        data.qpos[NUM_JOINTS + 2] = lowest + height
        mujoco.mj_kinematics(scene.mj_model, data)
        return float(scene.distances(data, palm).min())

    low, high = -_SLIDE, 0.0  # free, too high
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if gap(middle) > _GAP else (low, middle)
    pose[2, 3] += low
    return pose


def retarget_angles(model: HandModel, angles: Float[np.ndarray, "P 20"]) -> Float[np.ndarray, "P 20"]:
    """Joint angles [rad] that bring the last joints and the tips of a hand where the mean hand has them.

    The mean hand has the same length and breadth. `angles` are its poses; the result differs as little from
    them as the other proportions need.
    """
    shape = model.shape
    mean = HandModel(shape_from_measures(shape.length, shape.breadth, side=shape.side))
    targets = _marks(mean, angles)[0]
    solutions = angles.copy()
    stiff = _STIFFNESS * np.eye(NUM_JOINTS)
    for _ in range(_ROUNDS):
        placed, jacobians = _marks(model, solutions)
        for number, jacobian in enumerate(jacobians):
            away = (targets - placed)[number].ravel()
            residuals = np.concatenate([away, _STIFFNESS * (angles - solutions)[number]])
            system = np.concatenate([jacobian.reshape(-1, NUM_JOINTS), stiff])
            step = np.linalg.lstsq(system, residuals, rcond=None)[0]
            solutions[number] += np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
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
