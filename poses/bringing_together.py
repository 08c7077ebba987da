"""Hands brought together until they touch: one backs off along an axis, fingers close until something is met.

Both searches come from the free side and stop at the first contact, so whatever is less far is free too. That
is what lets a motion be smoothed afterwards: towards the free side only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d

from handsim.model import HandModel
from handsim.segments import segment_distance_squared
from handsim.transforms import quaternion_matrix

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

FARTHEST: Final = 0.4
"""Where the search for the first contact begins [m], measured along the axis."""
NEAREST: Final = -0.15
"""Where it ends without one [m]."""
_PRESS: Final = 0.0005  # depth [m] to which a hand is brought to the other
# Fingers close in two stages: what stops a knuckle does not stop the joints beyond it. Each has a depth [m] to
# which a finger presses into the other hand or its own, and the joints of a digit that it moves.
_STAGES: Final = ((0.0006, slice(0, 4)), (0.0008, slice(2, 4)))
_STEPS: Final = 16  # from open to closed, until the first that is blocked; then halvings
_HALVINGS: Final = 7
_ORDER: Final = (1, 2, 3, 4, 0)  # the thumb closes last, over what the fingers hold


def first_contact(
    still: HandModel,
    still_qpos: Float[np.ndarray, "T 27"],
    moving: HandModel,
    moving_qpos: Float[np.ndarray, "T 27"],
    axis: Float[np.ndarray, "T 3"],
) -> Float[np.ndarray, "T"]:
    """How far along `axis` [m] the moving hand touches the still one, coming from `FARTHEST`.

    Everything farther out is free. Frames without a contact give `NEAREST`.
    """
    reach: NDArray[np.float64] = _first_contact(
        moving.capsules.posed(moving.forward_kinematics(moving_qpos)),
        moving.capsules.radii,
        still.capsules.posed(still.forward_kinematics(still_qpos)),
        still.capsules.radii,
        axis,
    )
    return reach


def close_fingers(
    model: HandModel,
    opened: Float[np.ndarray, "T 27"],
    closed: Float[np.ndarray, "T 20"],
    strength: Float[np.ndarray, "T 5"],
    other: HandModel,
    other_qpos: Float[np.ndarray, "T 27"],
    *,
    window: int = 1,
) -> Float[np.ndarray, "T 20"]:
    """Hinge angles of fingers that close from one pose towards another until they meet a hand.

    Args:
        model: The hand whose fingers close.
        opened: Where it is, with its fingers open.
        closed: Angles [rad] its fingers would have with nothing in the way.
        strength: Share of the way, a digit each, that is gone where nothing is in the way.
        other: The hand that is in the way, besides the own one.
        other_qpos: Where that is.
        window: Frames over which the ways are smoothed; 1 leaves each frame alone.
    """
    busy = np.flatnonzero(strength.max(axis=1) > 0.0)
    angles = opened[:, 7:].copy()
    rotations, positions = quaternion_matrix(opened[busy, 3:7]), opened[busy, :3]
    own = model.capsules.posed(model.forward_kinematics(opened[busy]))
    obstacles = other.capsules.posed(other.forward_kinematics(other_qpos[busy]))
    for press, joints in _STAGES:
        for digit in _ORDER:
            parts = _digit_parts(model, digit)
            rest = [k for k in range(len(model.capsules.bones)) if k not in parts.capsules]
            place = slice(4 * digit, 4 * digit + 4)
            goal = angles[:, place].copy()
            goal[:, joints] = closed[:, place][:, joints]
            share = np.ones(len(angles))
            share[busy] = _closing(
                rotations,
                positions,
                angles[busy, place],
                goal[busy],
                parts,
                np.concatenate([obstacles, own[:, rest]], axis=1),
                np.concatenate([other.capsules.radii, model.capsules.radii[rest]]),
                np.concatenate([np.ones((3, len(other.capsules.radii)), bool), parts.meets[:, rest]], axis=1),
                press,
            )
            share = smooth_below(share, window) * strength[:, digit]
            angles[:, place] += share[:, None] * (goal - angles[:, place])
            own[:, parts.capsules] = _posed_digit(rotations, positions, angles[busy, place], parts)
    return angles


def smooth_above(values: Float[np.ndarray, "T"], window: int) -> Float[np.ndarray, "T"]:
    """A smooth curve that is nowhere below `values`, smoothed over an odd number of frames."""
    if window < 3:
        return values
    kernel = np.hanning(window + 2)[1:-1]
    highest = maximum_filter1d(values, window, mode="nearest")
    smooth: NDArray[np.float64] = convolve1d(highest, kernel / kernel.sum(), mode="nearest")
    return smooth


def smooth_below(values: Float[np.ndarray, "T"], window: int) -> Float[np.ndarray, "T"]:
    """A smooth curve that is nowhere above `values`, smoothed over an odd number of frames."""
    return -smooth_above(-values, window)


class _Digit(NamedTuple):
    """What the compiled search needs of a digit: three bones, four hinges, three capsules."""

    capsules: NDArray[np.int64]
    offsets: NDArray[np.float64]
    rotations: NDArray[np.float64]
    axes: NDArray[np.float64]
    ends: NDArray[np.float64]
    radii: NDArray[np.float64]
    meets: NDArray[np.bool_]
    """Which capsules of the hand each of them may collide with (3, K)."""
    reach: float


def _digit_parts(model: HandModel, digit: int) -> _Digit:
    capsules, skeleton = model.capsules, model.skeleton
    first = 1 + 3 * digit
    places = np.array([int(np.flatnonzero(capsules.bones == first + number)[0]) for number in range(3)])
    meets = np.zeros((len(capsules.bones),) * 2, dtype=bool)
    pairs = capsules.touching_pairs()
    meets[pairs[:, 0], pairs[:, 1]] = meets[pairs[:, 1], pairs[:, 0]] = True
    return _Digit(
        capsules=places,
        offsets=skeleton.offsets[first : first + 3],
        rotations=skeleton.rotations[first : first + 3],
        axes=skeleton.axes[4 * digit : 4 * digit + 4],
        ends=np.stack([capsules.starts[places], capsules.ends[places]], axis=1),
        radii=capsules.radii[places],
        meets=meets[places],
        reach=float(skeleton.lengths[first : first + 3].sum() + capsules.radii[places].max()),
    )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _first_contact(moving: Any, moving_radii: Any, still: Any, still_radii: Any, axis: Any) -> Any:
    reach = np.empty(len(moving))
    pairs = np.empty((len(moving_radii) * len(still_radii), 2), dtype=np.int64)
    p, q = np.empty(3), np.empty(3)
    for frame in range(len(moving)):
        count = _pairs_in_line(moving[frame], moving_radii, still[frame], still_radii, axis[frame], pairs)
        shift = FARTHEST
        for _ in range(100):
            gap = 1e9
            for number in range(count):
                i, j = pairs[number, 0], pairs[number, 1]
                for k in range(3):
                    p[k] = moving[frame, i, 0, k] + shift * axis[frame, k]
                    q[k] = moving[frame, i, 1, k] + shift * axis[frame, k]
                near = gap + moving_radii[i] + still_radii[j]
                squared = segment_distance_squared(p, q, still[frame, j, 0], still[frame, j, 1])
                if near > 0.0 and squared < near * near:
                    gap = np.sqrt(squared) - moving_radii[i] - still_radii[j]
            # No point moves faster than the hand: so far it can go without a touch.
            shift -= gap + _PRESS
            if gap + _PRESS < 2e-5 or shift <= NEAREST:
                break
        reach[frame] = max(shift, NEAREST)
    return reach


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _pairs_in_line(
    moving: Any, moving_radii: Any, still: Any, still_radii: Any, axis: Any, pairs: Any
) -> int:
    """Fill in the pairs whose bounding balls meet somewhere along the axis; the others never touch."""
    count = 0
    for i in range(len(moving_radii)):
        for j in range(len(still_radii)):
            along, apart, lengths = 0.0, 0.0, np.zeros(2)
            for k in range(3):
                between = 0.5 * (moving[i, 0, k] + moving[i, 1, k] - still[j, 0, k] - still[j, 1, k])
                along += between * axis[k]
                apart += between * between
                lengths[0] += (moving[i, 1, k] - moving[i, 0, k]) ** 2
                lengths[1] += (still[j, 1, k] - still[j, 0, k]) ** 2
            reach = moving_radii[i] + still_radii[j] + 0.5 * (np.sqrt(lengths[0]) + np.sqrt(lengths[1]))
            if apart - along * along < reach * reach:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return count


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _closing(
    rotations: Any,
    positions: Any,
    start: Any,
    goal: Any,
    parts: Any,
    others: Any,
    radii: Any,
    meets: Any,
    press: Any,
) -> Any:
    share = np.empty(len(start))
    near = np.empty(len(radii), dtype=np.int64)
    knuckle, angles = np.empty(3), np.empty(4)
    bones, scratch = np.empty((3, 2, 3)), np.empty((7, 3))
    for frame in range(len(start)):
        knuckle[:] = positions[frame]
        for row in range(3):
            for column in range(3):
                knuckle[row] += rotations[frame, row, column] * parts.offsets[0, column]
        count = 0
        for j in range(len(radii)):
            reach = parts.reach + radii[j]
            a, b = others[frame, j, 0], others[frame, j, 1]
            if segment_distance_squared(knuckle, knuckle, a, b) < reach * reach:
                near[count] = j
                count += 1
        low, high = 0.0, 1.0
        for step in range(1, _STEPS + _HALVINGS + 1 if count else 1):
            tried = step / _STEPS if step <= _STEPS and high == 1.0 else (low + high) / 2
            for hinge in range(4):
                angles[hinge] = start[frame, hinge] + tried * (goal[frame, hinge] - start[frame, hinge])
            _bend(rotations[frame], positions[frame], angles, parts, bones, scratch)
            if _blocked(bones, parts.radii, others[frame], radii, meets, near[:count], press):
                high = min(tried, 1.0 - 1e-9)
            else:
                low = tried
            if low >= 1.0:
                break
        share[frame] = low if count else 1.0
    return share


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _blocked(bones: Any, bone_radii: Any, others: Any, radii: Any, meets: Any, near: Any, press: Any) -> bool:
    for i in range(3):
        for j in near:
            reach = bone_radii[i] + radii[j] - press
            if meets[i, j] and (
                segment_distance_squared(bones[i, 0], bones[i, 1], others[j, 0], others[j, 1]) < reach * reach
            ):
                return True
    return False


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _posed_digit(rotations: Any, positions: Any, angles: Any, parts: Any) -> Any:
    posed, scratch = np.empty((len(angles), 3, 2, 3)), np.empty((7, 3))
    for frame in range(len(angles)):
        _bend(rotations[frame], positions[frame], angles[frame], parts, posed[frame], scratch)
    return posed


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _bend(rotation: Any, position: Any, angles: Any, parts: Any, posed: Any, scratch: Any) -> None:
    """Capsule axes `posed` (3, 2, 3) of a digit: the forward kinematics of `HandModel`, for one digit."""
    frame, turned, origin = scratch[:3], scratch[3:6], scratch[6]
    frame[:] = rotation
    origin[:] = position
    hinge = 0
    for bone in range(3):
        for row in range(3):
            for column in range(3):
                origin[row] += frame[row, column] * parts.offsets[bone, column]
        _multiply(frame, parts.rotations[bone], turned)
        for _ in range(2 if bone == 0 else 1):
            _turn(frame, parts.axes[hinge], angles[hinge], turned)
            hinge += 1
        for end in range(2):
            for row in range(3):
                posed[bone, end, row] = origin[row]
                for column in range(3):
                    posed[bone, end, row] += frame[row, column] * parts.ends[bone, end, column]


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _multiply(frame: Any, rotation: Any, scratch: Any) -> None:
    scratch[:] = frame
    for row in range(3):
        for column in range(3):
            frame[row, column] = (
                scratch[row, 0] * rotation[0, column]
                + scratch[row, 1] * rotation[1, column]
                + scratch[row, 2] * rotation[2, column]
            )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _turn(frame: Any, axis: Any, angle: Any, scratch: Any) -> None:
    """Turn a frame about an axis of its own (Rodrigues' formula on its rows)."""
    scratch[:] = frame
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    for row in range(3):
        a, b, c = scratch[row, 0], scratch[row, 1], scratch[row, 2]
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        frame[row, 0] = cosine * a + sine * (b * z - c * y) + along * x
        frame[row, 1] = cosine * b + sine * (c * x - a * z) + along * y
        frame[row, 2] = cosine * c + sine * (a * y - b * x) + along * z
