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
from gloves.takes.points import spread_out
from gloves.takes.take import Take
from handsim.hand.shape import ADULT_LENGTH, Side
from track.alternatives.placement import COMPLETE_SHARE, NUM_COMPARED, are_complete, place_markers
from track.association.initialization import label_alone
from track.calibration.hand_parameters import mirror_to_right
from track.config import HandOrigin
from track.kinematics.pose_solver import PoseSolver
from track.user import hand_like, size_words
from train.labelers.protocol import Labeler

OTHER_HANDS: Final = "other_hands"
"""Key of these alternatives in the settings of a take."""
# With the next two numbers none of 16 simulated hands in three gloves was doubted, and 14 of 16 hands of
# other people were found; those missed wore gloves of 10 and 13 markers. Twice the share also misses scales
# of 1.15.
_LEFT_OPEN: Final = 0.15  # share of people's spread that a calibration leaves open
_OTHER_PERSON_LOG_ODDS: Final = 7.0  # log-odds against hands that are another person's
_WRONG_SCALE_LOG_ODDS: Final = 4.5  # log-odds against a wrong scale: a hand is too long from 223 mm on
_REPORTED_PROBABILITY: Final = 0.5  # An alternative is reported from this probability on.


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
        parts = _uninterrupted_parts(take, side)
        if parts:
            whole = np.concatenate(parts)
            found += _other_person(take, side, whole, given.get(side))
            found += _two_people(take, side, parts)
            found += _doubled(take, side, whole, labeler)
    likely = [one._asdict() for one in found if one.probability >= _REPORTED_PROBABILITY]
    return dataclasses.replace(take, settings={**take.settings, OTHER_HANDS: likely})


def other_hands_of(take: Take) -> tuple[OtherHands, ...]:
    """Alternatives to the hands of a take, as its settings record them."""
    return tuple(OtherHands(**one) for one in take.settings.get(OTHER_HANDS, ()))


def _uninterrupted_parts(take: Take, side: Side) -> list[Int[np.ndarray, "F"]]:
    """Frames that show most markers of a hand, in parts between which the hand has no label."""
    counts = np.isfinite(take.observed(side)[..., 0]).sum(axis=1)
    good = are_complete(counts)
    runs = [first + np.flatnonzero(good[first : last + 1]) for first, last in runs_of(counts > 0)]
    return [frames for frames in runs if len(frames) >= NUM_COMPARED]


def _labeled(take: Take, side: Side, frames: Int[np.ndarray, "F"], most: int) -> Float[np.ndarray, "S M 3"]:
    """Markers of a hand, as a right one, in some of these frames [m]."""
    labels = take.hand_labels[take.hand_index(side)]
    seen = take.point_list.labeled(labels, spread_out(frames, most))
    return np.asarray(seen @ mirror_to_right(side))


def _other_person(
    take: Take, side: Side, frames: Int[np.ndarray, "F"], origin: HandOrigin | None
) -> Iterator[OtherHands]:
    """Alternatives of a hand too long for any person, and of a given hand that is another person's."""
    worn = take.hands[take.hand_index(side)].with_side("right")
    mean, spread = ADULT_LENGTH
    odds = 0.5 * max(0.0, (worn.shape.length - mean) / spread) ** 2 - _WRONG_SCALE_LOG_ODDS
    why = f"is {1e3 * worn.shape.length:.0f} mm long, longer than people's"
    remedy = "check the length of the calibration wand and the unit of the file, and scale its positions"
    yield OtherHands(side, 0, why, remedy, _probability(odds))
    if origin is None:
        return
    seen = _labeled(take, side, frames, NUM_COMPARED)
    free = place_markers(seen, hand_like(worn))
    known = place_markers(seen, worn, _LEFT_OPEN if origin == "calibrated" else 1.0)
    times = free.hand.shape.length / worn.shape.length
    why = f"fits a hand of {size_words(free.hand)} better than the given one of {size_words(worn)}"
    remedy = "give the hands of who wears the glove, calibrate them again, or leave them out"
    remedy += f"; if they are the same person's, the positions may be {times:.3g} times too large"
    yield OtherHands(side, 0, why, remedy, _probability(known.cost - free.cost - _OTHER_PERSON_LOG_ODDS))


def _two_people(take: Take, side: Side, parts: list[Int[np.ndarray, "F"]]) -> Iterator[OtherHands]:
    """Alternative of two people's hands in parts of a take, between which the hand is away."""
    if len(parts) < 2:
        return
    start = hand_like(take.hands[take.hand_index(side)])
    first, *others = sorted(parts, key=len, reverse=True)
    early = _labeled(take, side, first, NUM_COMPARED // 2)
    own = place_markers(early, start)
    solver = PoseSolver(own.hand)
    seen = [_labeled(take, side, part, NUM_COMPARED) for part in others]
    other = others[int(np.argmax([np.median(solver.solve(markers).rms) for markers in seen]))]
    late = _labeled(take, side, other, NUM_COMPARED // 2)
    apart, both = place_markers(late, start), place_markers(np.concatenate([early, late]), start)
    sizes = [size_words(one.hand) for one in (own, apart)]
    later, (before, after) = max(first[0], other[0]), sizes if first[0] < other[0] else sizes[::-1]
    why = f"is another one from {take.times[later]:.2f} s on, of {after} instead of {before}"
    remedy = "cut the capture between the two people's hands, and use each part by itself"
    odds = both.cost - own.cost - apart.cost  # Two people have two sets of places, which cost more than one.
    yield OtherHands(side, int(later), why, remedy, _probability(odds))


def _doubled(take: Take, side: Side, frames: Int[np.ndarray, "F"], labeler: Labeler) -> Iterator[OtherHands]:
    """Alternative of a second hand of the same side, to which the unlabeled points belong."""
    points, hand = take.point_list, take.hands[take.hand_index(side)]
    left = points.without(points.labels >= 0)
    some = frames[left.counts[frames] >= COMPLETE_SHARE * hand.layout.num_markers]
    if not len(some):
        return
    some = spread_out(some, NUM_COMPARED)
    clouds = [left.points[left.of(frame)] for frame in some]
    hands = [hand, hand.with_side("left" if side == "right" else "right")]
    labels, _ = label_alone(clouds, hands, labeler)
    rows = np.repeat(np.arange(len(some)), [len(cloud) for cloud in clouds])
    twice = np.unique(rows[(labels >= 0) & (labels < hand.layout.num_markers)])
    share = len(twice) / len(some)
    why = f"is there twice, from {take.times[some[0]]:.2f} s on: points without a label are a second one's"
    remedy = "capture one person at a time, or leave out the points of the other one"
    yield OtherHands(side, int(some[0]), why, remedy, share)


def _probability(log_odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-log_odds)))
