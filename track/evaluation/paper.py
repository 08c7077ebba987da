"""The tracking results of Han et al. 2018, as shares; Table 5 with two rows exchanged.

The printed Table 5 has the paper's own figures of hand-hand and hand-pen in each other's row: 4477 frames are
more than the 3312 of hand-hand, and 3101 of 3312 is the product of Table 7's two shares.
"""

from __future__ import annotations

from typing import Final

from train.simulation.room_settings import Kind

FRAMES: Final[dict[Kind, int]] = {
    "single-hand": 4785,
    "hand-hand": 3312,
    "hand-pen": 4511,
    "hand-controller": 2645,
}
"""Numbers of frames of the captures; Table 3."""

HAN: Final = "Han 2018"

TABLE5: Final[dict[str, dict[Kind, float]]] = {
    "Alexanderson 2017": {
        "single-hand": 4330 / 4785,
        "hand-hand": 981 / 3312,
        "hand-pen": 402 / 4511,
        "hand-controller": 1381 / 2645,
    },
    HAN: {
        "single-hand": 4785 / 4785,
        "hand-hand": 3101 / 3312,
        "hand-pen": 4477 / 4511,
        "hand-controller": 2599 / 2645,
    },
}
"""Share of frames with all labels right; hands are calibrated."""

TABLE7: Final[dict[str, dict[Kind, tuple[float, float]]]] = {
    "calibrated": {
        "single-hand": (1.0, 1.0),
        "hand-hand": (0.9918, 0.9440),
        "hand-pen": (0.9938, 0.9895),
        "hand-controller": (0.9917, 0.9909),
    },
    "uncalibrated": {
        "single-hand": (0.9827, 0.9562),
        "hand-hand": (0.9556, 0.8518),
        "hand-pen": (0.9929, 0.7712),
        "hand-controller": (0.9758, 0.8954),
    },
}
"""Share of frames whose poses pass the test, and share of these with all labels right."""

CAMERAS: Final = (0.9555, 0.9232)
"""The same for a single-hand capture with more than half of the 16 cameras off; section 5."""
CAMERAS_FRAMES: Final = 2875
"""Number of frames of that capture."""
