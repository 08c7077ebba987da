"""The hands of a capture with their labels: how many each frame holds, and which is left and right.

Frames in which the hands stand apart are decided on their own. In the others, a point belongs to the hand that
it belonged to a moment before or after. Where that is unknown, because the hands touch all the time, some
frames are cut (`train.hands.frame_hands`), and the others follow from these.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from train.hands.frame_hands import Criteria, FoundHand, HandFinder
from train.hands.links import carried, previous_points
from train.hands.sides import sides_of
from train.labelers.protocol import check_clouds

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

    Frames = Sequence[NDArray[np.float64]]
    Hands = list[list[FoundHand]]

_CHUNK: Final = 512
_SPEED, _ACCELERATION = 2.0, 80.0  # of a marker [m/s], [m/s^2]
_NOISE, _FARTHEST = 0.004, 0.03  # of a step from frame to frame [m]
_MEMORY: Final = 0.3  # for which it counts whose a point was [s]
_KNOWN: Final = 0.02  # what is left of a certain vote, at least, where it counts
_CUT_EVERY: Final = 0.1  # between frames that are cut [s]
_FOLLOWED_FEWEST: Final = 4
_BETTER: Final = 3.0  # by which a cut frame must explain more points
_GAIN: Final = 0.5  # by which a hand labeled again must explain more points
_FOLLOWED_HAND: Final = Criteria(
    fewest=_FOLLOWED_FEWEST, confidence=0.7, fitting_share=0.8, misfit=0.010, clearness=0.0
)
_HIDDEN_HAND: Final = Criteria(
    fewest=_FOLLOWED_FEWEST, confidence=0.4, fitting_share=0.6, misfit=0.012, clearness=0.0
)
_GUESSED: Final = 0.2  # vote of a point of which nothing was known, where a known one has 1
_ROUNDS: Final = 4
SIDES: Final = (1, -1)
"""Right, left."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameLabels:
    """The labels of one frame with any number of hands up to two."""

    sides: Int[np.ndarray, "N"]
    """1 for a point of a right hand, -1 for one of a left hand, 0 for one of no hand."""
    labels: Int[np.ndarray, "N"]
    """Marker of each point, -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Of each label, 0 to 1; 0 for a point without one."""

    @property
    def hands(self) -> tuple[bool, bool]:
        """Whether there is a right hand, and a left one."""
        return bool((self.sides > 0).any()), bool((self.sides < 0).any())


def label_hands(
    frames: Frames, finder: HandFinder, rate: float, *, progress: Callable[[int], None] | None = None
) -> list[FrameLabels]:
    """Label the hands of every frame.

    Args:
        frames: Points of each frame [m].
        finder: Finds the hands of single frames.
        rate: Frames per second [Hz].
        progress: Called with the number of frames that are done.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
    """
    check_clouds(frames)
    found: Hands = []
    for first in range(0, len(frames), _CHUNK):
        found += [_two_best(hands) for hands in finder.find(frames[first : first + _CHUNK])]
        if progress is not None:
            progress(len(found))
    followed = _Followed(frames, rate)
    by_side = followed.by_side(found)
    _follow(frames, by_side, finder, followed)
    if _cut_some(frames, by_side, finder, followed, rate):
        _follow(frames, by_side, finder, followed)
    _follow(frames, by_side, finder, followed, _HIDDEN_HAND)
    return [_frame_labels(len(points), hands) for points, hands in zip(frames, by_side, strict=True)]


class _Followed:
    """All points of a capture, each linked to what it was in the frame before."""

    def __init__(self, frames: Frames, rate: float) -> None:
        self.starts = np.concatenate([[0], np.cumsum([len(points) for points in frames])]).astype(np.int64)
        points = np.concatenate([np.zeros((0, 3)), *frames])
        reach = min(_FARTHEST, _SPEED / rate + _NOISE)
        expected_reach = min(_FARTHEST, 0.5 * _ACCELERATION / rate**2 + _NOISE)
        self.previous = previous_points(points, self.starts, reach, expected_reach)
        self._keep = float(np.exp(-1.0 / (_MEMORY * rate)))

    def by_side(self, found: Hands) -> list[dict[int, FoundHand]]:
        """The hands of every frame by their sides."""
        sides = sides_of(found, self.starts, self.previous)
        return [dict(zip(side, hands, strict=True)) for side, hands in zip(sides, found, strict=True)]

    def votes(self, by_side: Sequence[dict[int, FoundHand]]) -> NDArray[np.float64]:
        """On which side each point is by the frames before and after, where that is known: 1 or -1, else 0."""
        own = np.zeros(len(self.previous))
        for start, hands in zip(self.starts, by_side, strict=False):
            for side, hand in hands.items():
                vote = hand.support * hand.confidence
                here = start + hand.points
                own[here] = np.where(vote > np.abs(own[here]), side * vote, own[here])
        before, after = carried(own, self.previous, self._keep)
        total = before + after
        votes: NDArray[np.float64] = np.where(np.abs(total) > _KNOWN, np.sign(total), 0.0)
        return votes


def _two_best(hands: list[FoundHand]) -> list[FoundHand]:
    return sorted(hands, key=lambda hand: hand.weight, reverse=True)[:2]


def _cut_some(
    frames: Frames, by_side: list[dict[int, FoundHand]], finder: HandFinder, followed: _Followed, rate: float
) -> bool:
    """Cut merged hands in some of the frames in which many points have no label; whether that found any.

    A hand is on the side on which most of its points were; where that is unknown, all such hands vote.
    """
    step, last = max(1, round(_CUT_EVERY * rate)), -np.inf
    cuts: Hands = [[] for _ in frames]
    for number, points in enumerate(frames):
        labeled = sum(len(hand.points) for hand in by_side[number].values())
        if number < last + step or len(points) - labeled < finder.fewest or not finder.is_merged(points):
            continue
        last = number
        cut = _two_best(finder.find_merged(points))
        if sum(hand.weight for hand in cut) > _BETTER + sum(hand.weight for hand in by_side[number].values()):
            cuts[number] = cut
    votes, voted = followed.votes(by_side), followed.by_side(cuts)
    for number, cut in enumerate(cuts):
        if cut:
            known = votes[followed.starts[number] : followed.starts[number + 1]]
            balance = [float(known[hand.points].sum()) for hand in cut]
            difference = balance[0] - (balance[1] if len(cut) == 2 else 0.0)
            side = 1 if difference > 0.0 else -1
            clear = abs(difference) >= _FOLLOWED_FEWEST
            by_side[number] = dict(zip((side, -side), cut, strict=False)) if clear else voted[number]
    return any(cuts)


def _follow(
    frames: Frames,
    by_side: list[dict[int, FoundHand]],
    finder: HandFinder,
    followed: _Followed,
    criteria: Criteria = _FOLLOWED_HAND,
) -> None:
    """Label hands again where points without a label were a hand's, or are beside one."""
    for _ in range(_ROUNDS):
        votes = followed.votes(by_side)
        better = False
        for clouds_of in (_voted_clouds, _remaining_clouds):
            clouds: list[_Cloud] = []
            for number, hands in enumerate(by_side):
                known = votes[followed.starts[number] : followed.starts[number + 1]].copy()
                clouds += clouds_of(number, frames[number], hands, known, finder.measures.link_distance)
            better |= _improve(frames, by_side, finder, clouds, criteria)
        if not better:
            break


class _Cloud(NamedTuple):
    """Points of a frame among which a hand is looked for."""

    frame: int
    side: int
    points: NDArray[np.int64]
    voted: NDArray[np.bool_]
    """Which points of the frame are known to be on that side."""


def _voted_clouds(
    number: int,
    points: NDArray[np.float64],
    hands: dict[int, FoundHand],
    known: NDArray[np.float64],
    reach: float,
) -> list[_Cloud]:
    """Clouds with points that have no label and were on their side."""
    taken = np.zeros(len(points), dtype=bool)
    for side, hand in hands.items():
        known[hand.points], taken[hand.points] = side, True
    clouds = []
    for side in SIDES:
        voted = known == side
        if voted.sum() >= _FOLLOWED_FEWEST and (voted & ~taken).any():
            clouds.append(_Cloud(number, side, _near(points, voted, known == 0.0, reach), voted))
    return clouds


def _remaining_clouds(
    number: int,
    points: NDArray[np.float64],
    hands: dict[int, FoundHand],
    known: NDArray[np.float64],
    reach: float,
) -> list[_Cloud]:
    """Clouds that are what one hand leaves of the points of which no more is known."""
    clouds = []
    for side, hand in hands.items():
        other = hands.get(-side)
        mine = known == -side
        if other is not None:
            mine[other.points] = True
        mine[hand.points] = False
        free = (known == 0.0) & ~mine
        free[hand.points] = False
        if other is None:
            cloud = np.flatnonzero(mine | free)
        else:
            cloud = _near(points, mine, free, reach)
        if len(cloud) >= _FOLLOWED_FEWEST and (other is None or len(cloud) > len(other.points)):
            clouds.append(_Cloud(number, -side, cloud, mine))
    return clouds


def _improve(
    frames: Frames,
    by_side: list[dict[int, FoundHand]],
    finder: HandFinder,
    clouds: list[_Cloud],
    criteria: Criteria,
) -> bool:
    """Label clouds, and take each hand that is better than what there is; whether any was."""
    better = False
    labeled = finder.label([(frames[cloud.frame], cloud.points) for cloud in clouds], criteria)
    for cloud, hand in zip(clouds, labeled, strict=True):
        there = by_side[cloud.frame].get(cloud.side)
        if hand is not None and (there is None or hand.weight > there.weight + _GAIN):
            support = np.where(cloud.voted[hand.points], hand.support[0], _GUESSED)
            by_side[cloud.frame][cloud.side] = dataclasses.replace(hand, support=support)
            better = True
    return better


def _near(
    points: NDArray[np.float64], mine: NDArray[np.bool_], free: NDArray[np.bool_], reach: float
) -> NDArray[np.int64]:
    """Some points and the free ones within reach of them [m]."""
    if not mine.any() or not free.any():
        return np.flatnonzero(mine)
    near = np.linalg.norm(points[free, None] - points[mine], axis=-1).min(axis=1) <= reach
    return np.sort(np.concatenate([np.flatnonzero(mine), np.flatnonzero(free)[near]]))


def _frame_labels(count: int, hands: dict[int, FoundHand]) -> FrameLabels:
    """Labels of a frame with `count` points; of two hands with a point the more confident one has it."""
    sides, labels, confidence = np.zeros(count, dtype=np.int64), np.full(count, -1), np.zeros(count)
    for side, hand in hands.items():
        mine = hand.confidence > confidence[hand.points]
        here = hand.points[mine]
        sides[here], labels[here], confidence[here] = side, hand.labels[mine], hand.confidence[mine]
    return FrameLabels(sides, labels, confidence)
