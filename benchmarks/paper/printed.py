"""What Han et al. 2018 printed, as shares; one of its tables is set right.

Table 5 has the paper's own figures of hand-hand and hand-pen in each other's row: 4477 frames are more than
the 3312 of hand-hand, and 3101 of 3312 is the product of Table 7's two shares.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from train.simulation.scenes import Kind


class GapCounts(NamedTuple):
    """One row of Table 3."""

    frames: int
    gaps: int
    """Stretches of frames in each of which at least one marker is missing."""
    average_length: float
    """Average gap length (AGL) [frames]; NaN without gaps."""
    average_missing: float
    """Average missing markers (AMF) of the frames that miss any; NaN without gaps."""


TEST_SETS: Final = ("synthetic", "single-hand", "hand-hand", "hand-pen", "hand-controller")
"""Columns of Tables 4 and 6."""

TABLE4: Final = {
    "slot_accuracy": (0.8581, 0.9764, 0.8408, 0.7781, 0.8532),
    "occlusion_ratio": (0.1224, 0.0007, 0.0273, 0.0203, 0.0178),
    "occlusion_precision": (0.7395, 0.3891, 0.5973, 0.5265, 0.6317),
    "occlusion_recall": (0.6464, 0.3789, 0.2557, 0.1785, 0.2844),
    "ghost_ratio": (0.0527, 0.0001, 0.1063, 0.0755, 0.0450),
    "ghost_precision": (0.5621, 0.8750, 0.7946, 0.7909, 0.7089),
    "ghost_recall": (0.3977, 0.8750, 0.6155, 0.6365, 0.5278),
}
"""The dense layout of 19 markers, by test set."""

TABLE6: Final = {
    "slot_accuracy": (0.8489, 0.9690, 0.8214, 0.7245, 0.8659),
    "occlusion_ratio": (0.1096, 0.0009, 0.0167, 0.0228, 0.0183),
    "occlusion_precision": (0.6075, 0.5929, 0.7606, 0.4193, 0.8905),
    "occlusion_recall": (0.6685, 0.5929, 0.1745, 0.1082, 0.2968),
    "ghost_ratio": (0.0764, 0.0001, 0.1074, 0.1084, 0.0609),
    "ghost_precision": (0.4729, 0.8125, 0.6652, 0.6547, 0.6860),
    "ghost_recall": (0.5410, 0.8125, 0.5764, 0.5393, 0.5484),
}
"""The sparse layout of 13 markers, by test set."""

TABLE3: Final[dict[str, GapCounts]] = {
    "single-hand": GapCounts(4785, 44, 2.11, 1.35),
    "hand-hand": GapCounts(3312, 331, 4.01, 3.30),
    "hand-pen": GapCounts(4511, 481, 3.39, 2.31),
    "hand-controller": GapCounts(2645, 382, 2.65, 1.62),
}
"""The captures: frames and gaps."""

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
