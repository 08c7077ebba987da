"""A hand as URDF: a link per bone, revolute joints, capsules as cylinders with a sphere at each end.

A bone with two joints has a link between them, `index_proximal_abduction`, which takes a hundredth of the
bone's mass and inertia, because simulators refuse links without any. The root link is the palm; a simulator
leaves it free, or fixes it, as it is told to.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Final

import numpy as np
from jaxtyping import Float

from handsim.hand.model import HandModel
from handsim.hand.topology import BONE_NAMES, BONES, JOINTS
from handsim.space.transforms import euler_angles, quaternion_matrix

_SMALL_SHARE: Final = 0.01
_MOST_TORQUE: Final = 2.0  # [N m], about that of a strong finger's first joint
_MOST_SPEED: Final = 40.0  # [rad/s], above that of the fastest fingers
_COLOR: Final = "0.85 0.65 0.55 1"


def hand_urdf(model: HandModel) -> str:
    """The text of a .urdf file: meters, radians, kilograms."""
    root = ET.Element("robot", name="hand")
    ET.SubElement(ET.SubElement(root, "material", name="skin"), "color", rgba=_COLOR)
    for number, bone in enumerate(BONES):
        hinges = [index for index, joint in enumerate(JOINTS) if joint.bone == number]
        links = [*(_middle_name(index) for index in hinges[:-1]), bone.name]
        shares = [_SMALL_SHARE] * (len(links) - 1) + [1.0 - _SMALL_SHARE * (len(links) - 1)]
        for link, share in zip(links, shares, strict=True):
            _add_link(root, model, number, link, share)
        for step, index in enumerate(hinges):
            parent = BONE_NAMES[bone.parent] if step == 0 else links[step - 1]
            _add_joint(root, model, index, parent, links[step], at_rest=step == 0)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _middle_name(joint: int) -> str:
    """The link between a bone's first joint and its second."""
    kind = JOINTS[joint].name.rpartition("_")[2]
    return f"{BONE_NAMES[JOINTS[joint].bone]}_{kind}"


def _add_link(root: ET.Element, model: HandModel, bone: int, name: str, share: float) -> None:
    """A link with a share of its bone's mass; the shapes belong to the bone's own link."""
    link = ET.SubElement(root, "link", name=name)
    compiled, body = model.mj_model, bone + 1  # the world is body 0
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=vector_text(compiled.body_ipos[body]), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=number_text(share * compiled.body_mass[body]))
    axes = quaternion_matrix(compiled.body_iquat[body])
    moments = share * axes @ np.diag(compiled.body_inertia[body]) @ axes.T
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: number_text(moments[at]) for key, at in entries.items()})
    if name != BONE_NAMES[bone]:
        return
    capsules = model.capsules
    for index in np.flatnonzero(capsules.bones == bone).tolist():
        start, end, radius = capsules.starts[index], capsules.ends[index], float(capsules.radii[index])
        for kind in ("visual", "collision"):
            _add_capsule(link, kind, start, end, radius)


def _add_capsule(
    link: ET.Element, kind: str, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float
) -> None:
    """A cylinder and two spheres, since URDF has no capsule."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    pitch, yaw = np.arccos(along[2]), np.arctan2(along[1], along[0])
    shapes = (
        ("cylinder", {"radius": number_text(radius), "length": number_text(length)}, 0.5 * (start + end)),
        ("sphere", {"radius": number_text(radius)}, start),
        ("sphere", {"radius": number_text(radius)}, end),
    )
    for shape, sizes, center in shapes:
        part = ET.SubElement(link, kind)
        turn = (
            f"0 {number_text(pitch)} {number_text(yaw)}" if shape == "cylinder" else "0 0 0"
        )  # z along the axis
        ET.SubElement(part, "origin", xyz=vector_text(center), rpy=turn)
        ET.SubElement(ET.SubElement(part, "geometry"), shape, sizes)
        if kind == "visual":
            ET.SubElement(part, "material", name="skin")


def _add_joint(
    root: ET.Element, model: HandModel, joint: int, parent: str, child: str, *, at_rest: bool
) -> None:
    """A hinge; the first of a bone stands at the bone's place at rest, the next one in the same place."""
    skeleton, bone = model.skeleton, JOINTS[joint].bone
    place, turn = np.zeros(3), np.zeros(3)
    if at_rest:
        place, turn = skeleton.offsets[bone], euler_angles(skeleton.rotations[bone][None])[0, ::-1]
    element = ET.SubElement(root, "joint", name=JOINTS[joint].name, type="revolute")
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=vector_text(place), rpy=vector_text(turn))
    ET.SubElement(element, "axis", xyz=vector_text(skeleton.axes[joint]))
    low, high = skeleton.ranges[joint]
    limits = {"lower": low, "upper": high, "effort": _MOST_TORQUE, "velocity": _MOST_SPEED}
    ET.SubElement(element, "limit", {key: number_text(value) for key, value in limits.items()})
    ET.SubElement(element, "dynamics", damping="0.01", friction="0")


def vector_text(vector: Float[np.ndarray, "K"]) -> str:
    """Numbers with blanks between them."""
    return " ".join(number_text(value) for value in vector)


def number_text(value: float) -> str:
    """A number with twelve digits; zero has no sign."""
    return f"{float(value) + 0.0:.12g}"
