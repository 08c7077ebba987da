"""Valid poses: joint angles in range, and no deep overlap of the hand with itself."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_array
from handsim.errors import PoseError
from handsim.hand.model import HandModel, join_qpos, load_model
from handsim.hand.shape import JOINTS, NUM_QPOS, HandShape
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture
from poses.shapes.samplers import DEFAULT_MIX, PoseMix, sample_angles

MAX_PENETRATION: Final = 0.001
"""Deepest self-penetration [m] of a valid pose: skin yields by about this much."""
_HALVINGS: Final = 4
_THUMB: Final = np.array([joint.name.startswith("thumb") for joint in JOINTS])
_ABDUCTIONS: Final = np.array([joint.name.endswith("abduction") for joint in JOINTS])
_FAN: Final = np.deg2rad([1.0, 0.2, -0.6, -1.4])


def is_valid(
    model: HandModel, angles: Float[np.ndarray, "T 20"], *, max_penetration: float = MAX_PENETRATION
) -> Bool[np.ndarray, "T"]:
    """Which poses are inside all ranges and penetrate no deeper than `max_penetration` [m]."""
    inside = ((angles >= LOW - 1e-9) & (angles <= HIGH + 1e-9)).all(axis=1)
    free: NDArray[np.bool_] = model.penetration(join_qpos(angles)) <= max_penetration
    return inside & free


def validate(model: HandModel | HandShape | str, qpos: Float[np.ndarray, "T 27"]) -> Bool[np.ndarray, "T"]:
    """Which poses this hand can strike: in range, and at most 1 mm deep in itself (`MAX_PENETRATION`).

    Args:
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.
        qpos: Wrist position [m], wrist orientation (wxyz), joint angles [rad]; the wrist may be anywhere.

    Raises:
        ArgumentError: `model` is none of these, or `qpos` is not (T, 27) or not finite.
    """
    return is_valid(load_model(model), check_array("qpos", qpos, (None, NUM_QPOS))[:, 7:])


def resting_angles(model: HandModel) -> Float[np.ndarray, "20"]:
    """A valid relaxed pose of this hand, its fingers fanned just as far as their girth needs."""
    fans = np.arange(0.0, 13.0, 2.0)
    tries = np.tile(gesture("relaxed"), (len(fans), 1))
    tries[:, 4::4] += fans[:, None] * _FAN
    valid = is_valid(model, tries, max_penetration=0.8 * MAX_PENETRATION)
    if not valid.any():
        raise PoseError("this hand's fingers overlap at rest: its girths are too large for its breadth")
    resting: NDArray[np.float64] = tries[valid.argmax()]
    return resting


def make_valid(
    model: HandModel | HandShape | str, angles: Float[np.ndarray, "T 20"]
) -> Float[np.ndarray, "T 20"]:
    """Poses [rad] moved towards rest just until they are valid; valid ones stay as they are.

    The thumb alone moves first, then thumb and abductions, and the whole hand opens only where that is not
    enough. The path to rest is bisected a few times, so that a fist that was too tight ends as a fist whose
    fingers touch.

    Args:
        model: The hand; a shape or the name of a size is a right one.

    Raises:
        PoseError: This hand has no valid pose at rest.
    """
    model = load_model(model)
    resting = resting_angles(model)
    result = np.array(angles, dtype=np.float64)
    todo = np.flatnonzero(~is_valid(model, result))
    for moving in (_THUMB, _THUMB | _ABDUCTIONS, np.ones_like(_THUMB)):
        target = result[todo]
        end = np.where(moving, resting, target)
        helps = is_valid(model, end)
        result[todo[helps]] = _nearest_valid(model, end[helps], target[helps])
        todo = todo[~helps]
    return result


def _nearest_valid(
    model: HandModel, valid_end: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The last valid poses that bisection finds between valid ends and target poses."""
    low, high = np.zeros(len(target)), np.ones(len(target))  # share of the target pose: valid, invalid
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        valid = is_valid(model, valid_end + middle[:, None] * (target - valid_end))
        low, high = np.where(valid, middle, low), np.where(valid, high, middle)
    return valid_end + low[:, None] * (target - valid_end)


def sample_valid_angles(
    model: HandModel, count: int, mix: PoseMix = DEFAULT_MIX, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Random valid poses [rad] of one hand, inside ranges, couplings and `MAX_PENETRATION`."""
    return make_valid(model, sample_angles(count, mix, rng=rng))
