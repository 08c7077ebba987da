"""Initialization of tracks: points without history are labeled, fitted and verified as hands.

The labeler expects one hand in a cloud. Hands that touch form one cloud, which is cut in halves along several
directions; some halves contain most of one hand, and the score of the fitted hands shows which. The side of a
hand follows from the fit: its mirror image fits worse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GloveFit
from handsim.arrays import Doubles, Integers
from handsim.hand.model import join_qpos
from handsim.hand.shape import DIGITS, NUM_JOINTS
from handsim.space.transforms import rigid_fit
from poses.shapes import LIBRARIES, gestures_of
from track.association.frame_state import match_log_odds, match_points, peak_log_odds, targets_of
from track.association.hand_state import HandState
from track.config import TrackerConfig
from track.kinematics.pose_solver import FEWEST_MARKERS, OUTLIER_DISTANCE, PoseFit, PoseSolver
from track.kinematics.pose_spread import resting_prior
from train.labelers.protocol import MAX_POINTS, Labeler

MOST_POINTS: Final = 100  # A larger group of points is no hand.
_LINK_DISTANCE: Final = 0.085  # [m] least linking distance between neighboring markers of a hand
_LINKED_SHARE: Final = 0.99  # All markers of a hand are linked in this share of the gestures.
_LEAST_LABELED_SHARE: Final = 0.45  # least share of a hand's markers with a label
SPARE_POINTS: Final = 6
"""A group of points may be two touching hands, and is cut, if it has this many points more than a hand has
markers. `_SPARE_SHARE` of the markers counts instead if that is less."""
_SPARE_SHARE: Final = 0.3  # of a hand's markers, because ghosts resemble few markers
_NUM_CUTS: Final = 12  # number of directions of cuts, even over half a sphere
# number of directions per search in continuous frames; the next search tries the others
_CUTS_OF_SEARCH: Final = 6
_CUT_STRIDE: Final = 5  # step between successive directions, so that any few are spread evenly
_CUTS_AT_FIRST: Final = 3  # number of directions in the first call; mostly one of them suffices
_LAST_CALL: Final = _CUTS_OF_SEARCH - _CUTS_AT_FIRST  # turn in which a search ends
_DIGIT_EXCHANGE_DISTANCE: Final = 0.06  # [m] Digits of two hands closer than this may be exchanged.
_FITS_AT_A_TIME: Final = 3  # number of labeled clouds fitted at once, the most confident first
_FIRST_FIT_STEPS: Final = 6  # steps from each starting pose; they distinguish a hand from its mirror image
_REFIT_STEPS: Final = 8  # from a close pose; the final fit is solved again
# A robust fit must keep this share of the labels; a mirrored hand's does not.
_LEAST_KEPT_LABELS: Final = 0.75
_POSE_WEIGHT: Final = 0.25  # log-odds lost per squared standard deviation beyond the expected sum
_MOST_POSE_PENALTY: Final = 20.0  # bound of that loss, because people make unusual poses
_REFINEMENT_ROUNDS: Final = 2  # rounds of matching points with the fitted hand's markers
_SEARCH_FACTOR: Final = 4.0  # standard deviation of markers in these rounds over that of the fit
_SEARCH_LEAST, _SEARCH_MOST = 0.003, 0.012  # [m] bounds of it
_FREE_COORDINATES: Final = 20.0  # effective degrees of freedom of a pose
_SPREAD_BEFORE: Final = 0.002  # [m] prior standard deviation of markers around a fitted pose
_SPREAD_BEFORE_COORDINATES: Final = 6.0  # number of coordinates that this prior counts for
_MARKERS_OF_EVIDENCE: Final = 10  # Evidence is required for at most this many markers.
# Share of the required evidence from which a hand is remembered; it is initialized once enough later calls
# find it again.
_LEAST_REPEATED: Final = 0.5
_REPETITION: Final = 5.0  # log-odds that each earlier call with the same hand adds
_SAME_HAND_RMS: Final = 0.008  # [m] Markers of one hand in two calls differ by less, up to a rigid motion.
_CERTAIN_SCORE: Final = 5.5  # log-odds per marker from which no further cloud is tried
_HOPELESS_FACTOR: Final = 2.5  # A mirrored hand has an RMS distance this many times the best one's.
_GOOD_RMS: Final = 0.003  # [m] The best hand must fit this well to reject its mirror image.
_HOPELESS_SHARE: Final = 0.8  # The best hand must keep this share of the mirrored hand's labels.
_KNOWN_SPREAD_ATTEMPTS: Final = 60  # attempts in which a known hand must fit as before; 0.5 s at 120 Hz
CLOUD_RADIUS: Final = 0.06  # [m] distance from a hand's points within which others may be its markers
_USUAL_HAND_SHARE: Final = 0.5  # If this share of the frames shows a hand, all are assumed to show one.


@dataclass(frozen=True, slots=True, eq=False)
class InitializedHand:
    """Result of an initialization."""

    index: int  # index of the hand
    fit: PoseFit  # its pose, one frame
    labels: Int[np.ndarray, "N"]  # marker of each point, -1 for points of no marker of this hand
    score: float  # see `HandInitializer.score`


@dataclass(slots=True)
class _Search:
    """State of a search for some hands that takes several frames."""

    turn: int = 0  # number of earlier calls
    best_turn: int = 0  # call with the best hand so far
    score: float = -np.inf  # score of that hand


class _Repeated(NamedTuple):
    """A hand that had too little evidence by itself."""

    markers: Float[np.ndarray, "M 3"]  # its labeled points [m], NaN for markers without a point
    evidence: float = 0.0  # log-odds that earlier calls with the same hand add


class HandInitializer:
    """Initializes hands without history, by a labeler that does not distinguish left from right."""

    # With `at_once` a call tries all directions of cuts. Otherwise it tries three, and the calls of the next
    # frames try one more each, until a hand is certain or all directions were tried: no frame waits for a
    # long search. A hand that shows few markers is initialized once several calls agree on it.

    def __init__(
        self,
        states: Sequence[HandState],
        labeler: Labeler,
        config: TrackerConfig = TrackerConfig(),  # noqa: B008
        *,
        at_once: bool = False,
    ) -> None:
        self._at_once, self._first_cut = at_once, 0
        self._searches: dict[tuple[int, ...], _Search] = {}
        self._repeated: dict[int, _Repeated] = {}
        self._states = states
        self._labeler = labeler
        self._config = config
        self._least_shares = [1.0 if at_once else self._least_share(index) for index in range(len(states))]
        links = [_link_distance(one.hand) for one in states[:1]]  # The other hand is its mirror image.
        self._link_distance = max([_LINK_DISTANCE, *links])
        self._prior = resting_prior()
        self._robust = [PoseSolver(one.hand, outlier_distance=OUTLIER_DISTANCE) for one in states]
        self._attempts = np.zeros(len(states), dtype=np.int64)
        self._spreads: list[float | None] = [None] * len(states)
        self._points: Doubles = np.empty((0, 3))  # of the current frame
        spread = np.arange(_NUM_CUTS) + 0.5
        height, azimuth = 1.0 - spread / _NUM_CUTS, np.pi * (1.0 + 5.0**0.5) * spread  # even directions
        flat = np.sqrt(1.0 - height**2)
        self._directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)

    def initialize(self, points: Float[np.ndarray, "N 3"], hands: Sequence[int]) -> list[InitializedHand]:
        """Search for some of the hands."""
        search, self._points = self._searches.pop(tuple(hands), _Search()), points
        self._spreads = [state.spread for state in self._states]  # medians take as long as a fit
        initialized: list[InitializedHand] = []
        cut = False
        least = min((self._fewest_labeled(index) for index in hands), default=0)
        for group in linked_groups(points, self._link_distance):
            if not least <= len(group) <= MOST_POINTS:
                continue
            done = {hand.index for hand in initialized}
            rest, missing = group, [index for index in hands if index not in done]
            here: list[InitializedHand] = []
            while missing:
                cuts = self._cuts_of(rest, missing)
                cut |= len(cuts) > 0
                hand = self._best(rest, missing, cuts, search)
                if hand is None or not self._is_evident(hand):
                    break
                here.append(hand)
                rest = rest[hand.labels[rest] < 0]
                missing.remove(hand.index)
            self._attempts[missing] += 1
            initialized += self._uncrossed(self._divided(here, group))
        initialized = self._sides_checked(initialized)
        for hand in initialized:
            self._attempts[hand.index] = 0
        if cut and not initialized and search.turn < _LAST_CALL and not self._at_once:
            search.turn += 1
            self._searches[tuple(hands)] = search
        else:
            self._first_cut += _CUTS_OF_SEARCH
        return initialized

    def is_searching(self, hands: Sequence[int]) -> bool:
        """Whether a search for these hands continues in the next call."""
        return tuple(hands) in self._searches

    def _needed(self, index: int) -> float:
        """Log-odds from which on a hand is initialized."""
        return self._config.least_evidence * min(_MARKERS_OF_EVIDENCE, self._states[index].num_markers)

    def _least_share(self, index: int) -> float:
        """Share of the required evidence from which a hand may wait for repetitions.

        It is 1, no waiting, where the fewest allowed markers suffice.
        """
        is_enough = self.score(self._fewest_labeled(index), self._config.marker_noise) >= self._needed(index)
        return 1.0 if is_enough else _LEAST_REPEATED

    def _is_evident(self, hand: InitializedHand) -> bool:
        """Whether a hand has enough evidence, by itself or with earlier calls that found the same."""
        if hand.score >= self._needed(hand.index):
            self._repeated.pop(hand.index, None)
            return True
        markers = targets_of(self._points, hand.labels, self._states[hand.index].num_markers)
        before = self._repeated.pop(hand.index, _Repeated(np.full_like(markers, np.nan)))
        now = _Repeated(markers, before.evidence + _REPETITION if _is_same(before.markers, markers) else 0.0)
        if hand.score + now.evidence >= self._needed(hand.index):
            return True
        # A hand that was found more often outlasts another one in between.
        outlasts = now.evidence == 0.0 < before.evidence
        now = before._replace(evidence=before.evidence - _REPETITION) if outlasts else now
        self._repeated[hand.index] = now
        return False

    def _sides_checked(self, hands: list[InitializedHand]) -> list[InitializedHand]:
        """Exchange the sides of two hands if both together fit better so."""
        # A single cloud may fit the wrong hand best: without a marker on the thumb, a symmetric layout fits
        # both hands almost equally.
        if len(hands) != 2:
            return hands
        one, two = hands
        first = self._fit(two.index, one.labels), self._fit(one.index, two.labels)
        if any(fit is None or _is_mirrored(fit, hand) for fit, hand in zip(first, hands, strict=True)):
            return hands
        return _likelier([self._trim(fit) for fit in first], hands)

    def score(self, count: int, rms: float, spread: float | None = None) -> float:
        """Log-odds of labeled points being a hand and not strays; `spread` [m] of its markers if known."""
        # Few points fit any pose, so coordinates absorbed by the pose do not count.
        taken = min(_FREE_COORDINATES, 3.0 * count)
        square = count * rms**2
        variance = (square + _SPREAD_BEFORE_COORDINATES * _SPREAD_BEFORE**2) / (
            3.0 * count - taken + _SPREAD_BEFORE_COORDINATES
        )
        variance = variance if spread is None else spread**2
        peak = peak_log_odds(np.array([variance]), self._config.stray_density)
        return float(count * peak[0] - 0.5 * (square / variance + taken))

    def _fewest_labeled(self, index: int) -> int:
        """Fewest labeled points of a hand."""
        share = _LEAST_LABELED_SHARE * self._states[index].num_markers
        return max(FEWEST_MARKERS, int(np.ceil(share)))

    def _best(
        self, group: Integers, hands: Sequence[int], cuts: Integers, search: _Search
    ) -> InitializedHand | None:
        """The first certain hand of a group, or after the last cut the best one."""
        if not len(cuts):
            return self._better(None, group, [group], hands, may_repeat=True)
        best: InitializedHand | None = None
        for turn in range(len(cuts) - _CUTS_AT_FIRST + 1) if self._at_once else [search.turn]:
            clouds = self._clouds_of_turn(group, cuts, turn)
            best = self._better(best, group, clouds, hands, may_repeat=True)
            if best is not None and self._is_certain(best):
                return best
        if self._at_once:
            return best
        if best is not None and best.score > search.score:
            search.score, search.best_turn = best.score, search.turn
        if search.turn < _LAST_CALL or search.score == -np.inf:
            return None
        if search.best_turn == search.turn:
            return best
        clouds = self._clouds_of_turn(group, cuts, search.best_turn)
        return self._better(best, group, clouds, hands, may_repeat=True)

    def _labeled(self, clouds: Sequence[Integers]) -> list[Integers]:
        """Label each cloud; return labels of all points per cloud, the most confident cloud first."""
        labelings = self._labeler.label_frames([self._points[cloud] for cloud in clouds])
        confidence = [float(one.confidence[one.labels >= 0].sum()) for one in labelings]
        labeled = np.full((len(clouds), len(self._points)), -1)
        for row, cloud, one in zip(labeled, clouds, labelings, strict=True):
            row[cloud] = one.labels
        return [labeled[number] for number in np.argsort(confidence)[::-1]]

    def _better(
        self,
        best: InitializedHand | None,
        group: Integers,
        clouds: Sequence[Integers],
        hands: Sequence[int],
        may_repeat: bool = False,
    ) -> InitializedHand | None:
        """The best hand so far, or a hand with a better score from these clouds of a group.

        A hand that lacks evidence counts if it may repeat itself.
        """
        for labels in self._labeled(clouds)[:_FITS_AT_A_TIME]:
            fits = [self._fit(index, labels) for index in hands]
            for first in sorted((fit for fit in fits if fit is not None), key=lambda fit: -fit.score):
                if best is not None and _is_mirrored(first, best):
                    continue
                share = self._least_shares[first.index] if may_repeat else 1.0
                hand = self._improve(first, group, share)
                if hand is not None and (best is None or hand.score > best.score):
                    best = hand
            if best is not None and self._is_certain(best):
                break
        return best

    def _is_certain(self, hand: InitializedHand) -> bool:
        """Whether a hand fits so well that no other cloud is tried."""
        return hand.score > _CERTAIN_SCORE * self._states[hand.index].num_markers

    def _cuts_of(self, group: Integers, hands: Sequence[int]) -> Integers:
        """Directions in which a group is cut, the longest extent first; none if it may be a single hand."""
        most = max(self._states[index].num_markers for index in hands)
        if len(group) <= most + min(SPARE_POINTS, _SPARE_SHARE * most):
            return np.empty(0, dtype=np.int64)
        count = _NUM_CUTS if self._at_once else _CUTS_OF_SEARCH
        numbers = _CUT_STRIDE * (self._first_cut + np.arange(count)) % _NUM_CUTS
        return numbers[np.argsort(-(self._points[group] @ self._directions[numbers].T).std(axis=0))]

    def _clouds_of_turn(self, group: Integers, cuts: Integers, turn: int) -> list[Integers]:
        """Clouds of a turn: the whole group and its halves along three cuts, then those of one more cut."""
        clouds, last = [group] if turn == 0 else [], turn + _CUTS_AT_FIRST
        for cut in cuts[0 if turn == 0 else last - 1 : last]:
            order = group[np.argsort(self._points[group] @ self._directions[cut])]
            clouds += [order[: len(group) // 2], order[len(group) // 2 :]]
        return clouds

    def _improve(self, first: InitializedHand, group: Integers, share: float) -> InitializedHand | None:
        """Remove labels that do not fit, then match and fit all points of the group again."""
        index, state = first.index, self._states[first.index]
        hand = self._trim(first) or self._trim(self._without_outliers(first))
        if hand is None and share < 1.0:
            hand = self._trim(first, share)
        for _ in range(_REFINEMENT_ROUNDS):
            if hand is None:
                return None
            positions = state.solver.marker_positions(hand.fit.qpos[0])
            fitted = float(hand.fit.rms[0] / np.sqrt(3.0))
            spread = np.clip(_SEARCH_FACTOR * fitted, _SEARCH_LEAST, _SEARCH_MOST)
            covariances = np.tile(spread**2 * np.eye(3), (state.num_markers, 1, 1))
            labels = np.full(len(self._points), -1)
            log_odds = match_log_odds(self._points[group], positions, covariances, self._config.stray_density)
            labels[group], _ = match_points(log_odds)
            if (labels == hand.labels).all():
                break
            hand = self._trim(self._fit(index, labels, hand.fit), share)
        return hand

    def _divided(self, hands: list[InitializedHand], group: Integers) -> list[InitializedHand]:
        """Label each of several hands of a group again, without the points of the others."""
        for number, hand in enumerate(hands if len(hands) > 1 else ()):
            others = [other.labels[group] >= 0 for other in hands if other is not hand]
            again = self._better(hand, group, [group[~np.any(others, axis=0)]], (hand.index,))
            hands[number] = again or hand
        return hands

    def _uncrossed(self, hands: list[InitializedHand]) -> list[InitializedHand]:
        """Exchange the points of a digit between two hands where both together fit better so."""
        # A thumb fits the palm of a touching hand almost as well as its own.
        if len(hands) != 2:
            return hands
        points, digits = self._points, self._states[hands[0].index].solver.hand.digits
        for digit in range(len(DIGITS)):
            one, two = hands
            on_digit = [(hand.labels >= 0) & (digits[hand.labels] == digit) for hand in (one, two)]
            ours, theirs = map(np.flatnonzero, on_digit)
            if not len(ours) or not len(theirs):
                continue
            if distances_to_nearest(points[ours], points[theirs]).min() > _DIGIT_EXCHANGE_DISTANCE:
                continue
            first, second = one.labels.copy(), two.labels.copy()
            first[ours], second[theirs] = -1, -1
            first[theirs], second[ours] = two.labels[theirs], one.labels[ours]
            changed = [
                self._trim(self._fit(hand.index, labels, hand.fit))
                for hand, labels in ((one, first), (two, second))
            ]
            hands = _likelier(changed, hands)
        return hands

    def _trim(self, hand: InitializedHand | None, share: float = 1.0) -> InitializedHand | None:
        """Drop the worst label while that raises the score; None if the result is not a hand.

        A hand has at least this share of the evidence that is asked for.
        """
        best: InitializedHand | None = None
        while hand is not None and (best is None or hand.score > best.score):
            best = hand
            labeled = np.flatnonzero(hand.labels >= 0)
            squares = (hand.fit.residuals[0, hand.labels[labeled]] ** 2).sum(axis=1)
            labels = hand.labels.copy()
            labels[labeled[squares.argmax()]] = -1
            hand = self._fit(hand.index, labels, hand.fit)
        if best is None or not best.fit.rms[0] <= self._config.most_rms:
            return None
        return best if best.score >= share * self._needed(best.index) else None

    def _without_outliers(self, first: InitializedHand) -> InitializedHand | None:
        """Drop labels that are outliers of a robust fit; None if these are too many."""
        # One wrong label can bend a least-squares fit.
        state = self._states[first.index]
        targets = targets_of(self._points, first.labels, state.num_markers)
        fit = self._robust[first.index].solve(targets[None], iterations=_FIRST_FIT_STEPS)
        distances = np.linalg.norm(fit.residuals[0], axis=-1)
        kept = (first.labels >= 0) & (distances[first.labels] < OUTLIER_DISTANCE)
        if kept.sum() < _LEAST_KEPT_LABELS * (first.labels >= 0).sum():
            return None
        return self._fit(first.index, np.where(kept, first.labels, -1), fit)

    def _fit(self, index: int, labels: Integers, near: PoseFit | None = None) -> InitializedHand | None:
        """Fit a hand to labeled points, starting from `near` if given; None if there are too few points."""
        # Unusual poses lower the score. A hand that was seen recently must fit as well as before.
        count, state = int((labels >= 0).sum()), self._states[index]
        if count < self._fewest_labeled(index):
            return None
        targets = targets_of(self._points, labels, state.num_markers)[None]
        start, steps = (None, _FIRST_FIT_STEPS) if near is None else (near.qpos, _REFIT_STEPS)
        fit = state.solver.solve(targets, start, iterations=steps)
        spread = self._spreads[index] if self._attempts[index] < _KNOWN_SPREAD_ATTEMPTS else None
        offset = fit.qpos[0, 7:] - self._prior.angles
        unusual = float(offset @ self._prior.precision @ offset) - NUM_JOINTS
        penalty = min(max(_POSE_WEIGHT * unusual, 0.0), _MOST_POSE_PENALTY)
        return InitializedHand(index, fit, labels, self.score(count, float(fit.rms[0]), spread) - penalty)


def _likelier(new: Sequence[InitializedHand | None], hands: list[InitializedHand]) -> list[InitializedHand]:
    """The new hands if all of them exist and have a higher total score; otherwise the hands before."""
    found = [hand for hand in new if hand is not None]
    better = sum(hand.score for hand in found) > sum(hand.score for hand in hands)
    return found if better and len(found) == len(hands) else hands


def _is_same(before: Float[np.ndarray, "M 3"], markers: Float[np.ndarray, "M 3"]) -> bool:
    """Whether markers [m] of two calls, NaN where missing, are those of one hand."""
    both = np.isfinite(before[:, 0]) & np.isfinite(markers[:, 0])
    if both.sum() < FEWEST_MARKERS:
        return False
    rotation, shift = rigid_fit(before[both], markers[both])
    off = before[both] @ rotation.T + shift - markers[both]
    return bool((off**2).sum(axis=1).mean() < _SAME_HAND_RMS**2)


def _is_mirrored(first: InitializedHand, best: InitializedHand) -> bool:
    """Whether labels fit the hand of the other side so much better that they cannot be of this one."""
    kept = ((first.labels >= 0) & (best.labels == first.labels)).sum()
    much_better = best.fit.rms[0] < _GOOD_RMS and first.fit.rms[0] > _HOPELESS_FACTOR * best.fit.rms[0]
    return bool(much_better and kept >= _HOPELESS_SHARE * (first.labels >= 0).sum())


def _link_distance(hand: GloveFit) -> float:
    """Distance that links all neighboring markers of a hand in most gestures [m]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    markers, _ = hand.markers(join_qpos(gestures))
    return float(np.quantile(longest_links(markers), _LINKED_SHARE))


def label_alone(
    frames: Sequence[Float[np.ndarray, "N 3"]],
    hands: Sequence[GloveFit],
    labeler: Labeler,
    on_count: Callable[[int], None] = lambda count: None,
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Label every frame by itself; a hand is present if a pose fits.

    Returns the labels of all points, counted through the hands, and the confidence in each, from 0 to 1.
    """
    finder = HandInitializer([HandState(hand) for hand in hands], labeler, at_once=True)
    found = []
    for points in frames:
        found.append(finder.initialize(points, range(len(hands))))
        on_count(len(found))
    clouds = _clouds_to_label(frames, found, hands[0].layout.num_markers)
    labelings = labeler.label_frames([frames[number][cloud] for number, _, cloud in clouds])
    labels = [np.full(len(points), -1) for points in frames]
    confidence = [np.ones(len(points)) for points in frames]
    for (number, hand, cloud), one in zip(clouds, labelings, strict=True):
        labels[number][cloud] = np.where(one.labels >= 0, hand * hands[0].layout.num_markers + one.labels, -1)
        confidence[number][cloud] = one.confidence
    return np.concatenate(labels), np.concatenate(confidence)


def _clouds_to_label(
    frames: Sequence[Float[np.ndarray, "N 3"]], found: Sequence[Sequence[InitializedHand]], num_markers: int
) -> list[tuple[int, int, Int[np.ndarray, "C"]]]:
    """Points given to the labeler as one hand: frame, hand, and indices of the points."""
    most = num_markers + SPARE_POINTS
    full = [bool(hands) for points, hands in zip(frames, found, strict=True) if len(points) >= FEWEST_MARKERS]
    sides = [hand.index for hands in found for hand in hands]
    usual = np.bincount(sides).argmax() if sides and np.mean(full) >= _USUAL_HAND_SHARE else None
    clouds = []
    for number, (points, hands) in enumerate(zip(frames, found, strict=True)):
        small = FEWEST_MARKERS <= len(points) <= most
        if small and len(hands) < 2 and (hands or usual is not None):
            clouds.append((number, hands[0].index if hands else int(usual), np.arange(len(points))))  # type: ignore[arg-type]
            continue
        for hand in hands:
            near = distances_to_nearest(points, points[hand.labels >= 0]) < CLOUD_RADIUS
            for other in hands:
                near &= (other.labels < 0) | (other is hand)
            clouds.append((number, hand.index, np.flatnonzero(near)[:MAX_POINTS]))
    return clouds


def linked_groups(points: Float[np.ndarray, "N 3"], distance: float) -> list[Integers]:
    """Indices of points linked by steps of at most `distance` [m], the largest group first."""
    near = ((points[:, None] - points) ** 2).sum(axis=-1) <= distance**2
    numbers = connected_components(np.stack(np.nonzero(near)), len(points))
    groups = [np.flatnonzero(numbers == one) for one in range(numbers.max(initial=-1) + 1)]
    return sorted(groups, key=len, reverse=True)


def connected_components(links: Int[np.ndarray, "2 K"], count: int) -> Int[np.ndarray, "N"]:
    """Component number of each of N nodes of a graph; importing scipy.sparse.csgraph takes longer."""
    least, before = np.arange(count), np.full(count, -1)
    while (least != before).any():
        before = least.copy()
        for one, other in (links, links[::-1]):
            np.minimum.at(least, before[one], before[other])
        least = least[least]  # halves each node's distance to its component's least node
    return np.asarray(np.unique(least, return_inverse=True)[1])


def distances_to_nearest(
    points: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "N"]:
    """Distance of each point from the nearest of some others [m], which must not be empty."""
    return np.asarray(np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1))


def longest_links(points: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T"]:
    """Least distance that links all points of a frame to one group [m], by Prim's algorithm."""
    frames, longest = np.arange(len(points)), np.zeros(len(points))
    added, apart = np.zeros(len(points), dtype=np.int64), np.full(points.shape[:2], np.inf)
    in_tree = np.zeros(points.shape[:2], dtype=np.bool_)
    for _ in range(1, points.shape[1]):
        in_tree[frames, added] = True
        squares = ((points - points[frames, added][:, None]) ** 2).sum(axis=-1)
        apart = np.where(in_tree, np.inf, np.minimum(apart, squares))
        added = apart.argmin(axis=1)
        longest = np.maximum(longest, apart[frames, added])
    return np.sqrt(longest)
