"""How far a calibrated hand in its glove is from the true one, where the truth is known.

Some of a hand no marker tells. Where the wrist is in the palm is a convention, so palms are laid on each
other by the digits' first joints before their markers are compared; a last bone ends in soft tissue that only
touches tell, so its length is told apart from those between joints. Everything else is compared as it is: a
finger's marker in the frame of its bone, whose origin is the joint and whose x axis points to the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gloves.attachment import Attachment
from gloves.fit import GloveFit
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel
from handsim.hand.topology import PALM

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray


class HandErrors(NamedTuple):
    """Differences between two hands in one glove."""

    places: Float[np.ndarray, "M"]
    """Of each marker on the bone that truly carries it, palms laid on each other [m]."""
    wrist_places: Float[np.ndarray, "M"]
    """The same with the palm's markers in the wrist's own frame [m]."""
    lengths: Float[np.ndarray, "5 2"]
    """Of the bones between joints, in shares of the true ones; positive: too long."""
    tips: Float[np.ndarray, "5"]
    """Of the last bones, to their soft tips."""


def hand_errors(found: GloveFit, true: GloveFit) -> HandErrors:
    """How far a hand in its glove is from the true one.

    Raises:
        ArgumentError: They are of different sides or wear different gloves.
    """
    if found.side != true.side or found.attachment.layout.names != true.attachment.layout.names:
        raise ArgumentError("the hands are of different sides or gloves, expected two of the same")
    bones = true.attachment.main_bones
    off = _on_bones(found.model, found.attachment, bones) - _on_bones(true.model, true.attachment, bones)
    wrist_places = np.linalg.norm(off, axis=1)
    turn, shift = _laid(found.model.skeleton.offsets[1::3], true.model.skeleton.offsets[1::3])
    palm = bones == PALM
    off[palm] = found.attachment.points[palm] @ turn.T + shift - true.attachment.points[palm]
    lengths = found.model.shape.bone_lengths / true.model.shape.bone_lengths - 1.0
    return HandErrors(np.linalg.norm(off, axis=1), wrist_places, lengths[:, :2], lengths[:, 2])


def _on_bones(model: HandModel, worn: Attachment, bones: NDArray[np.int64]) -> NDArray[np.float64]:
    """Markers in the frames of these bones [m]."""
    rest = model.rest_transforms[bones]
    local: NDArray[np.float64] = np.einsum("mji,mj->mi", rest[:, :3, :3], worn.points - rest[:, :3, 3])
    return local


def _laid(source: NDArray[np.float64], target: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Rotation and shift that bring points nearest to others (Kabsch 1976)."""
    middle, there = source.mean(axis=0), target.mean(axis=0)
    left, _, right = np.linalg.svd((target - there).T @ (source - middle))
    handed = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    turn = left @ handed @ right
    return turn, there - turn @ middle
