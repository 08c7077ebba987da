"""A hand and an object in one MuJoCo scene: the wrist is fixed, the object is free, hinges have motors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, build_spec
from handsim.hand.shape import BONE_NAMES, BONES, JOINTS, NUM_JOINTS, NUM_QPOS, PALM
from handsim.space.objects import RigidObject
from handsim.space.transforms import quaternion_matrix, rotation_quaternions

MAX_OBJECT_PENETRATION: Final = 0.0015
"""Deepest overlap [m] of a hand and the object it holds that counts as valid."""
_TIMESTEP: Final = 0.002
_STIFFNESS: Final = 2.0  # [N m/rad]
_DAMPING: Final = 0.04  # [N m s/rad]
_ARMATURE: Final = 1e-4  # [kg m^2], tendons and muscles that move along
# Strongest torque [N m] of a finger's abduction, MCP, PIP and DIP, and of the thumb's four hinges.
_FINGER_TORQUES: Final = (0.20, 0.30, 0.16, 0.06)
_THUMB_TORQUES: Final = (0.40, 0.40, 0.25, 0.10)
_FRICTION: Final = (1.2, 0.01, 0.001)  # of a palm on plastic: sliding, twisting (by the pad's size), rolling
_CONTACT_TIME: Final = (0.005, 1.0)
_GUIDE_TIME: Final = (0.03, 1.0)  # of a soft constraint that holds the object while fingers close
_FAR: Final = 0.5  # [m], beyond which distances are not needed
_GEOMS: Final = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


class GraspScene:
    """One hand and one object, compiled. Poses are in the wrist's frame; the scene itself keeps no state."""

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
        data.qpos[NUM_JOINTS:] = pose_to_qpos(T_wrist_object)
        data.ctrl[:] = angles
        mujoco.mj_forward(self.mj_model, data)
        return data

    def object_pose(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """`T_wrist_object` of a state."""
        return qpos_to_pose(data.qpos[NUM_JOINTS:])

    def distances(self, data: mujoco.MjData, geoms: Sequence[int] | None = None) -> NDArray[np.float64]:
        """Distance [m] of some of the hand's capsules, or all, to the object (K,), negative inside it."""
        return np.array(
            [
                min(
                    mujoco.mj_geomDistance(self.mj_model, data, geom, part, _FAR, None)
                    for part in self.object_geoms
                )
                for geom in (self.hand_geoms if geoms is None else geoms)
            ]
        )

    def depth(
        self, angles: Float[np.ndarray, "T 20"], T_wrist_object: Float[np.ndarray, "T 4 4"]
    ) -> NDArray[np.float64]:
        """Deepest overlap [m] of hand and object in every frame (T,)."""
        data = mujoco.MjData(self.mj_model)
        qpos = np.concatenate([angles, pose_to_qpos(T_wrist_object)], axis=1)
        depth = np.zeros(len(qpos))
        first_object = self.object_geoms[0]
        for frame, row in enumerate(qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(self.mj_model, data)
            mujoco.mj_collision(self.mj_model, data)
            if data.ncon:
                contact = data.contact
                with_object = contact.geom.max(axis=1) >= first_object
                depth[frame] = max(0.0, -float(contact.dist[with_object].min(initial=0.0)))
        return depth


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
    qpos = check_array("qpos", qpos, (None, NUM_QPOS))
    poses = check_array("T_world_object", T_world_object, (None, 4, 4))
    if len(qpos) != len(poses):
        raise ArgumentError(
            f"qpos has {len(qpos)} frames and T_world_object {len(poses)}, expected equal numbers"
        )
    return grasp_scene(model, obj).depth(qpos[:, 7:], np.linalg.inv(wrist_poses(qpos)) @ poses)


def wrist_poses(qpos: Float[np.ndarray, "T 27"]) -> NDArray[np.float64]:
    """`T_world_wrist` (T, 4, 4) of poses."""
    poses = np.tile(np.eye(4), (len(qpos), 1, 1))
    poses[:, :3, :3] = quaternion_matrix(qpos[:, 3:7])
    poses[:, :3, 3] = qpos[:, :3]
    return poses


def pose_to_qpos(poses: Float[np.ndarray, "*batch 4 4"]) -> NDArray[np.float64]:
    """Position and wxyz quaternion (..., 7) of rigid transforms."""
    flat = poses.reshape(-1, 4, 4)
    rows = np.concatenate([flat[:, :3, 3], rotation_quaternions(flat[:, :3, :3])], axis=1)
    return rows.reshape(*poses.shape[:-2], 7)


def qpos_to_pose(qpos: Float[np.ndarray, "7"]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) of a position and a wxyz quaternion."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = quaternion_matrix(qpos[3:]), qpos[:3]
    return pose


def _build_scene_spec(model: HandModel, obj: RigidObject) -> mujoco.MjSpec:
    spec = build_spec(model.skeleton, model.capsules)
    spec.option.timestep = _TIMESTEP
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
        motor.set_to_position(kp=_STIFFNESS)
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
            type=_GEOMS[part.kind],
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
