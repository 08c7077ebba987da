"""FreiHAND: `training_K.json` and the files beside it, one entry per hand, for loaders of that dataset.

`K @ xyz` gives pixels that are counted from the first one's center. Left hands stay left hands, although
FreiHAND has none; `training_info.json` says which is which. There are no MANO parameters:
`training_mano.json` holds a null an entry, so that its readers find a list of the right length.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from render.formats.annotations.common import centered_K, is_seen, rounded
from render.frames import RenderedFrame

SET: Final = "training"
LISTS: Final = ("K", "xyz", "scale", "mano", "info")
"""The JSON files that every set has; `verts` is written on demand."""


def hand_entries(frame: RenderedFrame, *, vertices: bool) -> list[tuple[int, dict[str, Any]]]:
    """The visible hands: their indices in the frame, and their entries in each of the lists.

    Args:
        frame: Of a pinhole camera.
        vertices: Whether to add the skin, some 150 kB a hand.

    Raises:
        HandSimError: The camera's lens is not a pinhole.
    """
    K = centered_K(frame.camera).tolist()
    entries = []
    for number, hand in enumerate(frame.hands):
        if not is_seen(hand):
            continue
        # The bone that FreiHAND measures hands by: the middle finger's first.
        scale = float(np.linalg.norm(hand.keypoints_world[10] - hand.keypoints_world[9]))
        entry: dict[str, Any] = {
            "K": K,
            "xyz": rounded(frame.camera.local(hand.keypoints_world), 9),
            "scale": scale,
            "mano": None,
            "info": {"side": hand.shape.side, "frame": frame.number, "camera": frame.camera.name},
        }
        if vertices:
            entry["verts"] = rounded(frame.camera.local(hand.vertices), 6)
        entries.append((number, entry))
    return entries
