"""Joint angles as the International Society of Biomechanics, ISB, writes them (Wu and others 2005).

The axes of a bone of the right hand are X to the palm's side, Y to the elbow and Z to the thumb's side. A
joint turns about Z of the inner bone (flexion), about the axis that is perpendicular to the two others (ulnar
deviation), and about Y of the outer bone (pronation). A left hand is mirrored first, so its signs are equal.

A finger's metacarpal has the axes of the flat finger. Skin markers do not measure the trapezium, so the first
metacarpal turns relative to the hand: towards the palm, to the thumb's side, and about its length.

The wrist's angles are those of the third metacarpal relative to the forearm; both have the same axes when
the wrist is straight. The third angle, pronation, is left out: it is mostly skin that slides on the forearm.
The forearm's own pronation is the turn of the radius about the forearm's length, against the line through the
epicondyles of the elbow; it is zero where the styloids are parallel to this line, in full supination.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.shape import DIGITS, JOINT_NAMES, JOINTS_PER_DIGIT, HandShape, Side
from handsim.space.transforms import MIRROR, axis_angle_matrix, euler_matrix

Convention = Literal["model", "isb"]
"""Convention of joint angles: `model` has those of the model's hinges, `isb` those of Wu and others 2005."""
_THUMB_ANGLES: Final = (
    *(f"thumb_metacarpal_{name}" for name in ("palmar_abduction", "radial_abduction", "pronation")),
    "thumb_MCP_flexion",
    "thumb_IP_flexion",
)
_FINGER_ANGLES: Final = ("MCP_flexion", "MCP_ulnar_deviation", "MCP_pronation", "PIP_flexion", "DIP_flexion")
ISB_NAMES: Final = (*_THUMB_ANGLES, *(f"{digit}_{name}" for digit in DIGITS[1:] for name in _FINGER_ANGLES))
ISB_JOINTS: Final = tuple(
    next(number for number, joint in enumerate(JOINT_NAMES) if joint.split("_")[:2] == name.split("_")[:2])
    for name in ISB_NAMES
)
"""Index of a hinge of the model that is of the same joint, for each of these angles."""
WRIST_NAMES: Final = ("wrist_flexion", "wrist_radial_deviation", "forearm_pronation")
"""Angles of a wrist whose forearm has markers, and of a forearm whose elbow has markers, too."""
_ISB_AXES: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""The ISB's axes X, Y and Z as columns, in our frame of a bone."""


def isb_angles(
    shape: HandShape, angles: Float[np.ndarray, "T 20"], neutral: Float[np.ndarray, "20"] | None = None
) -> Float[np.ndarray, "T 25"]:
    """The angles of `ISB_NAMES` [rad] from the angles of the model's hinges; NaN stays NaN.

    All of them are zero in the pose `neutral`. If it is None, the fingers' angles are zero in the flat hand,
    and the first metacarpal's angles are zero where it points along the hand.
    """
    known = np.isfinite(angles[:, 0])
    outer, rotations = angles[known], _first_bone_rotations(shape, angles[known])
    if neutral is not None:
        outer = outer - neutral
        rotations = rotations @ np.swapaxes(_first_bone_rotations(shape, neutral[None]), -1, -2)
    first = _cardan_angles(rotations.reshape(-1, 3, 3)).reshape(-1, len(DIGITS), 3)
    first[:, 0, 1] *= -1.0  # radial abduction of the thumb is the opposite of ulnar deviation
    found = np.full((len(angles), len(ISB_NAMES)), np.nan)
    both = first, outer.reshape(-1, len(DIGITS), JOINTS_PER_DIGIT)[..., 2:]
    found[known] = np.concatenate(both, axis=2).reshape(-1, len(ISB_NAMES))
    return found


def wrist_angles(
    side: Side, hands: Float[np.ndarray, "T 3 3"], forearms: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T 3"]:
    """The angles of `WRIST_NAMES` [rad], NaN where a rotation is.

    Radial deviation is minus the ISB's second angle, which counts ulnar deviation positive.

    Args:
        side: The hand.
        hands: Rotations of the hand in the forearm's frame.
        forearms: Rotations of the forearm in the elbow's frame, whose y axis goes through the epicondyles.
    """
    return np.column_stack([wrist_cardan(side, hands)[:, :2], wrist_cardan(side, forearms)[:, 2]])


def wrist_cardan(side: Side, rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Flexion, radial deviation and pronation (T, 3) [rad] of rotations; NaN where a rotation is NaN."""
    known, angles = np.isfinite(rotations[:, 0, 0]), np.full((len(rotations), 3), np.nan)
    right = MIRROR @ rotations[known] @ MIRROR if side == "left" else rotations[known]
    angles[known] = _cardan_angles(right) * [1.0, -1.0, 1.0]
    return angles


def _cardan_angles(rotations: Float[np.ndarray, "K 3 3"]) -> NDArray[np.float64]:
    """Flexion, ulnar deviation and pronation (K, 3) [rad] of rotations in our frame of the inner bone."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(_ISB_AXES.T @ rotations @ _ISB_AXES).as_euler("ZXY"))


def _first_bone_rotations(shape: HandShape, angles: Float[np.ndarray, "T 20"]) -> NDArray[np.float64]:
    """Orientation (T, 5, 3, 3) of each digit's first bone in the wrist's frame, as on a right hand."""
    by_digit = angles.reshape(-1, len(DIGITS), JOINTS_PER_DIGIT)
    _, y, z = np.eye(3)
    rotations = axis_angle_matrix(z, by_digit[..., 0]) @ axis_angle_matrix(y, by_digit[..., 1])
    rotations[:, 0] = euler_matrix(shape.base_angles[0]) @ rotations[:, 0]
    return rotations
