"""Hands brought together until they touch: one backs off along an axis, fingers close until they meet a hand.

Both searches start from the free side and stop at the first contact, so everything before it is free too. A
motion can therefore be smoothed afterwards, towards the free side only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d

from handsim.hand.model import HandModel
from handsim.space.transforms import quaternion_matrix
from poses.contact.contact_search import (
    NEAREST,
    Digit,
    DigitPaths,
    Obstacles,
    pose_digit,
    search_closing,
    search_contact,
)

__all__ = ["NEAREST", "close_fingers", "first_contact", "smooth_above", "smooth_below"]

from jaxtyping import Float
from numpy.typing import NDArray

# Fingers close in two stages: what stops a knuckle does not stop the joints beyond it. Each stage has a depth
# [m] to which a finger presses into the other hand or its own, and the joints of a digit that it moves.
_STAGES: Final = ((0.0006, slice(0, 4)), (0.0008, slice(2, 4)))
_ORDER: Final = (1, 2, 3, 4, 0)  # the thumb closes last, over what the fingers hold


def first_contact(
    still: HandModel,
    still_qpos: Float[np.ndarray, "T 27"],
    moving: HandModel,
    moving_qpos: Float[np.ndarray, "T 27"],
    axis: Float[np.ndarray, "T 3"],
) -> Float[np.ndarray, "T"]:
    """Distance along `axis` [m] at which the moving hand, coming from outside, first touches the still one.

    Everything farther out is free. Frames without a contact give `NEAREST`. The axis is the unit direction in
    the world in which the moving hand backs off; its poses are those at distance zero.
    """
    distance: NDArray[np.float64] = search_contact(
        moving.capsules.posed(moving.forward_kinematics(moving_qpos)),
        moving.capsules.radii,
        still.capsules.posed(still.forward_kinematics(still_qpos)),
        still.capsules.radii,
        axis,
    )
    return distance


def close_fingers(
    model: HandModel,
    opened: Float[np.ndarray, "T 27"],
    closed: Float[np.ndarray, "T 20"],
    strength: Float[np.ndarray, "T 5"],
    *,
    other: HandModel,
    other_qpos: Float[np.ndarray, "T 27"],
    window: int = 1,
) -> Float[np.ndarray, "T 20"]:
    """Joint angles [rad] of fingers that close from one pose towards another until they meet a hand.

    Args:
        opened: Poses with open fingers.
        closed: Joint angles [rad] of the fingers if nothing blocks them.
        strength: Share of the path that each digit closes then.
        other: The hand that blocks the fingers, besides their own, in its poses.
        window: Frames over which the paths are smoothed; 1 leaves each frame alone.
    """
    busy = np.flatnonzero(strength.max(axis=1) > 0.0)
    angles = opened[:, 7:].copy()
    rotations, positions = quaternion_matrix(opened[busy, 3:7]), opened[busy, :3]
    own = model.capsules.posed(model.forward_kinematics(opened[busy]))
    others = other.capsules.posed(other.forward_kinematics(other_qpos[busy]))
    all_of_other = np.ones((3, len(other.capsules.radii)), dtype=bool)
    for press, joints in _STAGES:
        for digit in _ORDER:
            parts = digit_parts(model, digit)
            columns = slice(4 * digit, 4 * digit + 4)
            goal = angles[:, columns].copy()
            goal[:, joints] = closed[:, columns][:, joints]
            share = np.ones(len(angles))
            share[busy] = search_closing(
                DigitPaths(rotations, positions, angles[busy, columns], goal[busy]),
                parts,
                Obstacles(
                    np.concatenate([others, own[:, parts.others]], axis=1),
                    np.concatenate([other.capsules.radii, model.capsules.radii[parts.others]]),
                    np.concatenate([all_of_other, parts.meets[:, parts.others]], axis=1),
                    press,
                ),
            )
            share = smooth_below(share, window) * strength[:, digit]
            angles[:, columns] += share[:, None] * (goal - angles[:, columns])
            own[:, parts.capsules] = pose_digit((rotations, positions), angles[busy, columns], parts)
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


@lru_cache(maxsize=4 * len(_ORDER))
def digit_parts(model: HandModel, digit: int) -> Digit:
    """A digit of a hand (0: thumb) as the compiled searches need it."""
    capsules, skeleton = model.capsules, model.skeleton
    first = 1 + 3 * digit
    indices = np.array([int(np.flatnonzero(capsules.bones == first + number)[0]) for number in range(3)])
    meets = np.zeros((len(capsules.bones),) * 2, dtype=bool)
    pairs = capsules.touching_pairs()
    meets[pairs[:, 0], pairs[:, 1]] = meets[pairs[:, 1], pairs[:, 0]] = True
    return Digit(
        capsules=indices,
        others=np.setdiff1d(np.arange(len(capsules.bones)), indices),
        offsets=skeleton.offsets[first : first + 3],
        rotations=skeleton.rotations[first : first + 3],
        axes=skeleton.axes[4 * digit : 4 * digit + 4],
        ends=np.stack([capsules.starts[indices], capsules.ends[indices]], axis=1),
        radii=capsules.radii[indices],
        meets=meets[indices],
        reach=float(skeleton.lengths[first : first + 3].sum() + capsules.radii[indices].max()),
    )
