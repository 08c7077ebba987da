"""The online tracker: points of a frame in, hands in motion out.

Section 4 of Han et al. 2018, with more memory: names go along with IDs while they fit, new points are named
by what the hand that is coming explains (`track.association.label_consistency`), and a hand of which nothing
is known is looked for
with the labeler (`track.association.initialization`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.fit import GloveFit
from handsim.hand.topology import NUM_QPOS
from handsim.space.transforms import rotation_quaternions
from track.association.candidates import YOUNG
from track.association.hand_state import Estimate, HandMemory
from track.association.initialization import MOST_RMS, Found, HandFinder, score_of
from track.association.label_consistency import fit_names, forget_surprises, targets_of
from track.association.label_new_points import Following, name_new
from track.association.labeler_queries import Adviser
from track.bodies.rigid_body import BodyTracker, RigidTemplate
from track.intake import Incoming, Intake
from track.tracked_frame import Status, TrackedBody, TrackedFrame, TrackedHand
from train.labelers.protocol import Labeler

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

_FEWEST: Final = 5  # named points that a pose can be relied on for
_LONGEST_COAST: Final = 0.1  # [s] that a pose is carried on without them
_SHARE: Final = 0.6  # of a hand's markers; with fewer named it is doubted
_AROUND, _PATIENCE = 0.2, 0.15  # [m] where its points must be, [s] for which that must last
_ROUGH: Final = 0.003  # [m] RMS of a hand, its habits known, that is doubted
_BETTER: Final = 20.0  # log odds by which a hand must be more, to be taken anew
_MOST_CREDIT: Final = 12.0
_INCOME: Final = 2.0  # credit of a name in each frame, less half the squared deviations it is off


class Tracker:
    """Follows the user's hands, and things with markers of their own, from frame to frame.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Knows the markers of the hands' glove.
        bodies: Rigid bodies that are there beside the hands.
    """

    def __init__(
        self, hands: Sequence[GloveFit], labeler: Labeler, bodies: Sequence[RigidTemplate] = ()
    ) -> None:
        self.hands = tuple(hands)
        self.bodies = tuple(bodies)
        self._intake = Intake()
        self._bodies = [BodyTracker(body) for body in bodies]
        self._memories = [HandMemory(hand) for hand in hands]
        self._finder = HandFinder(self._memories, labeler)
        sizes = [memory.num_markers for memory in self._memories]
        self._first = np.cumsum([0, *sizes, *(len(body.marker_names) for body in bodies)])
        self._adviser = Adviser(labeler)
        self._labels: dict[int, tuple[int, float]] = {}
        self._born: dict[int, float] = {}
        self._trusted = np.zeros(len(hands))

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Take in the next frame; whatever a stream may bring ends in a status or a note.

        Args:
            points: Points [m]; those that are no finite places are left alone.
            ids: The system's IDs: a point keeps its own for as long as it is seen; -1 where there is none.
            time: Time of the frame [s].

        Raises:
            ArgumentError: `points` and `ids` do not fit together.
        """
        frame = self._intake.take(points, ids, time)
        bodies, labels = self._track_bodies(frame)
        sure, free = np.ones(len(labels)), labels < 0
        hands, labels[free], sure[free] = self._track_hands(frame.points[free], frame.ids[free], frame.time)
        all_labels, all_sure = np.full(len(points), -1), np.ones(len(points))
        all_labels[frame.kept], all_sure[frame.kept] = labels, sure
        return TrackedFrame(time, hands, all_labels, all_sure, bodies, frame.notes)

    def _track_bodies(self, frame: Incoming) -> tuple[tuple[TrackedBody, ...], NDArray[np.int64]]:
        """Every body, and the labels (P,) of their points."""
        labels, bodies = np.full(len(frame.points), -1), []
        for number, tracker in enumerate(self._bodies, start=len(self._memories)):
            found = tracker.step(frame.points, frame.ids, frame.time)
            labels[found.labels >= 0] = self._first[number] + found.labels[found.labels >= 0]
            place, turn = np.full(3, np.nan), np.full(4, np.nan)
            if found.T_world_body is not None:
                place, turn = (
                    found.T_world_body[:3, 3],
                    rotation_quaternions(found.T_world_body[None, :3, :3])[0],
                )
            bodies.append(TrackedBody(tracker.template.name, found.status, place, turn, found.rms))
        return tuple(bodies), labels

    def _track_hands(
        self, points: NDArray[np.float64], ids: NDArray[np.int64], time: float
    ) -> tuple[tuple[TrackedHand, ...], NDArray[np.int64], NDArray[np.float64]]:
        """Every hand, and the labels (P,) of points and how sure they are."""
        names, credit = self._carry_over(ids)
        born = self._births(ids, time)
        sure = 1.0 / (1.0 + np.exp(-credit - 1.0))
        following = self._follow(points, ids, names, credit, sure, born, time)
        hands = [
            self._judge(memory, points, names[number], credit, following.get(number), time)
            for number, memory in enumerate(self._memories)
        ]
        self._find_lost(points, names, hands, time)
        self._doubt(points, names, hands, time)
        first = self._first[: len(hands), None]
        labels = np.where(names >= 0, names + first, -1).max(axis=0, initial=-1)
        self._labels = {
            point: (label, worth)
            for point, label, worth in zip(ids.tolist(), labels.tolist(), credit.tolist(), strict=True)
            if label >= 0 and point >= 0
        }
        return tuple(hands), labels, sure

    def _carry_over(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Names (H, N) that the IDs carry, and what they are worth (N,)."""
        known = [self._labels.get(point, (-1, 0.0)) for point in ids.tolist()]
        labels = np.array([label for label, _ in known], dtype=np.int64)
        first = self._first[: len(self._memories) + 1, None]
        names = labels - first[:-1]
        names[(names < 0) | (labels >= first[1:])] = -1
        return names, np.array([worth for _, worth in known])

    def _births(self, ids: NDArray[np.int64], time: float) -> NDArray[np.float64]:
        """Since when each point has been there."""
        self._born = {point: self._born.get(point, time) for point in ids.tolist() if point >= 0}
        return np.array([self._born.get(point, time) for point in ids.tolist()])

    def _follow(
        self,
        points: NDArray[np.float64],
        ids: NDArray[np.int64],
        names: NDArray[np.int64],
        credit: NDArray[np.float64],
        sure: NDArray[np.float64],
        born: NDArray[np.float64],
        time: float,
    ) -> dict[int, Estimate]:
        """Poses of the hands that were there before; names (H, N) and credits are overwritten."""
        hands = []
        for number, memory in enumerate(self._memories):
            if (names[number] >= 0).sum() < _FEWEST and time - memory.time > _LONGEST_COAST:
                memory.qpos = None
            if memory.qpos is None:
                names[number] = -1
                continue
            coming = memory.predict(time)
            forget_surprises(memory, points, names[number], coming)
            estimate = fit_names(memory, points, names[number], coming)
            hands.append(Following(number, memory, coming, estimate))
        before = names.copy()
        advice = self._adviser.odds(hands, points, ids, names, born, time)
        how_sure = name_new(hands, points, names, credit, born, advice)
        changed = np.isfinite(how_sure)
        credit[changed], sure[changed] = 0.0, how_sure[changed]
        fitted = {}
        for hand in hands:
            mine, estimate = names[hand.number], hand.estimate
            if (mine != before[hand.number]).any():
                estimate = fit_names(hand.memory, points, mine, hand.coming)
            fitted[hand.number] = estimate
        return fitted

    def _judge(
        self,
        memory: HandMemory,
        points: NDArray[np.float64],
        names: NDArray[np.int64],
        credit: NDArray[np.float64],
        fit: Estimate | None,
        time: float,
    ) -> TrackedHand:
        """Take a pose over or throw it away."""
        mine = np.flatnonzero(names >= 0)
        if fit is not None and len(mine) >= _FEWEST and fit.rms <= MOST_RMS:
            firm = np.zeros(memory.num_markers, dtype=bool)
            firm[names[mine]] = credit[mine] >= YOUNG
            memory.carry_on(fit, firm, time)
            off = ((points[mine] - memory.places[names[mine]]) ** 2).sum(axis=1)
            income = _INCOME - 0.5 * off / memory.variance[names[mine]]
            credit[mine] = np.clip(credit[mine] + income, 0.0, _MOST_CREDIT)
            return _tracked(memory, Status.TRACKED, points, names, fit)
        if memory.qpos is not None and time - memory.time > _LONGEST_COAST:
            memory.qpos = None
        if memory.qpos is None:
            names[:] = -1
            return _tracked(memory, Status.LOST, points, names, None)
        return _tracked(memory, Status.COASTING, points, names, None)

    def _find_lost(
        self,
        points: NDArray[np.float64],
        names: NDArray[np.int64],
        hands: list[TrackedHand],
        time: float,
    ) -> None:
        """Look for the hands that have no pose among the points without a name."""
        lost = [n for n, hand in enumerate(hands) if hand.status in (Status.LOST, Status.COASTING)]
        if not lost:
            return
        others = np.delete(names, lost, axis=0)
        free = np.flatnonzero((others < 0).all(axis=0))
        for found in self._finder.find(points[free], tuple(lost)):
            hands[found.number] = self._take_up(found, free, points, names, time)
            lost.remove(found.number)
            for other in lost:  # it may have held on to some of these points
                names[other, names[found.number] >= 0] = -1
                memory = self._memories[other]
                hands[other] = _tracked(memory, hands[other].status, points, names[other], None)

    def _doubt(
        self,
        points: NDArray[np.float64],
        names: NDArray[np.int64],
        hands: list[TrackedHand],
        time: float,
    ) -> None:
        """Look again for a hand that leaves most of its markers open, or fits badly, with points around it.

        A hand can be followed in the wrong place on a few points; it must not stay there.
        """
        for number, (hand, memory) in enumerate(zip(hands, self._memories, strict=True)):
            named = int((names[number] >= 0).sum())
            fewest = _SHARE * memory.num_markers
            well = named >= fewest and memory.rms < _ROUGH
            if hand.status is not Status.TRACKED or well:
                self._trusted[number] = time
                continue
            open_points = np.flatnonzero((np.delete(names, number, axis=0) < 0).all(axis=0))
            around = np.linalg.norm(points[open_points] - hand.qpos[:3], axis=1) < _AROUND
            if around.sum() < fewest:
                self._trusted[number] = time
            if time - self._trusted[number] < _PATIENCE:
                continue
            self._trusted[number] = time
            for found in self._finder.find(points[open_points], [number]):
                if found.score > score_of(named, memory.rms) + _BETTER:
                    hands[number] = self._take_up(found, open_points, points, names, time)

    def _take_up(
        self,
        found: Found,
        among: NDArray[np.int64],
        points: NDArray[np.float64],
        names: NDArray[np.int64],
        time: float,
    ) -> TrackedHand:
        """Go on with a hand as it was found among some of the points; its names (H, N) are overwritten."""
        memory, mine = self._memories[found.number], names[found.number]
        mine[:] = -1
        mine[among] = found.names
        estimate = memory.begin(found.fit.qpos[0], targets_of(points, mine, memory.num_markers), time)
        return _tracked(memory, Status.FOUND, points, mine, estimate)


def _tracked(
    memory: HandMemory,
    status: Status,
    points: NDArray[np.float64],
    names: NDArray[np.int64],
    fit: Estimate | None,
) -> TrackedHand:
    count = memory.num_markers
    if memory.qpos is None:
        nothing = np.full((count, 3), np.nan)
        return TrackedHand(memory.hand.side, status, np.full(NUM_QPOS, np.nan), np.nan, nothing, np.arange(0))
    markers, mine = memory.places.copy(), names >= 0
    markers[names[mine]] = points[mine]
    there = np.zeros(count, dtype=bool)
    there[names[mine]] = True
    filled = np.flatnonzero(~there)
    rms = np.nan if fit is None else memory.rms_as_designed(fit)
    return TrackedHand(memory.hand.side, status, memory.qpos.copy(), rms, markers, filled)
