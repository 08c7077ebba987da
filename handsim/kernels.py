"""Compiled arithmetic on plain arrays, shared by all packages: rotations, rigid motions, segments, bones.

Everything is written out in scalars and into arrays of the caller, so that a kernel's inner loop makes no
array. Orientations are quaternions (wxyz, MuJoCo's order) or 3x3 matrices.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import multiprocessing
from collections.abc import Callable
from typing import Any, Final, ParamSpec, TypeVar, overload

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim import callbacks
from handsim.callbacks import before_compiling

P = ParamSpec("P")
R = TypeVar("R")
CARPUS: Final = 0.38
"""Distance of a carpometacarpal joint from the wrist, as a share of the knuckle's: the length of the carpus
by Buryanov and Kotiuk. El-shennawy and others (2001, J. Hand Surg. 26A:1030) found the axes of flexion in the
bases of the metacarpals."""
MOST_METACARPAL: Final = float(np.deg2rad(27.0))
"""Largest flexion of a metacarpal [rad]: the range of the fifth that they found; that of the fourth is 20."""


@overload
def kernel(function: Callable[P, R], /) -> Callable[P, R]: ...


@overload
def kernel(*, inline: bool) -> Callable[[Callable[P, R]], Callable[P, R]]: ...


def kernel(function: Callable[P, R] | None = None, /, *, inline: bool = False) -> Any:
    """Compile a function with numba at its first call, and keep the machine code on disk.

    A division by zero gives infinity or NaN as in numpy. Sums keep their order (no fast-math), so that
    results are the same on every machine. Arguments are arrays, numbers and other kernels; the body of an
    inline kernel is copied into each kernel that calls it.
    """
    if function is None:
        return lambda function: _compiled(function, inline=inline)
    return _compiled(function, inline=inline)


def _compiled(function: Callable[P, R], *, inline: bool) -> Any:
    if not callbacks.runs_kernels:
        return function
    import numba

    compiled = numba.njit(
        cache=True,
        error_model="numpy",
        inline="always" if inline else "never",
        no_cfunc_wrapper=True,  # no kernel is called from C
    )(function)
    cache = getattr(compiled, "_cache", None)
    kept = getattr(cache, "_cache_file", None)
    if cache is not None and kept is not None:
        cache.load_overload = functools.partial(_load_or_prepare, cache.load_overload)
        kept._load_index = functools.partial(_known_kernels, kept._load_index)
        kept.save = functools.partial(_save_by_types, kept, kept.save)
    return compiled


def _load_or_prepare(load: Callable[..., Any], types: object, target: object) -> Any:
    """Load a kernel from the cache; while it is missing, call what `before_compiling` holds and try again."""
    found = load(types, target)
    while found is None and before_compiling:
        before_compiling.pop()()
        found = load(types, target)
    if found is None:
        _tell_program()
    return found


@functools.cache
def _tell_program() -> None:
    """Tell once, in a program that is no command, why its first calls take long."""
    if not callbacks.is_command and multiprocessing.parent_process() is None:
        logging.getLogger("handsim").warning(
            "handsim: compiling, once on this machine, which can take minutes; "
            "`handsim doctor --compile` compiles everything on all cores"
        )


def _save_by_types(kept: Any, save: Callable[..., None], key: object, data: object) -> None:
    """Keep a kernel in a file that is named for its types.

    numba counts the files of a kernel. Two processes that compile it for different types at once would write
    to the same file, and the index of one would name the code of the other.
    """
    first = int(hashlib.sha256(repr(key).encode()).hexdigest()[:12], 16)
    kept._data_name = lambda number: kept._data_name_pattern.format(number=first + number)
    save(key, data)


def _known_kernels(load: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """The kernels kept on disk; none if an earlier version kept them under types that moved since."""
    try:
        return load()
    except (ImportError, AttributeError):
        return {}


@kernel(inline=True)
def squared_distance(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Squared distance of two points [m^2]."""
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2  # type: ignore[no-any-return]


@kernel(inline=True)
def point_distance(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Distance of two points [m]."""
    return np.sqrt(squared_distance(one, other))  # type: ignore[no-any-return]


@kernel(inline=True)
def segment_distance_squared(p: Any, q: Any, a: Any, b: Any) -> float:
    """Squared distance [m^2] between the segments p-q and a-b, each point an array (3,) or a tuple [m].

    Ericson, Real-Time Collision Detection (2005), section 5.1.9; degenerate segments are points.
    """
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    uw = ux * wx + uy * wy + uz * wz
    vw = vx * wx + vy * wy + vz * wz
    tiny = 1e-18
    s = 0.0
    if uu > tiny:
        determinant = uu * vv - uv * uv
        if determinant > 1e-12 * uu * vv:
            s = min(1.0, max(0.0, (uv * vw - vv * uw) / determinant))
    t = (uv * s + vw) / vv if vv > tiny else 0.0
    if t < 0.0 or t > 1.0 or vv <= tiny:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (uv * t - uw) / uu)) if uu > tiny else 0.0
    dx, dy, dz = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return float(dx * dx + dy * dy + dz * dz)


@kernel
def write_quaternion_matrix(matrix: Float[np.ndarray, "_ _"], w: float, x: float, y: float, z: float) -> None:
    """Write the rotation of a unit quaternion to the upper left 3x3 block of a matrix or transform."""
    matrix[0, 0], matrix[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    matrix[0, 2], matrix[1, 0] = 2 * (x * z + w * y), 2 * (x * y + w * z)
    matrix[1, 1], matrix[1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    matrix[2, 0], matrix[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    matrix[2, 2] = 1 - 2 * (x * x + y * y)


@kernel
def write_matrix_quaternions(
    matrices: Float[np.ndarray, "T 3 3"], quaternions: Float[np.ndarray, "T 4"]
) -> bool:
    """Write the unit quaternions (wxyz) of rotation matrices, and whether all of these are rotations.

    Klumpp, Singularity-free extraction of a quaternion from a direction-cosine matrix (1976): the largest of
    the four components is computed first, and has no sign of its own.
    """
    for n in range(len(matrices)):
        m, q = matrices[n], quaternions[n]
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        i = 0
        for other in range(1, 3):
            if m[other, other] > m[i, i]:
                i = other
        j, k = (i + 1) % 3, (i + 2) % 3
        if m[i, i] >= trace:
            q[1 + i] = 1.0 - trace + 2.0 * m[i, i]
            q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
            q[0] = m[k, j] - m[j, k]
        else:
            q[1], q[2], q[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
            q[0] = 1.0 + trace
        length = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3] + q[0] * q[0])
        for row in range(4):
            q[row] /= length
        determinant = (
            m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
            - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
            + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
        )
        is_rotation = determinant > 0.0
        for row in range(3):
            for other in range(3):
                product = 0.0 if row != other else -1.0
                for column in range(3):
                    product += m[row, column] * m[other, column]
                is_rotation = is_rotation and abs(product) < 1e-13
        if not is_rotation:  # also where it is NaN
            return False
    return True


@kernel
def write_axis_angle_matrix(
    matrix: Float[np.ndarray, "_ _"], axis: Float[np.ndarray, "3"], angle: float
) -> None:
    """Write the rotation matrix about a unit axis by an angle [rad], by way of its quaternion.

    Args:
        matrix: Matrix (3, 3) or transform (4, 4); its upper left 3x3 block is overwritten.
        axis: Unit vector (3,).
    """
    sine, cosine = np.sin(0.5 * angle), np.cos(0.5 * angle)
    write_quaternion_matrix(matrix, cosine, sine * axis[0], sine * axis[1], sine * axis[2])


@kernel
def multiply_rotations(
    first: Float[np.ndarray, "_ _"], second: Float[np.ndarray, "_ _"], product: Float[np.ndarray, "_ _"]
) -> None:
    """Write `first @ second` of two rotations, of which the upper left 3x3 blocks are used.

    Args:
        first: Rotation (3, 3) or transform (4, 4).
        second: Rotation (3, 3) or transform (4, 4); not the same array as `product`.
        product: Where the product goes (3, 3) or (4, 4); may be `first`.
    """
    for i in range(3):
        x, y, z = first[i, 0], first[i, 1], first[i, 2]
        for j in range(3):
            product[i, j] = x * second[0, j] + y * second[1, j] + z * second[2, j]


@kernel
def quaternion_product(
    w: float, x: float, y: float, z: float, e: float, a: float, b: float, c: float
) -> tuple[float, float, float, float]:
    """Product (wxyz) of the quaternions (w, x, y, z) and (e, a, b, c)."""
    return (
        w * e - x * a - y * b - z * c,
        w * a + x * e + y * c - z * b,
        w * b - x * c + y * e + z * a,
        w * c + x * b - y * a + z * e,
    )


@kernel
def rotate_quaternion(
    before: Float[np.ndarray, "4"], vector: Float[np.ndarray, "3"], after: Float[np.ndarray, "4"]
) -> None:
    """Rotate an orientation by a rotation vector in its own frame.

    Args:
        before: Unit quaternion (4,) wxyz.
        vector: Rotation vector (3,) [rad].
        after: Where the new unit quaternion (4,) goes; may be `before`.
    """
    a, b, c = vector[0], vector[1], vector[2]
    angle = np.sqrt(a * a + b * b + c * c)
    share = 0.5 if angle < 1e-8 else np.sin(0.5 * angle) / angle
    after[0], after[1], after[2], after[3] = quaternion_product(
        before[0], before[1], before[2], before[3], np.cos(0.5 * angle), share * a, share * b, share * c
    )
    scale = 1.0 / np.sqrt(after[0] ** 2 + after[1] ** 2 + after[2] ** 2 + after[3] ** 2)
    for n in range(4):
        after[n] *= scale


@kernel
def horn_matrix(products: Float[np.ndarray, "3 3"]) -> NDArray[np.float64]:
    """Horn's matrix (4, 4) of a sum of outer products: its last eigenvector is the best rotation."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = products
    return np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )


@kernel
def align_rigid(
    source: Float[np.ndarray, "N 3"],
    target: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, "N"],
    pose: Float[np.ndarray, "7"],
) -> float:
    """`handsim.space.transforms.rigid_fit` for kernels: weighted, and some points may be missing.

    Horn, Closed-form solution of absolute orientation using unit quaternions (1987).

    Args:
        source: Points in the body's frame [m].
        target: The same points in the world [m]; NaN where missing.
        weights: Weight of each pair.
        pose: Position [m] and orientation (wxyz) of the body in the world; the first seven numbers
            are filled.

    Returns:
        The weighted sum of squared distances that is left.
    """
    total, size = 0.0, 0.0
    centers, products = np.zeros((2, 3)), np.zeros((3, 3))
    for point in range(len(source)):
        if not np.isnan(target[point, 0]):
            total += weights[point]
            centers[0] += weights[point] * source[point]
            centers[1] += weights[point] * target[point]
    centers /= total
    for point in range(len(source)):
        if np.isnan(target[point, 0]):
            continue
        for i in range(3):
            a = source[point, i] - centers[0, i]
            size += weights[point] * (a * a + (target[point, i] - centers[1, i]) ** 2)
            for j in range(3):
                products[i, j] += weights[point] * a * (target[point, j] - centers[1, j])
    values, vectors = np.linalg.eigh(horn_matrix(products))
    rotation = np.empty((3, 3))
    pose[3:7] = vectors[:, 3]
    write_quaternion_matrix(rotation, pose[3], pose[4], pose[5], pose[6])
    for i in range(3):
        pose[i] = centers[1, i]
        for j in range(3):
            pose[i] -= rotation[i, j] * centers[0, j]
    return size - 2.0 * values[3]  # type: ignore[no-any-return]


def move(qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"]) -> Float[np.ndarray, "T 27"]:
    """Poses after a step: what `mj_integratePos` computes.

    Args:
        qpos: Wrist position [m], wrist orientation (wxyz, unit), joint angles [rad].
        step: Wrist translation in the world [m], wrist rotation vector in its own frame [rad], joint angles
            [rad].
    """
    moved = np.empty_like(qpos)
    _move(np.ascontiguousarray(qpos), np.ascontiguousarray(step), moved)
    return moved


def velocity_of(
    before: Float[np.ndarray, "27"], after: Float[np.ndarray, "27"], span: float
) -> Float[np.ndarray, "26"]:
    """Velocity that takes a hand from one pose to another, the shorter way round: `mj_differentiatePos`.

    Returns:
        Wrist velocity in the world [m/s], its angular velocity in its own frame [rad/s], joint rates [rad/s].
    """
    velocity = np.empty(len(before) - 1)
    _find_velocity(before, after, span, velocity)
    return velocity


@kernel
def _move(
    qpos: Float[np.ndarray, "T 27"], step: Float[np.ndarray, "T 26"], moved: Float[np.ndarray, "T 27"]
) -> None:
    """Write `qpos` after `step` into `moved`; units as in `move`."""
    for row in range(len(qpos)):
        before, by, after = qpos[row], step[row], moved[row]
        for n in range(3):
            after[n] = before[n] + by[n]
        for n in range(7, len(before)):
            after[n] = before[n] + by[n - 1]
        rotate_quaternion(before[3:7], by[3:6], after[3:7])


@kernel
def _find_velocity(
    before: Float[np.ndarray, "27"],
    after: Float[np.ndarray, "27"],
    span: float,
    velocity: Float[np.ndarray, "26"],
) -> None:
    """Write the velocity from `before` to `after` into `velocity`; units as in `velocity_of`."""
    rate = velocity[3:6]
    cosine, rate[0], rate[1], rate[2] = quaternion_product(
        before[3], -before[4], -before[5], -before[6], after[3], after[4], after[5], after[6]
    )
    sine = np.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    share = 2.0 if sine < 1e-8 else 2.0 * np.arctan2(sine, abs(cosine)) / sine
    for n in range(3):
        velocity[n] = (after[n] - before[n]) / span
        rate[n] *= (share if cosine >= 0.0 else -share) / span
    for n in range(7, len(before)):
        velocity[n - 1] = (after[n] - before[n]) / span


@kernel
def metacarpal_flexion(arch: float, flexion: float) -> tuple[float, float]:
    """Flexion of a metacarpal whose MCP joint flexes [rad], and its derivative by that."""
    angle = arch * flexion
    if angle > MOST_METACARPAL:
        return MOST_METACARPAL, 0.0
    if angle < -MOST_METACARPAL:
        return -MOST_METACARPAL, 0.0
    return angle, arch


@kernel
def metacarpal_motion(flexion: float, knuckle: Float[np.ndarray, "3"]) -> tuple[float, float, float, float]:
    """Motion of a metacarpal that flexes about the palm's y axis at its carpometacarpal joint.

    Args:
        flexion: Angle [rad], positive towards the palm.
        knuckle: Where its head is in the palm at zero [m].

    Returns:
        Sine and cosine of the angle, and x and z of the point to which the palm's origin moves [m].
    """
    sine, cosine = np.sin(flexion), np.cos(flexion)
    x, z = CARPUS * knuckle[0], CARPUS * knuckle[2]
    return sine, cosine, x - cosine * x - sine * z, z + sine * x - cosine * z


@kernel
def pose_bones(
    qpos: Float[np.ndarray, "T 27"],
    offsets: Float[np.ndarray, "L 3"],
    rotations: Float[np.ndarray, "L 3 3"],
    axes: Float[np.ndarray, "J 3"],
    chain: Int[np.ndarray, "L 2"],
    arch: Float[np.ndarray, "5"],
) -> Any:
    """`T_world_bone` (T, L, 4, 4) of every bone in every frame, in one pass down the chain.

    Args:
        qpos: Wrist position [m], wrist orientation (wxyz, normalized here), joint angles [rad].
        offsets: Origin of each bone in its parent's frame [m].
        rotations: Orientation of each bone in its parent's frame at zero angles.
        axes: Unit axis of each joint in the frame of the bone that it moves.
        chain: Parent of each bone, and how many joints move it; parents come first, joints go by bones.
        arch: Flexion of each digit's metacarpal in the palm over that of its second joint.
    """
    transforms = np.zeros((len(qpos), len(chain), 4, 4))
    rotation, base = np.empty((3, 3)), np.empty((4, 4))
    for frame in range(len(qpos)):
        pose = transforms[frame]
        w, x, y, z = qpos[frame, 3], qpos[frame, 4], qpos[frame, 5], qpos[frame, 6]
        scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        write_quaternion_matrix(pose[0], w * scale, x * scale, y * scale, z * scale)
        for i in range(3):
            pose[0, i, 3] = qpos[frame, i]
        pose[0, 3, 3] = 1.0
        joint = 0
        for bone in range(1, len(chain)):
            parent, own = pose[chain[bone, 0]], pose[bone]
            if chain[bone, 0] == 0 and arch[bone // 3] != 0.0:
                flexion, _ = metacarpal_flexion(arch[bone // 3], qpos[frame, 8 + joint])
                sine, cosine, x, z = metacarpal_motion(flexion, offsets[bone])
                for i in range(3):
                    a, c = parent[i, 0], parent[i, 2]
                    base[i, 0], base[i, 1], base[i, 2] = (
                        cosine * a - sine * c,
                        parent[i, 1],
                        sine * a + cosine * c,
                    )
                    base[i, 3] = parent[i, 3] + a * x + c * z
                parent = base
            for i in range(3):
                own[i, 3] = parent[i, 3]
                for j in range(3):
                    own[i, 3] += parent[i, j] * offsets[bone, j]
            own[3, 3] = 1.0
            multiply_rotations(parent, rotations[bone], own)
            for _ in range(chain[bone, 1]):
                write_axis_angle_matrix(rotation, axes[joint], qpos[frame, 7 + joint])
                multiply_rotations(own, rotation, own)
                joint += 1
    return transforms


@kernel
def pose_digit_axes(wrist: Any, angles: Any, digit: Any, posed: Any, scratch: Any) -> None:
    """Write the capsule axes of one digit: the forward kinematics of `pose_bones` for three bones.

    Args:
        wrist: The wrist's orientation (3, 3) and position (3,) [m] in the world.
        angles: The digit's joint angles (4,) [rad]: two at its first bone, one at each further one.
        digit: A tuple with the fields `offsets` (3, 3) [m], `rotations` (3, 3, 3), `axes` (4, 3) and `arch`
            of the digit's bones and joints as `pose_bones` takes them, and `ends` (3, 2, 3), both ends of
            each bone's capsule in the bone's frame [m].
        posed: Where the axes' ends in the world go (3, 2, 3) [m].
        scratch: Room for the arithmetic (4, 3).
    """
    for joint in range(4):
        scratch[joint, 0], scratch[joint, 1] = np.sin(angles[joint]), np.cos(angles[joint])
    flexion, _ = metacarpal_flexion(digit.arch, angles[1])
    bent, straight, ahead, above = metacarpal_motion(flexion, digit.offsets[0])
    for row in range(3):  # rows of the frames and of the origins do not depend on each other
        a, b, c, origin = wrist[0][row, 0], wrist[0][row, 1], wrist[0][row, 2], wrist[1][row]
        if digit.arch != 0.0:
            origin = origin + a * ahead + c * above
            a, c = straight * a - bent * c, bent * a + straight * c
        joint = 0
        for bone in range(3):
            offset, local, ends = digit.offsets, digit.rotations, digit.ends
            origin = origin + a * offset[bone, 0] + b * offset[bone, 1] + c * offset[bone, 2]
            a, b, c = (
                a * local[bone, 0, 0] + b * local[bone, 1, 0] + c * local[bone, 2, 0],
                a * local[bone, 0, 1] + b * local[bone, 1, 1] + c * local[bone, 2, 1],
                a * local[bone, 0, 2] + b * local[bone, 1, 2] + c * local[bone, 2, 2],
            )
            for _ in range(2 if bone == 0 else 1):  # Rodrigues' formula, about an axis of the frame's own
                sine, cosine = scratch[joint, 0], scratch[joint, 1]
                x, y, z = digit.axes[joint, 0], digit.axes[joint, 1], digit.axes[joint, 2]
                along = (1.0 - cosine) * (a * x + b * y + c * z)
                a, b, c = (
                    cosine * a + sine * (b * z - c * y) + along * x,
                    cosine * b + sine * (c * x - a * z) + along * y,
                    cosine * c + sine * (a * y - b * x) + along * z,
                )
                joint += 1
            for end in range(2):
                posed[bone, end, row] = (
                    origin + a * ends[bone, end, 0] + b * ends[bone, end, 1] + c * ends[bone, end, 2]
                )
