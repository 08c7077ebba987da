"""Joint orders of other data sets, as indices of our 21 (`handsim.hand.model`), and conversions.

One table, because a wrong permutation looks almost right. The index `ABSENT` marks a joint that we lack.

- FreiHAND, MediaPipe and COCO-WholeBody: wrist, then thumb to little, base to tip. This is ours.
- MANO with its tips appended, as in HO-3D and H2O-3D: wrist, three joints each of index, middle, little, ring
  and thumb, then the tips from thumb to little.
- InterHand2.6M: thumb to little, tip to base, then the wrist; its files have 42, a right hand and a left one.
- HANDS17 and BigHand2.2M: wrist, five first joints, then the other three per digit.
- OpenXR: palm, wrist, four of the thumb, five per finger from its metacarpal on; WebXR has no palm.
- UmeTrack and HOT3D: five tips, wrist, thumb without its base, three joints per finger; with 21 landmarks the
  palm's center comes last.
"""

from __future__ import annotations

from itertools import chain
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import ArgumentError
from handsim.hand.shape import NUM_KEYPOINTS

ABSENT: Final = -1
_WRIST: Final = 0
_THUMB, _INDEX, _MIDDLE, _RING, _LITTLE = _DIGITS = tuple(
    tuple(range(4 * digit + 1, 4 * digit + 5)) for digit in range(5)
)


def _flat(*parts: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(chain.from_iterable(parts))


_OURS: Final = tuple(range(NUM_KEYPOINTS))
_TIPS: Final = tuple(digit[3] for digit in _DIGITS)
_MANO: Final = _flat((_WRIST,), *(digit[:3] for digit in (_INDEX, _MIDDLE, _LITTLE, _RING, _THUMB)), _TIPS)
_INTERHAND: Final = _flat(*(digit[::-1] for digit in _DIGITS), (_WRIST,))
_HANDS17: Final = _flat((_WRIST,), tuple(digit[0] for digit in _DIGITS), *(digit[1:] for digit in _DIGITS))
_WEBXR: Final = _flat((_WRIST,), _THUMB, *((ABSENT, *digit) for digit in _DIGITS[1:]))
_UMETRACK: Final = _flat(_TIPS, (_WRIST,), _THUMB[1:3], *(digit[:3] for digit in _DIGITS[1:]))

JOINT_ORDERS: Final[dict[str, tuple[int, ...]]] = {
    "handsim": _OURS,
    "freihand": _OURS,
    "mediapipe": _OURS,
    "coco_wholebody_hand": _OURS,
    "mano": _MANO,
    "ho3d": _MANO,
    "interhand": _INTERHAND,
    "hands17": _HANDS17,
    "bighand": _HANDS17,
    "openxr": (ABSENT, *_WEBXR),
    "webxr": _WEBXR,
    "umetrack": _UMETRACK,
    "hot3d": _UMETRACK,
    "umetrack21": (*_UMETRACK, ABSENT),
}
"""Index in `KEYPOINT_NAMES` of every joint of an order."""


def joint_order(name: str) -> tuple[int, ...]:
    """One of `JOINT_ORDERS`."""
    check_choice(name, JOINT_ORDERS, noun="joint order")
    return JOINT_ORDERS[name]


def to_order(points: Float[np.ndarray, "*batch 21 k"], name: str) -> Float[np.ndarray, "*batch n k"]:
    """Our keypoints, or other rows with one per keypoint, in one of `JOINT_ORDERS`; NaN for those we lack.

    Raises:
        ArgumentError: The order is unknown, or there are not 21 points.
    """
    order, points = list(joint_order(name)), _rows(points, NUM_KEYPOINTS, "our keypoints")
    nowhere = np.full_like(points[..., :1, :], np.nan)
    return np.concatenate([points, nowhere], axis=-2)[..., order, :]


def _rows(points: NDArray[np.floating], count: int, noun: str) -> NDArray[np.floating]:
    points = np.asarray(points)
    if points.ndim < 2 or points.shape[-2] != count:
        raise ArgumentError(f"{noun} have shape {points.shape}, expected (..., {count}, k)")
    return points if np.issubdtype(points.dtype, np.floating) else points.astype(np.float64)
