"""Couplings between joints: a projection of joint angles onto those of a relaxed hand.

Sources (docs/anatomy.md): DIP follows PIP (two thirds on average; Lin, Wu and Huang 2000), abduction dies
away as the MCP flexes (collateral ligaments tighten), and neighbors share tendons, so that one finger's
flexion drags the next.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from handsim.hand.shape import JOINTS

LOW: Final = np.deg2rad([joint.low for joint in JOINTS])
HIGH: Final = np.deg2rad([joint.high for joint in JOINTS])

_NO_ABDUCTION_AT: Final = np.deg2rad(85.0)  # MCP flexion at which abduction has shrunk to the share below
_ABDUCTION_LEFT: Final = 0.25
_DIP_SHARE: Final = 2.0 / 3.0
_DIP_BELOW: Final = np.deg2rad(32.0)  # how far the DIP may be below or above its share of the PIP
_DIP_ABOVE: Final = np.deg2rad(28.0)
# How much more than its neighbor a finger's MCP may flex [rad]: index-middle, middle-ring, ring-little.
_MCP_APART: Final = np.deg2rad([85.0, 70.0, 75.0])


def finger_view(angles: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "T 5 4"]:
    """The same angles (T, 5, 4), one row per digit; a view, so writing to it writes to `angles`."""
    return angles.reshape(*angles.shape[:-1], 5, 4)


def apply_couplings(angles: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "T 20"]:
    """Nearest-by-clamping angles [rad] that respect ranges and couplings."""
    coupled = np.clip(angles, LOW, HIGH)
    fingers = finger_view(coupled)[:, 1:]
    flexion = fingers[..., 1]
    for near, far, apart in ((1, 0, 0), (1, 2, 1), (2, 3, 2)):
        limit = _MCP_APART[apart]
        flexion[:, far] = np.clip(flexion[:, far], flexion[:, near] - limit, flexion[:, near] + limit)
    left = 1.0 - (1.0 - _ABDUCTION_LEFT) * np.clip(flexion / _NO_ABDUCTION_AT, 0.0, 1.0)
    low, high = LOW.reshape(5, 4)[1:, 0], HIGH.reshape(5, 4)[1:, 0]
    fingers[..., 0] = np.clip(fingers[..., 0], low * left, high * left)
    follow = _DIP_SHARE * np.maximum(fingers[..., 2], 0.0)
    fingers[..., 3] = np.clip(fingers[..., 3], follow - _DIP_BELOW, follow + _DIP_ABOVE)
    inside: np.ndarray = np.clip(coupled, LOW, HIGH)
    return inside
