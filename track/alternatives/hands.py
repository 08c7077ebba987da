"""Alternatives to the hands of a take: another person's, a wrong scale, and more than one person's hands.

The likely ones are recorded in the settings of the take, each as a sentence with its probability. Hands are
never replaced here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import runs_of
from gloves.fit import GloveFit, mean_hand
from gloves.takes.points import spread_out
from gloves.takes.take import Take
from handsim.hand.shape import ADULT_LENGTH, HandShape, Side
from handsim.space.transforms import MIRROR
from track.alternatives.placement import COMPLETE, FRAMES, are_complete, place_markers
from track.association.initialization import label_alone
from track.config import HandOrigin
from track.kinematics.pose_solver import PoseSolver
from train.labelers.protocol import Labeler

OTHER_HANDS: Final = "other_hands"
"""Key of these alternatives in the settings of a take."""
# Of 16 simulated hands in three gloves none was doubted by these two, and 14 of 16 hands of other people were
# told; those missed were in gloves of 10 and 13 markers. With twice the share scales by 1.15 are missed, too.
_LEFT_OPEN: Final = 0.15  # share of people's spread that a calibration leaves open
_OTHER_PERSON: Final = 7.0  # log-odds against hands that are another person's
_WRONG_SCALE: Final = 4.5  # log-odds against a wrong scale: a hand is too long from 223 mm on
_LIKELY: Final = 0.5  # An alternative is reported from this probability on.


class OtherHands(NamedTuple):
    """An alternative to the hands of a take."""

    side: Side
    first: int
    """The first frame that shows other hands."""
    why: str
    remedy: str
    probability: float

    def __str__(self) -> str:
        """The whole sentence."""
        return f"the {self.side} hand {self.why}; {self.remedy}"


def with_other_hands(take: Take, given: Mapping[Side, HandOrigin], labeler: Labeler) -> Take:
    """The take with likely alternatives to its hands in its settings.

    Args:
        take: A labeled or tracked take.
        given: Origin of each hand that was not measured in the take itself.
        labeler: Labeler of the glove.
    """
    found: list[OtherHands] = []
    for side in take.sides:
        parts = _parts(take, side)
        if parts:
            whole = np.concatenate(parts)
            found += _of_person(take, side, whole, given.get(side))
            found += _of_parts(take, side, parts)
            found += _at_once(take, side, whole, labeler)
    likely = [one._asdict() for one in found if one.probability >= _LIKELY]
    return dataclasses.replace(take, settings={**take.settings, OTHER_HANDS: likely})


def other_hands_of(take: Take) -> tuple[OtherHands, ...]:
    """Alternatives to the hands of a take, as its settings record them."""
    return tuple(OtherHands(**one) for one in take.settings.get(OTHER_HANDS, ()))


def _parts(take: Take, side: Side) -> list[Int[np.ndarray, "F"]]:
    """Frames that show most markers of a hand, apart wherever the hand has no label in between."""
    counts = np.isfinite(take.observed(side)[..., 0]).sum(axis=1)
    good = are_complete(counts)
    runs = [first + np.flatnonzero(good[first : last + 1]) for first, last in runs_of(counts > 0)]
    return [frames for frames in runs if len(frames) >= FRAMES]


def _seen(take: Take, side: Side, frames: Int[np.ndarray, "F"], most: int) -> Float[np.ndarray, "S M 3"]:
    """Markers of a hand, as a right one, in some of these frames [m]."""
    labels = take.hand_labels[take.hand_index(side)]
    seen = take.point_list.labeled(labels, spread_out(frames, most))
    return np.asarray(seen @ (MIRROR if side == "left" else np.eye(3)))


def _of_person(
    take: Take, side: Side, frames: Int[np.ndarray, "F"], origin: HandOrigin | None
) -> Iterator[OtherHands]:
    """A hand may be too long for any person's, and a given one another person's."""
    worn = take.hands[take.hand_index(side)].with_side("right")
    mean, spread = ADULT_LENGTH
    odds = 0.5 * max(0.0, (worn.shape.length - mean) / spread) ** 2 - _WRONG_SCALE
    why = f"is {1e3 * worn.shape.length:.0f} mm long, longer than people's"
    remedy = "check the length of the calibration wand and the unit of the file, and scale its positions"
    yield OtherHands(side, 0, why, remedy, _probability(odds))
    if origin is None:
        return
    seen = _seen(take, side, frames, FRAMES)
    free = place_markers(seen, _mean(worn))
    known = place_markers(seen, worn, _LEFT_OPEN if origin == "calibrated" else 1.0)
    fitted = free.hand.shape
    times = fitted.length / worn.shape.length
    why = f"fits a hand of {_size(fitted)} better than the given one of {_size(worn.shape)}"
    remedy = "give the hands of who wears the glove, calibrate them again, or leave them out"
    remedy += f"; if they are the same person's, the positions may be {times:.3g} times too large"
    yield OtherHands(side, 0, why, remedy, _probability(known.cost - free.cost - _OTHER_PERSON))


def _of_parts(take: Take, side: Side, parts: list[Int[np.ndarray, "F"]]) -> Iterator[OtherHands]:
    """Parts of a take, between which the hand is away, may show two people's hands."""
    if len(parts) < 2:
        return
    start = _mean(take.hands[take.hand_index(side)].with_side("right"))
    first, *others = sorted(parts, key=len, reverse=True)
    early = _seen(take, side, first, FRAMES // 2)
    own = place_markers(early, start)
    solver = PoseSolver(own.hand)
    other = max(others, key=lambda part: float(np.median(solver.solve(_seen(take, side, part, FRAMES)).rms)))
    late = _seen(take, side, other, FRAMES // 2)
    apart, both = place_markers(late, start), place_markers(np.concatenate([early, late]), start)
    sizes = [_size(one.hand.shape) for one in (own, apart)]
    later, (before, after) = max(first[0], other[0]), sizes if first[0] < other[0] else sizes[::-1]
    why = f"is another one from {take.times[later]:.2f} s on, of {after} instead of {before}"
    remedy = "cut the capture between the two people's hands, and use each part by itself"
    odds = both.cost - own.cost - apart.cost  # Two people have two sets of places, which cost more than one.
    yield OtherHands(side, int(later), why, remedy, _probability(odds))


def _at_once(take: Take, side: Side, frames: Int[np.ndarray, "F"], labeler: Labeler) -> Iterator[OtherHands]:
    """Points without a label may be those of a second hand of the same side."""
    points, hand = take.point_list, take.hands[take.hand_index(side)]
    left = points.without(points.labels >= 0)
    some = frames[left.counts[frames] >= COMPLETE * hand.layout.num_markers]
    if not len(some):
        return
    some = spread_out(some, FRAMES)
    clouds = [left.points[left.of(frame)] for frame in some]
    hands = [hand, hand.with_side("left" if side == "right" else "right")]
    labels, _ = label_alone(clouds, hands, labeler)
    rows = np.repeat(np.arange(len(some)), [len(cloud) for cloud in clouds])
    twice = np.unique(rows[(labels >= 0) & (labels < hand.layout.num_markers)])
    share = len(twice) / len(some)
    why = f"is there twice, from {take.times[some[0]]:.2f} s on: points without a label are a second one's"
    remedy = "capture one person at a time, or leave out the points of the other one"
    yield OtherHands(side, int(some[0]), why, remedy, share)


def _mean(hand: GloveFit) -> GloveFit:
    """A right hand of the same size, of mean proportions in the glove as designed."""
    return mean_hand(hand.shape.length, hand.shape.breadth, hand.layout)


def _size(shape: HandShape) -> str:
    return f"{1e3 * shape.length:.0f} x {1e3 * shape.breadth:.0f} mm"


def _probability(log_odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-log_odds)))
