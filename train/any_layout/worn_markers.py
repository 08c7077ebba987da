"""Where a glove's markers are on many people in many poses: what a layout's distances are like."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from handsim.hand.topology import SIDES
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import sample_single_hand
from train.simulation.people import sample_hands, wear_gloves

_POSES_EACH: Final = 100  # of a person


def sample_worn_markers(
    layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "T M 3"]:
    """Markers [m] of right hands in valid poses; every hundred are another person, whose glove has slipped.

    Args:
        layout: The glove.
        num_frames: Number of poses.
        rng: Source of all randomness.

    Raises:
        LayoutError: A marker misses the skin.
    """
    config = DatasetConfig()
    slip, roll = config.slip_along, np.deg2rad(config.slip_around)
    parts = []
    for first in range(0, num_frames, _POSES_EACH):
        count = min(_POSES_EACH, num_frames - first)
        right = next(hand for hand in sample_hands(config.population, rng=rng) if hand.shape.side == SIDES[1])
        scene = sample_single_hand(right, count, config.poses, config.volume, rng=rng)
        (fit,) = wear_gloves(layout, scene.hands, along=slip, around=roll, rng=rng)
        parts.append(fit.attachment.centers(right, right.forward_kinematics(scene.qpos[0])))
    return np.concatenate(parts)
