"""What the markers that are seen leave open of each joint: the solver's information matrix, inverted.

Beside the markers count the limits of the joints alone, as in the solver: a joint of which no marker tells
anything may be anywhere in its range. What hands usually do narrows that further when a hand is tracked.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.fit import GloveFit
from handsim.hand.topology import JOINTS, NUM_JOINTS
from track.glove_advice.observed_hands import ObservedHand
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_spread import known_hand, tip_lengths
from track.kinematics.pose_spread import pose_spreads as spreads_of_poses

NOISE: Final = 0.0015
"""Standard deviation of a marker around a calibrated hand's [m]: optics, and the skin that moves."""
_FEWEST: Final = 4  # markers of a pose


def joint_spreads(hands: Iterable[ObservedHand], *, without: int | None = None) -> Float[np.ndarray, "20"]:
    """Standard deviation of each joint's error [rad], its root mean square over the frames.

    Args:
        hands: Hands in their poses; of frames with fewer than four markers nothing is known.
        without: A marker that counts as never seen.
    """
    parts = []
    for hand in hands:
        seen = np.isfinite(hand.frames.observed[..., 0])
        if without is not None:
            seen[:, without] = False
        parts.append((hand.fit, hand.qpos, seen))
    return pose_spreads(parts)


def pose_spreads(
    poses: Iterable[tuple[GloveFit, Float[np.ndarray, "T 27"], Bool[np.ndarray, "T M"]]],
) -> Float[np.ndarray, "20"]:
    """`joint_spreads` of hands in their gloves, their poses, and which markers are seen."""
    squares, count = np.zeros(NUM_JOINTS), 0
    for fit, qpos, seen in poses:
        good = seen.sum(axis=1) >= _FEWEST
        squares += _variances(fit, qpos[good], seen[good]).sum(axis=0)
        squares += np.count_nonzero(~good) * untold_spreads() ** 2
        count += len(good)
    spreads: Float[np.ndarray, "20"] = np.sqrt(squares / max(1, count))
    return spreads


def untold_spreads() -> Float[np.ndarray, "20"]:
    """Standard deviation of each joint where nothing is seen: anywhere in its range [rad]."""
    spreads: Float[np.ndarray, "20"] = np.deg2rad([joint.high - joint.low for joint in JOINTS]) / np.sqrt(
        12.0
    )
    return spreads


def _variances(
    fit: GloveFit, qpos: Float[np.ndarray, "T 27"], seen: Bool[np.ndarray, "T M"]
) -> Float[np.ndarray, "T 20"]:
    """Variance of each joint [rad^2]."""
    hand, limits = hand_arrays(fit), np.diag(untold_spreads() ** -2.0)
    unseen = np.where(seen, 0.0, np.inf)
    spreads, _ = spreads_of_poses(
        hand, tip_lengths(fit), limits, known_hand(hand.digits, NOISE), qpos, unseen
    )
    variances: Float[np.ndarray, "T 20"] = spreads**2
    return variances
