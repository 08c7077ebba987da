"""One person's hand, ready to move, its 21 keypoints, and motions of hands and rigid objects.

Keypoints are the wrist, and four per digit from its first joint to its tip, in FreiHAND's and MediaPipe's
order: wrist, thumb, index, middle, ring, little. Joints are centers of rotation; a tip is the far end of the
last bone, on the skin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_array, check_number, check_type
from handsim.errors import ArgumentError
from handsim.hand.capsules import Capsules, build_capsules, penetration_depth
from handsim.hand.shape import (
    BONE_NAMES,
    BONES,
    DIGIT_OF_BONE,
    DIGITS,
    JOINTS,
    JOINTS_PER_DIGIT,
    NUM_BONES,
    NUM_JOINTS,
    NUM_QPOS,
    PALM,
    SIZES,
    HandShape,
    Side,
    bones_of,
    named_shape,
)
from handsim.hand.skin import HandSurface, build_surface, skin_frames
from handsim.kernels import CARPUS, MOST_METACARPAL, pose_bones
from handsim.space.transforms import MIRROR, are_rigid, axis_angle_matrix, euler_matrix, rigid

if TYPE_CHECKING:
    import mujoco


_JOINT_BONES: Final = np.array([joint.bone for joint in JOINTS])
"""The bone that each joint moves; joints are in the order of their bones."""
_JOINT_COUNTS: Final = np.bincount(_JOINT_BONES, minlength=NUM_BONES)
_BONE_CHAIN: Final = np.stack([[bone.parent for bone in BONES], _JOINT_COUNTS], axis=1)
"""Parent of each bone, and the number of its joints."""
_JOINT_AXES: Final = np.array([joint.axis for joint in JOINTS])
_JOINT_RANGES: Final = np.deg2rad([(joint.low_deg, joint.high_deg) for joint in JOINTS])
FLESH_DENSITY: Final = 1100.0
"""Density of the hand [kg/m^3], soft tissue and bone together."""
CAPSULE_GROUP: Final = 0
SERVO_STIFFNESS: Final = 1.0
"""Torque of a servo per angle off its control [N m/rad]."""
SERVO_DAMPING: Final = 0.03
"""Torque of a servo against the speed of its joint [N m s/rad]."""
_KEYPOINT_PARTS: Final = (("CMC", "MCP", "IP", "tip"), *[("MCP", "PIP", "DIP", "tip")] * 4)
KEYPOINT_NAMES: Final[tuple[str, ...]] = (
    "wrist",
    *(f"{digit}_{part}" for digit, parts in zip(DIGITS, _KEYPOINT_PARTS, strict=True) for part in parts),
)
KEYPOINT_BONES: Final[tuple[int, ...]] = (
    PALM,
    *(bone for digit in DIGITS for bone in (*bones_of(digit), bones_of(digit)[-1])),
)
"""Index in `BONES` of the bone that begins at each keypoint, or ends at a tip."""
KEYPOINT_DIGITS: Final[tuple[int, ...]] = (-1, *np.repeat(np.arange(len(DIGITS)), 4).tolist())
"""Digit of each keypoint, -1 for the wrist."""
SKELETON: Final[tuple[tuple[int, int], ...]] = tuple(
    (0 if part == 0 else 4 * digit + part, 4 * digit + part + 1)
    for digit in range(len(DIGITS))
    for part in range(4)
)
"""Pairs of keypoints that a drawing joins by a line."""
_WRIST_THICKNESS: Final = 1.3  # ratio of the thickness of the wrist to that of the palm
NUM_VELOCITIES: Final = 6 + NUM_JOINTS
"""MuJoCo's nv: wrist velocity in the world, wrist angular velocity in its own frame, joint rates."""
# The first joint of a bone rotates about an axis of the parent, the second about one of the bone.
_IS_FIRST_JOINT: Final = np.diff(_JOINT_BONES, prepend=-1) != 0
_JOINT_PARENTS: Final = _BONE_CHAIN[_JOINT_BONES, 0]
_IS_BEYOND: Final = np.arange(NUM_BONES) >= _JOINT_BONES[:, None]
_IS_MOVED: Final = _IS_BEYOND & (DIGIT_OF_BONE == DIGIT_OF_BONE[_JOINT_BONES, None])
"""Whether each joint moves each bone: its own, and those further out on its digit (J, L)."""
_LIMIT_TOLERANCE: Final = 1e-9  # A metacarpal that is nearer to its limit [rad] does not flex further.
_MAX_FRAMES: Final = 1 << 22
_MAX_DRIFT: Final = 0.01  # largest deviation of times from a steady rate, in frames
_MAX_GAP: Final = 0.1  # longest gap that interpolation bridges [s]
_MAX_GAP_FRAMES: Final = 2.5  # longest gap that interpolation bridges in old frames, if that is longer
_FARTHEST_WRIST: Final = 50.0  # largest coordinate of a wrist [m]
_LARGEST_ANGLE: Final = 2.0 * np.pi  # largest joint angle [rad]


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Rest transforms of the bones relative to their parents, joint axes, and bone lengths."""

    offsets: Float[np.ndarray, "L 3"]
    """Origin of each bone in its parent's frame [m]; zero for the palm."""
    rotations: Float[np.ndarray, "L 3 3"]
    """Orientation of each bone in its parent's frame at zero angles."""
    axes: Float[np.ndarray, "J 3"]
    """Unit joint axes in the frames of the bones they move."""
    ranges: Float[np.ndarray, "J 2"]
    """Lowest and highest angle of each joint [rad]."""
    lengths: Float[np.ndarray, "L"]
    """Length of each bone along its x axis [m]; for the palm, wrist to the middle knuckle."""
    arch: Float[np.ndarray, "5"]
    """Flexion of each digit's metacarpal in the palm over that of its MCP joint."""

    def rest_transforms(self) -> Float[np.ndarray, "L 4 4"]:
        """`T_wrist_bone` of every bone at zero angles."""
        transforms = rigid(self.rotations, self.offsets)
        for first in range(1, 4):  # the first bones of all digits, the second, and the third
            bones = slice(first, None, 3)
            transforms[bones] = transforms[_BONE_CHAIN[bones, 0]] @ transforms[bones]
        return transforms


def build_skeleton(shape: HandShape) -> Skeleton:
    """Skeleton of a hand; a left hand is the mirror image, so equal angles give mirrored poses."""
    offsets, rotations = np.zeros((NUM_BONES, 3)), np.tile(np.eye(3), (NUM_BONES, 1, 1))
    # After the palm come the three bones of each digit.
    offsets[1::3], rotations[1::3] = shape.knuckles, euler_matrix(shape.base_angles)
    offsets[2::3, 0], offsets[3::3, 0] = shape.bone_lengths[:, 0], shape.bone_lengths[:, 1]
    lengths = np.concatenate([shape.knuckles[2, :1], shape.bone_lengths.ravel()])
    axes = _JOINT_AXES.copy()
    if shape.side == "left":
        offsets, rotations = offsets @ MIRROR, MIRROR @ rotations @ MIRROR
        axes = -axes @ MIRROR  # a mirrored rotation has the opposite sense
    arch = np.append(np.zeros(3), shape.arch)
    return Skeleton(offsets, rotations, axes, _JOINT_RANGES.copy(), lengths, arch)


def metacarpal_flexions(
    skeleton: Skeleton, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> Float[np.ndarray, "T 5"]:
    """Flexion of each digit's metacarpal in the palm [rad], computed from the position of its first joint."""
    wrist, rest = T_world_bone[:, PALM, :3, :3], (1.0 - CARPUS) * skeleton.offsets[1::3]
    knuckles = T_world_bone[:, 1::3, :3, 3] - T_world_bone[:, None, PALM, :3, 3]
    posed = knuckles @ wrist - CARPUS * skeleton.offsets[1::3]
    sine = rest[:, 2] * posed[..., 0] - rest[:, 0] * posed[..., 2]
    return np.asarray(np.arctan2(sine, rest[:, 0] * posed[..., 0] + rest[:, 2] * posed[..., 2]))


def metacarpal_rotations(
    skeleton: Skeleton, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> Float[np.ndarray, "T 5 3 3"]:
    """Orientation of each digit's metacarpal in the world: that of the palm, turned by its flexion."""
    wrist = T_world_bone[:, PALM, None, :3, :3]
    if not skeleton.arch.any():
        return np.repeat(wrist, len(DIGITS), axis=1)
    return wrist @ axis_angle_matrix(np.eye(3)[1], metacarpal_flexions(skeleton, T_world_bone))


class Site(NamedTuple):
    """A named point on a bone, drawn as a small sphere."""

    name: str
    bone: int
    position: Float[np.ndarray, "3"]
    radius: float


def build_spec(
    skeleton: Skeleton, capsules: Capsules, *, sites: tuple[Site, ...] = (), actuators: bool = False
) -> mujoco.MjSpec:
    """Editable MuJoCo specification of a hand.

    Its palm is rigid: the arch of a shape is left out. With `actuators` each joint has a position servo of
    its name: a control is an angle [rad] within the joint's range.
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


class HandModel:
    """A hand of one shape. Everything but the skeleton is built on first use.

    Args:
        shape: The person's hand; its `side` decides which hand this is.
    """

    def __init__(self, shape: HandShape) -> None:
        check_type("shape", shape, HandShape, "a HandShape; HandModel.named takes the name of a size")
        self.shape = shape
        self.skeleton: Skeleton = build_skeleton(shape)

    @classmethod
    def named(cls, size: str, *, side: Side = "right") -> HandModel:
        """Hand of one of the five sizes XS, S, M, L, XL.

        Raises:
            ArgumentError: There is no such size or side.
        """
        return cls(named_shape(size, side=side))

    @cached_property
    def capsules(self) -> Capsules:
        """Flesh for contact and occlusion."""
        return build_capsules(self.shape)

    @cached_property
    def surface(self) -> HandSurface:
        """Skin in the rest pose, with its weights."""
        return build_surface(self.shape)

    @cached_property
    def mj_model(self) -> mujoco.MjModel:
        """Compiled MuJoCo model (nq 27, nv 26)."""
        return build_spec(self.skeleton, self.capsules).compile()

    @cached_property
    def rest_transforms(self) -> Float[np.ndarray, "L 4 4"]:
        """`T_wrist_bone` at zero angles."""
        return self.skeleton.rest_transforms()

    def forward_kinematics(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 4 4"]:
        """`T_world_bone` of every bone in every frame, with positions in [m].

        Args:
            qpos: Wrist position [m], wrist orientation (wxyz), twenty joint angles [rad].

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        values, bones = check_array("qpos", qpos, (None, NUM_QPOS)), self.skeleton
        rest = bones.offsets, bones.rotations, bones.axes, _BONE_CHAIN, bones.arch
        return np.asarray(pose_bones(np.ascontiguousarray(values), *rest))

    def skin(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T V 3"]:
        """Skin vertices [m] in the world, by linear blend skinning.

        Args:
            qpos: As for `forward_kinematics`.

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        surface = self.surface
        return skin_frames(
            surface.vertices,
            surface.bone_indices,
            surface.bone_weights,
            self.rest_transforms,
            self.forward_kinematics(qpos),
        )

    def penetration(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T"]:
        """Deepest self-penetration [m] in every frame.

        Args:
            qpos: As for `forward_kinematics`.

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        return penetration_depth(self.capsules, self.forward_kinematics(qpos))


def load_model(model: HandModel | HandShape | str) -> HandModel:
    """Return a model as it is, make that of a shape, or that of a right hand of size XS to XL."""
    if isinstance(model, HandModel):
        return model
    if isinstance(model, HandShape):
        return HandModel(model)
    check_type("model", model, str, "a HandModel, a HandShape or the name of a size", SIZES)
    return HandModel.named(model)


def join_qpos(
    angles: Float[np.ndarray, "T 20"],
    *,
    position: Float[np.ndarray, "*T 3"] | None = None,
    quaternion: Float[np.ndarray, "*T 4"] | None = None,
) -> Float[np.ndarray, "T 27"]:
    """Full qpos of joint angles, with the wrist at the origin by default.

    Args:
        angles: Joint angles [rad], in the order of `handsim.hand.shape.JOINTS`.
        position: Wrist position in the world [m], one per frame or one for all.
        quaternion: Wrist orientation in the world (wxyz), one per frame or one for all.

    Returns:
        MuJoCo's qpos, which is wrist position [m], wrist orientation (wxyz) and joint angles [rad].

    Raises:
        ArgumentError: `angles` is not (T, 20) or not finite.
    """
    angles = check_array("angles", angles, (None, NUM_JOINTS))
    qpos = np.zeros((len(angles), NUM_QPOS))
    qpos[:, :3] = 0.0 if position is None else position
    qpos[:, 3:7] = (1.0, 0.0, 0.0, 0.0) if quaternion is None else quaternion
    qpos[:, 7:] = angles
    return qpos


def check_bounds(qpos: Float[np.ndarray, "*T 27"]) -> None:
    """Refuse poses in millimeters or degrees, which lie beyond any room or turn; NaN is no pose."""
    farthest, widest = (np.nanmax(np.abs(some), initial=0.0) for some in (qpos[..., :3], qpos[..., 7:]))
    if farthest > _FARTHEST_WRIST:
        raise ArgumentError(
            f"a wrist is {farthest:.4g} m from the origin along an axis, expected at most "
            f"{_FARTHEST_WRIST:g}; are these millimeters?"
        )
    if widest > _LARGEST_ANGLE:
        raise ArgumentError(
            f"a joint angle is {widest:.4g} rad, expected at most {_LARGEST_ANGLE:.3f}; are these degrees?"
        )


def hand_keypoints(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T 21 3"]:
    """Keypoints in the world [m]."""
    transforms, tips = model.forward_kinematics(qpos), list(KEYPOINT_BONES[4::4])
    points = np.ascontiguousarray(transforms[:, list(KEYPOINT_BONES)][..., :3, 3])
    points[:, 4::4] += model.skeleton.lengths[tips, None] * transforms[:, tips][..., :3, 0]
    return points


def keypoint_thickness(shape: HandShape) -> Float[np.ndarray, "21"]:
    """Thickness of the wrist or the finger at each keypoint [m]."""
    return np.array([_WRIST_THICKNESS * shape.palm_thickness, *(2.0 * shape.radii).ravel()])


def joint_axes(
    model: HandModel, T_world_bone: Float[np.ndarray, "T L 4 4"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3"]]:
    """Unit axes and anchors [m] of all joints in the world."""
    skeleton = model.skeleton
    parent = T_world_bone[:, _JOINT_PARENTS, :3, :3]
    parent[:, ::JOINTS_PER_DIGIT] = metacarpal_rotations(skeleton, T_world_bone)
    parent = parent @ skeleton.rotations[_JOINT_BONES]
    own = T_world_bone[:, _JOINT_BONES, :3, :3]
    frames = np.where(_IS_FIRST_JOINT[:, None, None], parent, own)
    return np.einsum("tjab,jb->tja", frames, skeleton.axes), T_world_bone[:, _JOINT_BONES][..., :3, 3]


def skinned_jacobian(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    bone_indices: Int[np.ndarray, "M 4"],
    bone_weights: Float[np.ndarray, "M 4"],
) -> Float[np.ndarray, "T M 3 26"]:
    """Derivative of skinned points [m] with respect to MuJoCo's velocities (`NUM_VELOCITIES`)."""
    frames, count = len(T_world_bone), len(points)
    motion = T_world_bone @ np.linalg.inv(model.rest_transforms)
    homogeneous = np.concatenate([points, np.ones((count, 1))], axis=1)
    by_bone = np.einsum("tmkij,mj->tmki", motion[:, bone_indices, :3], homogeneous)  # as each bone moves it
    placed = np.einsum("mk,tmki->tmi", bone_weights, by_bone)
    jacobian = np.zeros((frames, count, 3, NUM_VELOCITIES))
    jacobian[..., :3] = np.eye(3)
    wrist = T_world_bone[:, 0]
    wrist_axes = np.swapaxes(wrist[:, :3, :3], 1, 2)  # as rows, in the world
    levers = placed - wrist[:, None, :3, 3]
    jacobian[..., 3:6] = np.cross(wrist_axes[:, None], levers[:, :, None]).swapaxes(-1, -2)
    axes, anchors = joint_axes(model, T_world_bone)
    # The derivative by a joint is axis x (sum of w (p - anchor)) over the bones that it moves.
    shares = bone_weights * _IS_MOVED[:, bone_indices]  # (J, M, 4)
    lever = shares.swapaxes(0, 1) @ by_bone
    lever -= shares.sum(-1).T[..., None] * anchors[:, None]
    jacobian[..., 6:] = np.cross(axes[:, None], lever).swapaxes(-1, -2)
    if model.skeleton.arch.any():  # The flexion of an MCP joint also flexes its metacarpal.
        flexing, skeleton = slice(1, None, JOINTS_PER_DIGIT), model.skeleton
        is_free = np.abs(metacarpal_flexions(skeleton, T_world_bone)) < MOST_METACARPAL - _LIMIT_TOLERANCE
        bases, shares = CARPUS * skeleton.offsets[1::3] @ wrist_axes + wrist[:, None, :3, 3], shares[flexing]
        lever = shares.swapaxes(0, 1) @ by_bone - shares.sum(-1).T[..., None] * bases[:, None]
        rates = (skeleton.arch * is_free)[..., None] * wrist[:, None, :3, 1]
        jacobian[..., 6:][..., flexing] += np.cross(rates[:, None], lever).swapaxes(-1, -2)
    return jacobian


def _checked_frames(name: str, frames: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """`frames` (T, *shape) as finite float64; an `ArgumentError` if there is no frame."""
    values = check_array(name, frames, (None, *shape))
    if values.ndim != 1 + len(shape) or len(values) == 0:
        sizes = ", ".join(map(str, shape))
        raise ArgumentError(f"a motion needs frames: {name} has shape {values.shape}, expected (T, {sizes})")
    return values


@dataclass(frozen=True, slots=True, eq=False)
class HandMotion:
    """Poses of one hand, frame by frame.

    Raises:
        ArgumentError: `qpos` is not (T, 27), empty or not finite, or the rate is not positive.
    """

    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]."""
    rate: float
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "qpos", _checked_frames("qpos", self.qpos, (NUM_QPOS,)))
        check_number("the rate [Hz]", self.rate, 0.0, above=True)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.qpos) - 1) / self.rate

    def speeds(self) -> Float[np.ndarray, "S 20"]:
        """Joint speeds between frames [rad/s]."""
        return np.diff(self.qpos[:, 7:], axis=0) * self.rate


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """Poses of one rigid object, frame by frame."""

    T_world_body: Float[np.ndarray, "T 4 4"]
    """The object's frame seen from the world [m]."""
    rate: float
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_body", _checked_frames("T_world_body", self.T_world_body, (4, 4)))
        if not are_rigid(self.T_world_body):
            raise ArgumentError("T_world_body is not rigid transforms, expected rotations and positions")
        check_number("the rate [Hz]", self.rate, 0.0, above=True)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.T_world_body) - 1) / self.rate


def bridge_gaps(times: Float[np.ndarray, "T"], qpos: Float[np.ndarray, "T 27"], rate: float) -> HandMotion:
    """A motion in which missing poses (NaN) are interpolated linearly; at least one pose is present."""
    present = np.flatnonzero(np.isfinite(qpos[:, 0]))
    before, share, _ = _neighboring_frames(times[present], times)
    bridged = _interpolated_rows(qpos[present], before, share)
    bridged[present] = qpos[present]
    return HandMotion(bridged, rate)


def is_steady(times: Float[np.ndarray, "T"], rate: float) -> bool:
    """Whether frames come at a steady rate [Hz]."""
    drift = np.abs((times - times[0]) * rate - np.arange(len(times)))
    return bool((drift < _MAX_DRIFT).all())


def times_at(times: Float[np.ndarray, "T"], rate: float) -> Float[np.ndarray, "K"]:
    """The times [s] of frames at another rate, from the first to the last."""
    check_number("the rate [Hz]", rate, 0.0, above=True)
    last = (times[-1] - times[0]) * rate + _MAX_DRIFT
    if last >= _MAX_FRAMES:
        raise ArgumentError(f"{last:.3g} frames at {rate:g} Hz, expected at most {_MAX_FRAMES}")
    return np.asarray(times[0] + np.arange(int(last) + 1) / rate)


def between_poses(
    times: Float[np.ndarray, "T"], new: Float[np.ndarray, "K"], poses: Float[np.ndarray, "T H W"], rate: float
) -> Float[np.ndarray, "K H W"]:
    """Interpolate poses (position, quaternion (wxyz), and angles if any) at new times.

    Poses are NaN beside a missing old pose, and in gaps longer than 0.1 s and 2.5 frames.
    """
    before, share, step = _neighboring_frames(times, new)
    exact = (share < 1e-6) | (share > 1.0 - 1e-6)
    is_gap = step > max(_MAX_GAP, _MAX_GAP_FRAMES / rate)
    share = np.where(exact, np.round(share), np.where(is_gap, np.nan, share))
    between = np.empty((len(new), *poses.shape[1:]))
    for number in range(poses.shape[1]):
        between[:, number] = _interpolated_rows(poses[:, number], before, share)
    return between


def _neighboring_frames(
    times: Float[np.ndarray, "T"], new: Float[np.ndarray, "K"]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """The old frame before each new time, the weight of the next one, and the time between them [s]."""
    if len(times) == 1:
        return np.zeros(len(new), dtype=np.intp), np.zeros(len(new)), np.zeros(len(new))
    old, new = times - times[0], new - times[0]
    before = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 2)
    step = old[before + 1] - old[before]
    return before, np.clip((new - old[before]) / step, 0.0, 1.0), step


def _interpolated_rows(
    rows: NDArray[np.float64], before: NDArray[np.intp], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate rows between old frames; NaN where an old row with a weight is NaN."""
    from scipy.spatial.transform import Rotation

    quaternions = slice(3, 7)
    after = np.minimum(before + 1, len(rows) - 1)
    first = np.where(share[:, None] == 1.0, rows[after], rows[before])
    second = np.where(share[:, None] == 0.0, rows[before], rows[after])
    between: NDArray[np.float64] = first + share[:, None] * (second - first)
    there = np.isfinite(between[:, 0])
    starts = Rotation.from_quat(first[there, quaternions], scalar_first=True)
    ends = Rotation.from_quat(second[there, quaternions], scalar_first=True)
    rotations = Rotation.from_rotvec(share[there, None] * (starts.inv() * ends).as_rotvec())
    between[there, quaternions] = (starts * rotations).as_quat(scalar_first=True)
    between[~there] = np.nan
    return between
