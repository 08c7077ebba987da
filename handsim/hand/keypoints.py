"""The 21 keypoints of a hand: the wrist, and four per digit from its first joint to its tip.

The order is FreiHAND's and MediaPipe's: wrist, thumb, index, middle, ring, little. Joints are centers
of rotation; a tip is the far end of the last bone, on the skin.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import DIGITS, NUM_JOINTS, PALM, bones_of

_PARTS: Final = (("CMC", "MCP", "IP", "tip"), *[("MCP", "PIP", "DIP", "tip")] * 4)
KEYPOINT_NAMES: Final[tuple[str, ...]] = (
    "wrist",
    *(f"{digit}_{part}" for digit, parts in zip(DIGITS, _PARTS, strict=True) for part in parts),
)
NUM_KEYPOINTS: Final = len(KEYPOINT_NAMES)
KEYPOINT_DIGITS: Final[tuple[int, ...]] = (-1, *np.repeat(np.arange(len(DIGITS)), 4).tolist())
"""Digit of each keypoint, -1 for the wrist."""
SKELETON: Final[tuple[tuple[int, int], ...]] = tuple(
    (0 if part == 0 else 4 * digit + part, 4 * digit + part + 1)
    for digit in range(len(DIGITS))
    for part in range(4)
)
"""Pairs of keypoints that are joined by a line."""
_ACROSS, _ALONG = 0.004, 0.035  # [m] around and along a joint's normal, within which skin is its own


def hand_keypoints(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T 21 3"]:
    """Keypoints in the world [m].

    Args:
        model: The hand.
        qpos: Poses.

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


def keypoint_flesh(model: HandModel) -> Float[np.ndarray, "21"]:
    """How deep each keypoint lies in the flat hand, below its back or its palm, whichever is more [m].

    A tip lies on the skin, but counts as deep as its digit's last joint: its pulp is in front of it in most
    views.

    Args:
        model: The hand.
    """
    qpos = join_qpos(np.zeros((1, NUM_JOINTS)))
    keypoints, skin = hand_keypoints(model, qpos)[0], model.skin(qpos)[0]
    bones = [PALM, *(bone for digit in DIGITS for bone in (*bones_of(digit), bones_of(digit)[-1]))]
    rotations = model.forward_kinematics(qpos)[0, bones, :3, :3]
    local = (skin - keypoints[:, None]) @ rotations
    height = np.abs(local[..., 2])
    own = (local[..., 0] ** 2 + local[..., 1] ** 2 < _ACROSS**2) & (height < _ALONG)
    flesh: NDArray[np.float64] = np.where(own, height, 0.0).max(axis=1)
    flesh[4::4] = flesh[3::4]
    return flesh
