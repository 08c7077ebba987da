"""A hand as a MuJoCo model: free joint, twenty hinges, capsules, one site per marker."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Float

from handsim.hand.capsules import Capsules
from handsim.hand.skeleton import Skeleton
from handsim.hand.topology import BONE_NAMES, BONES, JOINTS

if TYPE_CHECKING:
    import mujoco

FLESH_DENSITY: Final = 1100.0
"""Density of the hand [kg/m^3], soft tissue and bone together."""
CAPSULE_GROUP: Final = 0
SERVO_STIFFNESS: Final = 1.0
"""Torque of a servo per angle off its control [N m/rad]."""
SERVO_DAMPING: Final = 0.03
"""Torque of a servo against the speed of its joint [N m s/rad]."""


class Site(NamedTuple):
    """A named point on a bone, drawn as a small sphere."""

    name: str
    bone: int
    position: Float[np.ndarray, "3"]
    radius: float


def build_spec(
    skeleton: Skeleton,
    capsules: Capsules,
    *,
    sites: tuple[Site, ...] = (),
    actuators: bool = False,
) -> mujoco.MjSpec:
    """Editable MuJoCo specification of a hand; compile it, or write it with `.to_xml()`.

    With `actuators` each joint has a position servo of its name: a control is an angle [rad] within the
    joint's range.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "hand"
    spec.compiler.degree = False
    spec.option.gravity = np.zeros(3)
    bodies: list[mujoco.MjsBody] = []
    for number, bone in enumerate(BONES):
        parent = spec.worldbody if bone.parent < 0 else bodies[bone.parent]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, skeleton.rotations[number].ravel())
        body = parent.add_body(name=bone.name, pos=skeleton.offsets[number], quat=quaternion)
        if bone.parent < 0:
            body.add_freejoint(name="wrist")
        bodies.append(body)
    for number, joint in enumerate(JOINTS):
        bodies[joint.bone].add_joint(
            name=joint.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=skeleton.axes[number],
            range=skeleton.ranges[number],
            limited=True,
            damping=0.01,
        )
    if actuators:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # light bones with stiff servos
        for number, joint in enumerate(JOINTS):
            servo = spec.add_actuator(
                name=joint.name,
                target=joint.name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                ctrllimited=True,
                ctrlrange=skeleton.ranges[number],
            )
            servo.set_to_position(kp=SERVO_STIFFNESS, kv=SERVO_DAMPING)
    counts: dict[int, int] = {}
    for bone, start, end, radius in zip(
        capsules.bones, capsules.starts, capsules.ends, capsules.radii, strict=True
    ):
        counts[bone] = counts.get(bone, 0) + 1
        bodies[bone].add_geom(
            name=f"{BONE_NAMES[bone]}_{counts[bone]}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*start, *end],
            size=[radius, 0.0, 0.0],
            density=FLESH_DENSITY,
            group=CAPSULE_GROUP,
            rgba=[0.85, 0.65, 0.55, 1.0],
        )
    for site in sites:
        bodies[site.bone].add_site(
            name=site.name, pos=site.position, size=[site.radius] * 3, rgba=[0.9, 0.9, 0.95, 1.0]
        )
    return spec
