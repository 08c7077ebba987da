"""What the markers that are seen leave open of each joint: the solver's information matrix, inverted.

Beside the markers count the limits of the joints alone, as in the solver: a joint of which no marker tells
anything may be anywhere in its range. What hands usually do narrows that further when a hand is tracked.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.fit import GloveFit, attach_markers
from gloves.layout import FEWEST_MARKERS, MarkerLayout, MarkerPlace
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, JOINTS, NUM_JOINTS, PALM
from track.glove_advice.observed_hands import ObservedHand
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_spread import known_hand, tip_lengths
from track.kinematics.pose_spread import pose_spreads as spreads_of_poses

NOISE: Final = 0.0015
"""Standard deviation of a marker around a calibrated hand's [m]: optics, and the skin that moves."""
_FEWEST: Final = 4  # markers of a pose
_FEWEST_OF_BODY: Final = 3  # of a rigid body
_IN_LINE: Final = 1e-8  # [m^2]
_RADIUS: Final = 0.003  # [m]


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
    return np.sqrt(squares / max(1, count))


def palm_spread(places: Sequence[MarkerPlace], model: HandModel) -> float:
    """Standard deviation of the palm's rotation about its least certain axis, by its own markers [rad].

    Infinite with fewer than three markers on the palm, or three in a line.
    """
    palm = [place for place in places if place.bone == BONE_NAMES[PALM]]
    if len(palm) < _FEWEST_OF_BODY:
        return float("inf")
    copies = (*palm, *[palm[0]] * (FEWEST_MARKERS - len(palm)))  # the fewest that a glove has
    named = tuple(dataclasses.replace(place, name=str(number)) for number, place in enumerate(copies))
    points = attach_markers(MarkerLayout("palm", named, _RADIUS), model).points[: len(palm)]
    arms = points - points.mean(axis=0)
    information = (arms**2).sum() * np.eye(3) - arms.T @ arms
    least = float(np.linalg.eigvalsh(information)[0])
    return float(NOISE / np.sqrt(least)) if least > _IN_LINE else float("inf")


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
    return spreads**2
