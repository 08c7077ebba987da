"""Hand shapes as rows of a structured array, the form that files hold."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from handsim.hand.shape import HandShape
from handsim.hand.topology import SIDES

HAND_DTYPE: Final = np.dtype(
    [
        ("left", "?"),
        ("length", "<f8"),
        ("breadth", "<f8"),
        ("bone_lengths", "<f8", (5, 3)),
        ("knuckles", "<f8", (5, 3)),
        ("base_angles", "<f8", (5, 3)),
        ("radii", "<f8", (5, 4)),
        ("palm_thickness", "<f8"),
    ]
)


def pack_hand(shape: HandShape) -> tuple[Any, ...]:
    """A hand as one element of a `HAND_DTYPE` array."""
    return (shape.side == "left", *(getattr(shape, name) for name in (HAND_DTYPE.names or ())[1:]))


def unpack_hand(record: np.void) -> HandShape:
    """The hand of one element of a `HAND_DTYPE` array."""
    fields = {name: record[name] for name in (HAND_DTYPE.names or ())[1:]}
    fields = {name: float(value) if np.ndim(value) == 0 else value for name, value in fields.items()}
    return HandShape(side=SIDES[0] if record["left"] else SIDES[1], **fields)
