"""A hand as URDF and as an OpenSim model, .osim.

URDF has a link per bone, revolute joints, and capsules as cylinders with a sphere at each end. A bone with
two joints has a link between them, `index_proximal_abduction`, which takes a hundredth of the bone's mass and
inertia, because simulators refuse links without any. The root link is the palm, which a simulator leaves free
or fixes.

OpenSim's model has a body per bone, custom joints, capsules and markers. Its coordinates are those of the
`.mot` that `handsim.motion_files` writes: `right_wrist_tx` to `tz` [m], `right_wrist_rx` to `rz` (rotations
about x, y and z of the body, in this order), then `right_` and the name of each joint. A bone with two joints
is moved by one custom joint about both axes, the first one first. The ground has y up, as OpenSim's window
and gravity.

A forearm with markers is one more body. It is tracked by itself, so its joint with the palm has all six
coordinates: `right_wrist_flexion`, `right_wrist_radial_deviation` and `right_wrist_rotation` turn the palm in
the forearm's frame, as the ISB's angles do; `right_forearm_tx` to `tz` [m] place the forearm in the palm's.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.angles import wrist_cardan
from handsim.hand.capsules import Capsules
from handsim.hand.model import (
    FLESH_DENSITY,
    KEYPOINT_BONES,
    KEYPOINT_NAMES,
    HandModel,
    Site,
    hand_keypoints,
    join_qpos,
)
from handsim.hand.shape import BONE_NAMES, BONES, JOINT_NAMES, JOINTS, NUM_JOINTS, PALM, Side
from handsim.space.transforms import (
    UpAxis,
    body_fixed_angles,
    euler_angles,
    file_axes,
    quaternion_matrix,
    rigid,
)

_BETWEEN_SHARE: Final = 0.01  # share of a bone's mass that the link between its two joints has
_MAX_TORQUE: Final = 2.0  # [N m], about that of a strong finger's first joint
_MAX_SPEED: Final = 40.0  # [rad/s], above that of the fastest fingers
_URDF_COLOR: Final = "0.85 0.65 0.55 1"
_OSIM_VERSION: Final = "40000"  # version of documents that OpenSim 4.0 and later read
_GRAVITY: Final = "0 -9.80665 0"  # in OpenSim's world, whose y axis points up
_OSIM_COLOR: Final = "0.85 0.65 0.55"
_MAX_POSITION: Final = 5.0  # range of the wrist's positions, both ways [m]
_MAX_ROTATION: Final = 2.0 * np.pi  # range of the wrist's rotations, both ways [rad]
_FOREARM_COORDINATES: Final = (
    *("wrist_flexion", "wrist_radial_deviation", "wrist_rotation"),
    *(f"forearm_t{axis}" for axis in "xyz"),
)
_MAX_COSINE: Final = 0.5  # largest cosine between two axes of one joint


def hand_urdf(model: HandModel) -> str:
    """The text of a .urdf file: meters, radians, kilograms."""
    root = ET.Element("robot", name="hand")
    ET.SubElement(ET.SubElement(root, "material", name="skin"), "color", rgba=_URDF_COLOR)
    for number, bone in enumerate(BONES):
        hinges = [index for index, joint in enumerate(JOINTS) if joint.bone == number]
        kinds = [JOINTS[index].name.rpartition("_")[2] for index in hinges[:-1]]
        links = [*(f"{bone.name}_{kind}" for kind in kinds), bone.name]
        shares = [_BETWEEN_SHARE] * (len(links) - 1) + [1.0 - _BETWEEN_SHARE * (len(links) - 1)]
        for link, share in zip(links, shares, strict=True):
            _add_link(root, model, number, link, share)
        for step, index in enumerate(hinges):
            parent = BONE_NAMES[bone.parent] if step == 0 else links[step - 1]
            _add_joint(root, model, index, parent, links[step], at_rest=step == 0)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _add_link(root: ET.Element, model: HandModel, bone: int, name: str, share: float) -> None:
    """Add a link with a share of its bone's mass; only the bone's own link has shapes."""
    link = ET.SubElement(root, "link", name=name)
    mass, center, moments = _inertia(model, bone)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=vector_text(center), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=number_text(share * mass))
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: number_text(share * moments[at]) for key, at in entries.items()})
    if name != BONE_NAMES[bone]:
        return
    for index in np.flatnonzero(model.capsules.bones == bone).tolist():
        for kind in ("visual", "collision"):
            _add_capsule(link, kind, model.capsules, index)


def _inertia(model: HandModel, bone: int) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass [kg], center of mass [m] and inertia [kg m^2] of a bone, in its frame."""
    compiled, body = model.mj_model, bone + 1  # the world is body 0
    axes = quaternion_matrix(compiled.body_iquat[body])
    moments = axes @ np.diag(compiled.body_inertia[body]) @ axes.T
    return compiled.body_mass[body], compiled.body_ipos[body], moments


def _add_capsule(link: ET.Element, kind: str, capsules: Capsules, index: int) -> None:
    """Add a capsule as a cylinder and two spheres, because URDF has no capsules."""
    start, end, radius = capsules.starts[index], capsules.ends[index], capsules.radii[index]
    length = np.linalg.norm(end - start)
    along = (end - start) / length
    pitch, yaw = np.arccos(along[2]), np.arctan2(along[1], along[0])
    shapes = (
        ("cylinder", {"radius": number_text(radius), "length": number_text(length)}, 0.5 * (start + end)),
        ("sphere", {"radius": number_text(radius)}, start),
        ("sphere", {"radius": number_text(radius)}, end),
    )
    for shape, sizes, center in shapes:
        part = ET.SubElement(link, kind)
        turn = f"0 {number_text(pitch)} {number_text(yaw)}" if shape == "cylinder" else "0 0 0"  # along z
        ET.SubElement(part, "origin", xyz=vector_text(center), rpy=turn)
        ET.SubElement(ET.SubElement(part, "geometry"), shape, sizes)
        if kind == "visual":
            ET.SubElement(part, "material", name="skin")


def _add_joint(
    root: ET.Element, model: HandModel, joint: int, parent: str, child: str, *, at_rest: bool
) -> None:
    """Add a hinge: a bone's first one has the bone's pose at rest, and its second one the same origin."""
    skeleton, bone = model.skeleton, JOINTS[joint].bone
    position, angles = np.zeros(3), np.zeros(3)
    if at_rest:
        position, angles = skeleton.offsets[bone], euler_angles(skeleton.rotations[bone][None])[0, ::-1]
    element = ET.SubElement(root, "joint", name=JOINTS[joint].name, type="revolute")
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=vector_text(position), rpy=vector_text(angles))
    ET.SubElement(element, "axis", xyz=vector_text(skeleton.axes[joint]))
    low, high = skeleton.ranges[joint]
    limits = {"lower": low, "upper": high, "effort": _MAX_TORQUE, "velocity": _MAX_SPEED}
    ET.SubElement(element, "limit", {key: number_text(value) for key, value in limits.items()})
    ET.SubElement(element, "dynamics", damping="0.01", friction="0")


def vector_text(vector: Float[np.ndarray, "K"]) -> str:
    """Numbers with blanks between them."""
    return " ".join(number_text(value) for value in vector)


def number_text(value: float | np.floating) -> str:
    """A number with twelve digits; zero has no sign."""
    return f"{float(value) + 0.0:.12g}"


class Forearm(NamedTuple):
    """A forearm beside a hand in OpenSim's model."""

    name: str
    """The name of its rigid body."""
    markers: Mapping[str, Float[np.ndarray, "3"]]
    """Its markers by name, in the frame of the straight hand's wrist [m]."""
    T_wrist_forearm: Float[np.ndarray, "4 4"]
    """The pose in which it begins [m]."""


def coordinate_names(side: Side) -> tuple[str, ...]:
    """Names of a hand's coordinates, in the order of its 26 degrees of freedom."""
    wrist = (f"wrist_{kind}{axis}" for kind in "tr" for axis in "xyz")
    return tuple(f"{side}_{name}" for name in (*wrist, *JOINT_NAMES))


def forearm_names(side: Side) -> tuple[str, ...]:
    """Names of the six coordinates between palm and forearm, three angles first."""
    return tuple(f"{side}_{name}" for name in _FOREARM_COORDINATES)


def forearm_values(side: Side, T_wrist_forearm: Float[np.ndarray, "T 4 4"]) -> NDArray[np.float64]:
    """Coordinates (T, 6) of a forearm's poses in OpenSim's model [rad, m]."""
    angles = wrist_cardan(side, np.swapaxes(T_wrist_forearm[:, :3, :3], 1, 2))
    return np.concatenate([angles, T_wrist_forearm[:, :3, 3]], axis=1)


def coordinate_values(qpos: Float[np.ndarray, "T 27"], up: UpAxis) -> NDArray[np.float64]:
    """Coordinates (T, 26) of a hand's poses in OpenSim's model [m, rad]; angles never jump by a full turn."""
    axes = file_axes(up)
    angles = np.unwrap(body_fixed_angles(axes @ quaternion_matrix(qpos[:, 3:7])), axis=0)
    return np.concatenate([qpos[:, :3] @ axes.T, angles, qpos[:, 7:]], axis=1)


def hand_osim(
    model: HandModel,
    markers: Sequence[Site] = (),
    start: Float[np.ndarray, "27"] | None = None,
    up: UpAxis = "z",
    forearm: Forearm | None = None,
) -> str:
    """The text of a .osim file of a hand, maybe with a forearm: meters, radians, kilograms.

    The hand begins in the pose `start` of a world whose axis `up` points up, or flat with the back up.
    OpenSim's inverse kinematics begins there too, so that the wrist's angles do not differ by full turns from
    a .mot that begins in this pose.
    """
    side = model.shape.side
    document = ET.Element("OpenSimDocument", Version=_OSIM_VERSION)
    root = ET.SubElement(document, "Model", name=f"{side}_hand")
    _add_text(root, "gravity", _GRAVITY)
    _add_text(root, "length_units", "meters")
    _add_text(root, "force_units", "N")
    ET.SubElement(root, "Ground", name="ground")
    bodies, joints, placed = (
        ET.SubElement(ET.SubElement(root, kind), "objects") for kind in ("BodySet", "JointSet", "MarkerSet")
    )
    for bone in range(len(BONES)):
        _add_body(bodies, model, bone)
    flat = join_qpos(np.zeros((1, NUM_JOINTS)))
    values = coordinate_values(flat if start is None else start[None], up)[0]
    starts = dict(zip(coordinate_names(side), values, strict=True))
    # The palm is free: it turns about its own axes and moves along those of the ground.
    names = coordinate_names(side)[:6]
    joint = _add_osim_joint(joints, f"{side}_wrist", "/ground", f"{side}_{BONE_NAMES[PALM]}", np.eye(4))
    axes = [*zip(names[3:], np.eye(3), strict=True), *zip(names[:3], np.eye(3), strict=True)]
    _add_motion(joint, axes, starts)
    for bone in range(1, len(BONES)):
        _add_knuckle(joints, model, bone, starts)
    for site in markers:
        for name in (site.name, f"{side}:{site.name}"):
            _add_marker(placed, name, f"{side}_{BONE_NAMES[site.bone]}", site.position)
    if forearm is not None:
        _add_forearm(bodies, joints, placed, model, forearm)
    # Joints and tips, each in the frame of the bone that begins, or ends, there.
    at_rest = hand_keypoints(model, flat)[0]
    frames = np.linalg.inv(model.rest_transforms)[list(KEYPOINT_BONES)]
    local = np.einsum("kij,kj->ki", frames[:, :3, :3], at_rest) + frames[:, :3, 3]
    for name, bone, position in zip(KEYPOINT_NAMES, KEYPOINT_BONES, local, strict=True):
        _add_marker(placed, f"{side}_{name}", f"{side}_{BONE_NAMES[bone]}", position)
    ET.indent(document)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(document, encoding="unicode") + "\n"


def _add_body(bodies: ET.Element, model: HandModel, bone: int) -> None:
    """Add a bone with its mass and its capsules."""
    name = f"{model.shape.side}_{BONE_NAMES[bone]}"
    body = ET.SubElement(bodies, "Body", name=name)
    mass, center, moments = _inertia(model, bone)
    shapes = ET.SubElement(body, "components")
    for index in np.flatnonzero(model.capsules.bones == bone).tolist():
        _add_osim_capsule(shapes, f"{name}_{index}", model.capsules, index)
    _add_text(body, "mass", number_text(mass))
    _add_text(body, "mass_center", vector_text(center))
    _add_text(body, "inertia", vector_text(moments[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]))


def _add_osim_capsule(shapes: ET.Element, name: str, capsules: Capsules, index: int) -> None:
    """Add a capsule as a cylinder and two spheres, because OpenSim draws no capsules."""
    from scipy.spatial.transform import Rotation

    start, end, radius = capsules.starts[index], capsules.ends[index], capsules.radii[index]
    length = np.linalg.norm(end - start)
    turn, _ = Rotation.align_vectors((end - start)[None] / length, [[0.0, 1.0, 0.0]])  # cylinders lie along y
    half_height = number_text(0.5 * length)
    places = (("middle", 0.5 * (start + end)), ("start", start), ("end", end))
    for place, center in places:
        frame = ET.SubElement(shapes, "PhysicalOffsetFrame", name=f"{name}_{place}")
        kind = "Cylinder" if place == "middle" else "Sphere"
        shape = ET.SubElement(ET.SubElement(frame, "attached_geometry"), kind, name=f"{name}_{place}_shape")
        _add_text(shape, "socket_frame", "..")
        _add_text(ET.SubElement(shape, "Appearance"), "color", _OSIM_COLOR)
        _add_text(shape, "radius", number_text(radius))
        if kind == "Cylinder":
            _add_text(shape, "half_height", half_height)
        _add_text(frame, "socket_parent", "..")
        _add_text(frame, "translation", vector_text(center))
        _add_text(frame, "orientation", vector_text(body_fixed_angles(turn.as_matrix()[None])[0]))


def _add_knuckle(joints: ET.Element, model: HandModel, bone: int, starts: Mapping[str, float]) -> None:
    """Add the one or two hinges that connect a bone with its parent bone."""
    side, skeleton = model.shape.side, model.skeleton
    hinges = [index for index, joint in enumerate(JOINTS) if joint.bone == bone]
    names = [f"{side}_{JOINTS[index].name}" for index in hinges]
    T_parent_bone = rigid(skeleton.rotations[bone], skeleton.offsets[bone])
    parent = f"/bodyset/{side}_{BONE_NAMES[BONES[bone].parent]}"
    joint = _add_osim_joint(joints, names[0], parent, f"{side}_{BONE_NAMES[bone]}", T_parent_bone)
    axes = [skeleton.axes[index] for index in hinges]
    # A custom joint needs three different axes, even if fewer of them turn.
    others = [axis for axis in np.eye(3) if all(abs(axis @ one) < _MAX_COSINE for one in axes)]
    axes += others[: 3 - len(axes)]
    _add_motion(
        joint,
        [*zip([*names, "", ""][:3], axes, strict=True), *(("", axis) for axis in np.eye(3))],
        starts,
        {name: skeleton.ranges[index] for name, index in zip(names, hinges, strict=True)},
    )


def _add_osim_joint(
    joints: ET.Element, name: str, parent: str, child: str, T_parent_child: Float[np.ndarray, "4 4"]
) -> ET.Element:
    """Add a custom joint whose child has this pose in its parent when all coordinates are zero."""
    joint = ET.SubElement(joints, "CustomJoint", name=name)
    _add_text(joint, "socket_parent_frame", "at_rest")
    _add_text(joint, "socket_child_frame", f"/bodyset/{child}")
    frame = ET.SubElement(ET.SubElement(joint, "frames"), "PhysicalOffsetFrame", name="at_rest")
    _add_text(frame, "socket_parent", parent)
    _add_text(frame, "translation", vector_text(T_parent_child[:3, 3]))
    _add_text(frame, "orientation", vector_text(body_fixed_angles(T_parent_child[None, :3, :3])[0]))
    return joint


def _add_motion(
    joint: ET.Element,
    axes: Sequence[tuple[str, Float[np.ndarray, "3"]]],
    starts: Mapping[str, float],
    ranges: Mapping[str, Float[np.ndarray, "2"]] = MappingProxyType({}),
) -> None:
    """Add the coordinates of a custom joint: three rotations in turn, three translations; '' for none.

    Ranges [rad] are stated and not enforced ('clamped'): with bounds OpenSim's inverse kinematics takes
    another optimizer, which stops degrees away from angles that lie well within them.
    """
    coordinates = ET.SubElement(joint, "coordinates")
    transform = ET.SubElement(joint, "SpatialTransform")
    for number, (name, axis) in enumerate(axes):
        kind = f"{'rotation' if number < 3 else 'translation'}{number % 3 + 1}"
        element = ET.SubElement(transform, "TransformAxis", name=kind)
        if name:
            coordinate = ET.SubElement(coordinates, "Coordinate", name=name)
            widest = (-_MAX_ROTATION, _MAX_ROTATION) if number < 3 else (-_MAX_POSITION, _MAX_POSITION)
            _add_text(coordinate, "range", " ".join(map(number_text, ranges.get(name, widest))))
            _add_text(coordinate, "clamped", "false")
            _add_text(coordinate, "default_value", number_text(starts[name]))
            _add_text(element, "coordinates", name)
        _add_text(element, "axis", vector_text(axis))
        if name:
            function = ET.SubElement(element, "LinearFunction", name="function")
            _add_text(function, "coefficients", "1 0")
        else:
            _add_text(ET.SubElement(element, "Constant", name="function"), "value", "0")


def _add_forearm(
    bodies: ET.Element, joints: ET.Element, markers: ET.Element, model: HandModel, forearm: Forearm
) -> None:
    """Add a capsule of flesh from the wrist to the farthest marker, its joint, and its markers."""
    side, radius = model.shape.side, model.shape.palm_thickness
    name, start = f"{side}_forearm", np.linalg.inv(forearm.T_wrist_forearm)[:3, 3]
    length = max(start[0] - min(place[0] for place in forearm.markers.values()), radius)
    body = ET.SubElement(bodies, "Body", name=name)
    end = start - [length, 0.0, 0.0]
    flesh = Capsules(np.zeros(1, int), start[None], end[None], np.full(1, radius))
    _add_osim_capsule(ET.SubElement(body, "components"), name, flesh, 0)
    mass, across = FLESH_DENSITY * np.pi * radius**2 * length, (3.0 * radius**2 + length**2) / 12.0
    _add_text(body, "mass", number_text(mass))
    _add_text(body, "mass_center", vector_text(0.5 * (start + end)))
    _add_text(body, "inertia", vector_text(mass * np.array([0.5 * radius**2, across, across, 0.0, 0.0, 0.0])))
    joint = _add_osim_joint(joints, name, f"/bodyset/{side}_{BONE_NAMES[PALM]}", name, np.eye(4))
    # The order of the palm's angles is reversed; a left hand turns the other way about x and z.
    axes = np.diag([1.0, -1.0, -1.0] if side == "right" else [-1.0, -1.0, 1.0])[[0, 2, 1]]
    names, values = forearm_names(side), forearm_values(side, forearm.T_wrist_forearm[None])[0]
    coordinates = [*zip(names[2::-1], axes, strict=True), *zip(names[3:], np.eye(3), strict=True)]
    _add_motion(joint, coordinates, dict(zip(names, values, strict=True)))
    for marker, position in forearm.markers.items():
        for known in (marker, f"{forearm.name}:{marker}"):
            _add_marker(markers, known, name, position)


def _add_marker(markers: ET.Element, name: str, body: str, position: Float[np.ndarray, "3"]) -> None:
    marker = ET.SubElement(markers, "Marker", name=name)
    _add_text(marker, "socket_parent_frame", f"/bodyset/{body}")
    _add_text(marker, "location", vector_text(position))
    _add_text(marker, "fixed", "true")


def _add_text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = text
