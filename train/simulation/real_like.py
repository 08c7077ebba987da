"""Takes of two hands that are as unlike a model as real hands are: anybody's, fast, in skin that moves.

The figures are those of the published captures of Han et al. 2018 (docs/room.md): markers are 1.5 mm per axis
from any hand that moves as ours does, three tenths of that variance repeat in similar poses, and half of the
captures move about twice as far from frame to frame as simulated hands do.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.fit import GlovedHand
from gloves.layout import MarkerLayout
from handsim.hand.shape import BONES, EVERYBODY
from handsim.space.transforms import quaternion_matrix
from train.simulation.motion import SceneMotion, sample_scene_motion
from train.simulation.people import sample_hands, wear_gloves

NUM_FRAMES: Final = 3000
"""Frames of such a take when no number is given."""
NOISE: Final = 0.00125
"""Standard deviation of the markers' independent noise per axis [m]."""
FLESH: Final = 0.0008
"""RMS displacement per axis that repeats with the angles of the marker's digit [m]."""
SPEED: Final = 2
"""Times that hands move as fast as in the other takes."""
_SLIP_ALONG, _SLIP_AROUND = 0.1, np.deg2rad(10.0)  # of a glove, as in training sets


def sample_real_like_scene(layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator) -> SceneMotion:
    """Two hands of anybody, children included, that meet and part.

    Args:
        layout: The glove on both hands.
        num_frames: Frames at `train.simulation.motion.RATE`.

    Raises:
        LayoutError: The glove does not fit.
        PoseError: The person drawn cannot bring the hands together.
    """
    models = sorted(sample_hands(EVERYBODY, rng=rng), key=lambda model: model.shape.side, reverse=True)
    fits = wear_gloves(layout, models, along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)
    fast = sample_scene_motion("hand-hand", fits, SPEED * num_frames, rng=rng).faster(SPEED)
    return dataclasses.replace(fast, skin=tuple(move_skin(hand, rng=rng) for hand in fast.hands))


def move_skin(hand: GlovedHand, *, rng: np.random.Generator) -> Float[np.ndarray, "T M 3"]:
    """Displacement of a hand's markers in the world [m]: what repeats with the pose, and noise."""
    turns, layout = quaternion_matrix(hand.qpos[:, 3:7]), hand.layout
    moved = NOISE * rng.standard_normal((len(hand.qpos), layout.num_markers, 3))
    for marker, bone in enumerate(hand.fit.attachment.main_bones):
        digit = BONES[bone].digit
        angles = hand.qpos[:, 7 + 4 * digit : 11 + 4 * digit] if digit >= 0 else hand.qpos[:, 12::4]
        way = (angles - angles.mean(axis=0)) @ rng.standard_normal((4, 3))
        way *= FLESH / max(np.sqrt((way**2).mean()), 1e-9)
        moved[:, marker] += np.einsum("tij,tj->ti", turns, way)
    return moved
