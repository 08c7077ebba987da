"""Labels of frames that have nothing to do with each other.

Presence and side of a hand come from a fitted pose, the labels from the labeler.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from track.association.hand_state import HandState
from track.association.initialization import (
    FEWEST_POINTS,
    SPARE_POINTS,
    HandInitializer,
    InitializedHand,
)
from track.association.point_groups import distances_to_nearest
from train.labelers.protocol import MAX_POINTS, Labeler

_NEAR: Final = 0.06  # [m] from a hand's points, within which other points may be its markers
_USUAL: Final = 0.5  # share of a capture's frames with a hand, from which on the others hold one too


class FrameLabels(NamedTuple):
    """Labels of a frame's points."""

    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands in their order; -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Confidence in each label, 0 to 1."""


def label_alone(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    hands: Sequence[GloveFit],
    labeler: Labeler,
    told: Callable[[int], None] = lambda count: None,
) -> list[FrameLabels]:
    """Label every frame by itself.

    A hand is there where a pose fits. In a capture that shows hands in most frames, a frame with enough
    points holds one also where none fits: the labeler can be right where too many labels are wrong for a fit.
    """
    finder = HandInitializer([HandState(hand) for hand in hands], labeler, at_once=True)
    found = []
    for points in frames:
        found.append(finder.initialize(points, range(len(hands))))
        told(len(found))
    clouds = _clouds(frames, found, hands[0].layout.num_markers)
    labelings = labeler.label_frames([frames[number][cloud] for number, _, cloud in clouds])
    labels = [np.full(len(points), -1) for points in frames]
    confidence = [np.ones(len(points)) for points in frames]
    for (number, hand, cloud), one in zip(clouds, labelings, strict=True):
        labels[number][cloud] = np.where(one.labels >= 0, hand * hands[0].layout.num_markers + one.labels, -1)
        confidence[number][cloud] = one.confidence
    return [FrameLabels(*row) for row in zip(labels, confidence, strict=True)]


def _clouds(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    found: Sequence[Sequence[InitializedHand]],
    num_markers: int,
) -> list[tuple[int, int, Int[np.ndarray, "C"]]]:
    """The points that the labeler is shown as one hand: number of the frame, the hand, and which points."""
    most = num_markers + SPARE_POINTS
    full = [bool(hands) for points, hands in zip(frames, found, strict=True) if len(points) >= FEWEST_POINTS]
    sides = [hand.index for hands in found for hand in hands]
    usual = np.bincount(sides).argmax() if sides and np.mean(full) >= _USUAL else None
    clouds = []
    for number, (points, hands) in enumerate(zip(frames, found, strict=True)):
        small = FEWEST_POINTS <= len(points) <= most
        if small and len(hands) < 2 and (hands or usual is not None):
            clouds.append((number, hands[0].index if hands else int(usual), np.arange(len(points))))  # type: ignore[arg-type]
            continue
        for hand in hands:
            near = distances_to_nearest(points, points[hand.labels >= 0]) < _NEAR
            for other in hands:
                near &= (other.labels < 0) | (other is hand)
            clouds.append((number, hand.index, np.flatnonzero(near)[:MAX_POINTS]))
    return clouds
