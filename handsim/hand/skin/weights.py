"""Skinning weights: shares of the bones given on the cage, spread by the same subdivision."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from handsim.hand.skin.cage_topology import (
    CARPUS,
    KNUCKLES,
    METACARPUS,
    PAST_KNUCKLES,
    THENAR,
    WEB,
    CageTopology,
    dorsal,
    palmar,
)
from handsim.hand.topology import NUM_BONES, PALM

# Bone of the digit and its share on each ring past the web; the rest goes to the bone before it.
_FINGER_RINGS: Final = ((1, 0.0), (1, 0.5), (1, 1.0), (2, 0.0), (2, 1.0), (2, 1.0), (2, 1.0))
# Share of the thumb's metacarpal on the palm's rows around it: (row, index, share).
_THENAR: Final = (
    (CARPUS, dorsal(0), 0.25),
    (CARPUS, palmar(0), 0.35),
    (CARPUS, palmar(1), 0.15),
    (THENAR, dorsal(0), 0.5),
    (THENAR, dorsal(1), 0.05),
    (THENAR, palmar(0), 0.8),
    (THENAR, palmar(1), 0.6),
    (THENAR, palmar(2), 0.3),
    (THENAR, palmar(3), 0.05),
    (METACARPUS, dorsal(0), 0.15),
    (METACARPUS, palmar(0), 0.4),
    (METACARPUS, palmar(1), 0.25),
)
_KNUCKLE_SHARES: Final = {KNUCKLES: (0.35, 0.25), PAST_KNUCKLES: (0.9, 0.7), WEB: (1.0, 0.9)}  # finger, web


def cage_weights(topology: CageTopology) -> Float[np.ndarray, "K 16"]:
    """Share of every bone in every cage vertex; rows sum to one."""
    weights = np.zeros((topology.num_vertices, NUM_BONES))
    for row, (on_finger, on_web) in _KNUCKLE_SHARES.items():
        for column in range(9):
            fingers = (
                [column // 2] if column % 2 else [f for f in (column // 2 - 1, column // 2) if 0 <= f < 4]
            )
            share = on_finger if column % 2 or len(fingers) == 1 else on_web
            for index in (dorsal(column), palmar(column)):
                weights[topology.palm[row, index], [4 + 3 * f for f in fingers]] = share / len(fingers)
    for row, index, share in _THENAR:
        weights[topology.palm[row, index], 1] = share
    for digit, rings in enumerate(topology.rings):
        first = 1 + 3 * digit
        if digit == 0:
            weights[rings[0], first] = 0.95
        for ring, (bone, share) in zip(rings[-len(_FINGER_RINGS) :], _FINGER_RINGS, strict=True):
            weights[ring, first + bone - 1] = 1.0 - share
            weights[ring, first + bone] = share
    weights[:, PALM] = 1.0 - weights[:, PALM + 1 :].sum(axis=1)
    return weights


def strongest_weights(
    weights: Float[np.ndarray, "V 16"],
) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"]]:
    """The four largest shares of each vertex in descending order, scaled to sum to one, and their bones."""
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    shares = np.take_along_axis(weights, indices, axis=1)
    return indices, shares / shares.sum(axis=1, keepdims=True)
