"""The 21 keypoints of a hand: the wrist, and four per digit from its first joint to its tip.

The order is FreiHAND's and MediaPipe's: wrist, thumb, index, middle, ring, little. Joints are centers
of rotation; a tip is the far end of the last bone, on the skin.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape
from handsim.hand.topology import DIGITS, NUM_KEYPOINTS, PALM, bones_of

_PARTS: Final = (("CMC", "MCP", "IP", "tip"), *[("MCP", "PIP", "DIP", "tip")] * 4)
KEYPOINT_NAMES: Final[tuple[str, ...]] = (
    "wrist",
    *(f"{digit}_{part}" for digit, parts in zip(DIGITS, _PARTS, strict=True) for part in parts),
)
KEYPOINT_BONES: Final[tuple[int, ...]] = (
    PALM,
    *(bone for digit in DIGITS for bone in (*bones_of(digit), bones_of(digit)[-1])),
)
"""Index in `BONES` of the bone that carries each keypoint: the one that begins there, or of a tip ends."""
KEYPOINT_DIGITS: Final[tuple[int, ...]] = (-1, *np.repeat(np.arange(len(DIGITS)), 4).tolist())
"""Digit of each keypoint, -1 for the wrist."""
SKELETON: Final[tuple[tuple[int, int], ...]] = tuple(
    (0 if part == 0 else 4 * digit + part, 4 * digit + part + 1)
    for digit in range(len(DIGITS))
    for part in range(4)
)
"""Pairs of keypoints that are joined by a line."""
_WRIST: Final = 1.3  # thickness of the wrist, in thicknesses of the palm


def hand_keypoints(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T 21 3"]:
    """Keypoints in the world [m].

    Raises:
        ArgumentError: `qpos` is not (T, 27) or not finite.
    """
    transforms = model.forward_kinematics(qpos)
    points: NDArray[np.float64] = np.empty((len(transforms), NUM_KEYPOINTS, 3))
    points[:, 0] = transforms[:, PALM, :3, 3]
    for number, digit in enumerate(DIGITS):
        bones = bones_of(digit)
        points[:, 4 * number + 1 : 4 * number + 4] = transforms[:, list(bones)][..., :3, 3]
        last = transforms[:, bones[-1]]
        points[:, 4 * number + 4] = last[:, :3, 3] + model.skeleton.lengths[bones[-1]] * last[:, :3, 0]
    return points


def keypoint_thickness(shape: HandShape) -> Float[np.ndarray, "21"]:
    """Thickness of the hand at each keypoint: of the wrist, or of the finger there [m]."""
    fingers = 2.0 * shape.radii
    return np.array([_WRIST * shape.palm_thickness, *fingers.ravel()])
