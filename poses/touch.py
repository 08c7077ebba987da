"""Hands brought together until they touch: one backs off along an axis, fingers close until something is met.

Both searches come from the free side and stop at the first contact, so whatever is less far is free too. That
is what lets a motion be smoothed afterwards: towards the free side only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d

from handsim.model import HandModel, join_qpos
from handsim.segments import segment_distance_squared
from handsim.topology import BONES
from poses.couplings import finger_view

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
_LEVELS: Final = 13  # poses between open and closed; between them a finger's bones move on straight lines
_STEPS_A_LEVEL: Final = 2
_HALVINGS: Final = 9
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
    angles = opened[:, 7:].copy()
    busy = np.flatnonzero(strength.max(axis=1) > 0.0)
    if len(busy) == 0:
        return angles
    obstacle = other.capsules.posed(other.forward_kinematics(other_qpos[busy]))
    for press, joints in _STAGES:
        goal = angles.copy()
        finger_view(goal)[..., joints] = finger_view(closed)[..., joints]
        levels = _levels(model, np.concatenate([opened[:, :7], angles], axis=1)[busy], goal[busy])
        current = levels[:, 0].copy()
        for digit in _ORDER:
            bones, pairs = _parts(model, digit)
            share = np.ones(len(angles))
            share[busy] = _closing(
                levels, current, bones, pairs, model.capsules.radii, obstacle, other.capsules.radii, press
            )
            share = smooth_below(share, window) * strength[:, digit]
            current[:, bones] = _between(levels[:, :, bones], share[busy])
            place = slice(4 * digit, 4 * digit + 4)
            angles[:, place] += share[:, None] * (goal[:, place] - angles[:, place])
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


def _parts(model: HandModel, digit: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A digit's capsules, and its pairs with the rest of the hand."""
    digits = np.array([BONES[bone].digit for bone in model.capsules.bones])
    pairs = model.capsules.touching_pairs()
    return np.flatnonzero(digits == digit), pairs[(digits[pairs] == digit).sum(axis=1) == 1]


def _levels(
    model: HandModel, opened: NDArray[np.float64], closed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Capsule axes (T, levels, K, 2, 3) on the way from open to closed."""
    share = np.linspace(0.0, 1.0, _LEVELS)[:, None]
    start = opened[:, None, 7:]
    angles = (start + share * (closed[:, None] - start)).reshape(-1, closed.shape[1])
    wrist = np.repeat(opened[:, :7], _LEVELS, axis=0)
    qpos = join_qpos(angles, position=wrist[:, :3], quaternion=wrist[:, 3:])
    posed = model.capsules.posed(model.forward_kinematics(qpos))
    return posed.reshape(len(opened), _LEVELS, *posed.shape[1:])


def _between(levels: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Capsule axes at a share of the way, as the search sees them."""
    place = share * (_LEVELS - 1)
    low = np.minimum(place.astype(int), _LEVELS - 2)
    rest = (place - low)[:, None, None, None]
    frames = np.arange(len(levels))
    between: NDArray[np.float64] = (1.0 - rest) * levels[frames, low] + rest * levels[frames, low + 1]
    return between


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _first_contact(moving: Any, moving_radii: Any, still: Any, still_radii: Any, axis: Any) -> Any:
    reach = np.empty(len(moving))
    p, q = np.empty(3), np.empty(3)
    for frame in range(len(moving)):
        shift = FARTHEST
        for _ in range(100):
            gap = 1e9
            for i in range(len(moving_radii)):
                for k in range(3):
                    p[k] = moving[frame, i, 0, k] + shift * axis[frame, k]
                    q[k] = moving[frame, i, 1, k] + shift * axis[frame, k]
                for j in range(len(still_radii)):
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
def _closing(
    levels: Any, current: Any, moving: Any, own: Any, radii: Any, obstacle: Any, others: Any, press: Any
) -> Any:
    share = np.empty(len(levels))
    segments = np.empty(current.shape[1:])
    steps = (_LEVELS - 1) * _STEPS_A_LEVEL
    for frame in range(len(levels)):
        segments[:] = current[frame]
        low, high = 0.0, 1.0
        for step in range(1, steps + 1):
            high = step / steps
            if _blocked(levels[frame], high, segments, moving, own, radii, obstacle[frame], others, press):
                break
            low = high
        for _ in range(_HALVINGS if low < high else 0):
            middle = (low + high) / 2
            if _blocked(levels[frame], middle, segments, moving, own, radii, obstacle[frame], others, press):
                high = middle
            else:
                low = middle
        share[frame] = low
    return share


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _blocked(
    levels: Any, share: Any, segments: Any, moving: Any, own: Any, radii: Any, obstacle: Any, others: Any, press: Any
) -> bool:
    place = share * (_LEVELS - 1)
    low = min(int(place), _LEVELS - 2)
    rest = place - low
    for i in moving:
        segments[i] = (1.0 - rest) * levels[low, i] + rest * levels[low + 1, i]
        for j in range(len(others)):
            reach = radii[i] + others[j] - press
            if (
                segment_distance_squared(segments[i, 0], segments[i, 1], obstacle[j, 0], obstacle[j, 1])
                < reach * reach
            ):
                return True
    for pair in range(len(own)):
        i, j = own[pair, 0], own[pair, 1]
        reach = radii[i] + radii[j] - press
        if (
            segment_distance_squared(segments[i, 0], segments[i, 1], segments[j, 0], segments[j, 1])
            < reach * reach
        ):
            return True
    return False
