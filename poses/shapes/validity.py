"""Poses a body could strike: in range, and not dug into itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.errors import PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import JOINTS
from poses.shapes.couplings import HIGH, LOW
from poses.shapes.library import gesture
from poses.shapes.samplers import DEFAULT_MIX, PoseMix, sample_angles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

MAX_PENETRATION: Final = 0.001
"""Deepest self-penetration [m] of a pose that counts as valid: what skin gives way."""
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


def resting_angles(model: HandModel) -> Float[np.ndarray, "20"]:
    """A valid relaxed pose of this hand, its fingers fanned just as far as its girth asks for.

    Raises:
        PoseError: No fan makes room for these fingers.
    """
    fans = np.arange(0.0, 13.0, 2.0)
    tries = np.tile(gesture("relaxed"), (len(fans), 1))
    tries[:, 4::4] += fans[:, None] * _FAN
    valid = is_valid(model, tries, max_penetration=0.8 * MAX_PENETRATION)
    if not valid.any():
        raise PoseError("this hand's fingers overlap at rest: its girths are too large for its breadth")
    resting: NDArray[np.float64] = tries[valid.argmax()]
    return resting


def make_valid(model: HandModel, angles: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "T 20"]:
    """Poses [rad] moved towards rest just until they are valid; valid ones stay as they are.

    What is in the way gives way first: the thumb alone, then thumb and abductions, and only where that is not
    enough the whole hand opens. The way back is halved a few times, so that a fist that was too tight ends as
    a fist whose fingers touch.
    """
    resting = resting_angles(model)
    result = np.array(angles, dtype=np.float64)
    todo = np.flatnonzero(~is_valid(model, result))
    for moving in (_THUMB, _THUMB | _ABDUCTIONS, np.ones_like(_THUMB)):
        wanted = result[todo]
        end = np.where(moving, resting, wanted)
        helps = is_valid(model, end)
        result[todo[helps]] = _nearest_valid(model, end[helps], wanted[helps])
        todo = todo[~helps]
    return result


def _nearest_valid(
    model: HandModel, valid_end: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The last valid poses found by halving the ways from valid ends to wanted poses."""
    low, high = np.zeros(len(wanted)), np.ones(len(wanted))  # share of the wanted pose: valid, invalid
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        valid = is_valid(model, valid_end + middle[:, None] * (wanted - valid_end))
        low, high = np.where(valid, middle, low), np.where(valid, high, middle)
    return valid_end + low[:, None] * (wanted - valid_end)


def sample_valid_angles(
    model: HandModel, count: int, mix: PoseMix = DEFAULT_MIX, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Random valid poses [rad] of one hand, inside ranges, couplings and `MAX_PENETRATION`."""
    return make_valid(model, sample_angles(count, mix, rng=rng))
