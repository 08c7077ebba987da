"""Errors of a calibrated hand in its glove, where the true hand is known.

Markers do not determine all of a hand. The wrist's position in the palm is a convention, so palms are aligned
by the digits' first joints before their markers are compared. A last bone ends in soft tissue that only
contacts determine, so its length is reported apart from those between joints. Everything else is compared
directly: a finger's marker in the frame of its bone, whose origin is the joint and whose x axis points to the
next joint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves import Attachment, GloveFit
from handsim import HandModel
from handsim.errors import ArgumentError
from handsim.hand.shape import PALM
from handsim.space.transforms import rigid_fit


class HandErrors(NamedTuple):
    """Differences between two hands in one glove."""

    positions: Float[np.ndarray, "M"]
    """Of each marker on the bone that carries it on the true hand, palms aligned [m]."""
    wrist_positions: Float[np.ndarray, "M"]
    """The same without the alignment: the palm's markers in the wrist's frame [m]."""
    lengths: Float[np.ndarray, "5 2"]
    """Relative errors of the bones between joints; positive: too long."""
    tips: Float[np.ndarray, "5"]
    """Relative errors of the last bones, to their soft tips."""


def hand_errors(found: GloveFit, true: GloveFit) -> HandErrors:
    """Errors of a hand in its glove.

    Args:
        found: The calibrated hand.
        true: The true one.

    Raises:
        ArgumentError: They are of different sides or wear different gloves.
    """
    if found.side != true.side or found.attachment.layout.names != true.attachment.layout.names:
        raise ArgumentError("the hands are of different sides or gloves, expected two of the same")
    bones = true.attachment.main_bones
    off = _on_bones(found.model, found.attachment, bones) - _on_bones(true.model, true.attachment, bones)
    wrist_positions = np.linalg.norm(off, axis=1)
    rotation, translation = rigid_fit(found.model.skeleton.offsets[1::3], true.model.skeleton.offsets[1::3])
    palm = bones == PALM
    off[palm] = found.attachment.points[palm] @ rotation.T + translation - true.attachment.points[palm]
    lengths = found.model.shape.bone_lengths / true.model.shape.bone_lengths - 1.0
    return HandErrors(np.linalg.norm(off, axis=1), wrist_positions, lengths[:, :2], lengths[:, 2])


def _on_bones(model: HandModel, worn: Attachment, bones: NDArray[np.int64]) -> NDArray[np.float64]:
    """Markers (M, 3) in the frames of these bones (M,) [m]."""
    rest = model.rest_transforms[bones]
    local: NDArray[np.float64] = np.einsum("mji,mj->mi", rest[:, :3, :3], worn.points - rest[:, :3, 3])
    return local
