"""The hands of single frames: clusters of points, labeled, and checked whether they fit a hand.

A labeler names the points of one hand, and it names something in any cloud. So a cluster is a hand only where
most of its labels fit one, with confidence. Hands that are close to each other make one cluster; it is cut,
and where a part fits a hand, the rest is labeled without that hand, and the hand without that rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.layout import MarkerLayout
from handsim.hand.topology import Side
from track.finder.links import clusters
from track.finder.measures import HandMeasures
from train.labelers.protocol import Labeler
from train.labelers.side import SideClassifier
from train.matching.pose_prior import PosePrior

Group = NDArray[np.int64]

_LEAST_SHARE: Final = 0.4  # of a hand's markers that must be labeled
_FEWEST: Final = 5
_FEW: Final = 4  # points near each other that may be of a hidden hand
_SPARE: Final = 6  # points beyond a hand's markers from which on a cluster may be two hands
_SMALLEST: Final = 0.03  # extent of a hand's points [m]
_MOST: Final = 120  # points of a cluster; larger ones are not hands
_SHORTER_LINKS: Final = (0.8, 0.65, 0.5)  # at which hands that are close to each other come apart
_MISSED: Final = 0.02  # share of simulated hands below each criterion for a weak labeler
_SURE: Final = 0.9  # mean confidence from which on labels need no other witness
_LEAST_DENSITY: Final = 1.0  # log-density of a hand's points for each coordinate, with one or two wrong ones
_CUTS: Final = 12
_TRIED: Final = 3  # parts whose rest is labeled


@dataclass(frozen=True, slots=True)
class Criteria:
    """What labeled points must satisfy to be a hand."""

    fewest: int
    confidence: float
    """Least mean confidence of the labels that fit."""
    fitting_share: float
    """Least share of the labels that fit."""
    misfit: float
    """Largest misfit, see `HandMeasures.misfit` [m]."""
    clearness: float
    """Least clearness of the side, see `SideClassifier`."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundHand:
    """The labeled points of a hand in one frame."""

    points: Int[np.ndarray, "H"]
    """Which points of the frame."""
    labels: Int[np.ndarray, "H"]
    """Marker of each."""
    confidence: Float[np.ndarray, "H"]
    vote: float
    """Clearness of the side: positive for a right hand, negative for a left one."""

    @property
    def weight(self) -> float:
        """Sum of the confidence of its labels."""
        return float(self.confidence.sum())


class HandFinder:
    """Finds the hands of single frames.

    Args:
        labeler: Labels the points of one hand.
        layout: The glove.
        rng: Source of the simulated hands that the check learns from.
    """

    def __init__(self, labeler: Labeler, layout: MarkerLayout, *, rng: np.random.Generator) -> None:
        self.measures = HandMeasures(layout, rng=rng)
        self._labeler = labeler
        self._prior: PosePrior | None = getattr(labeler, "prior", None)
        self._classifier = SideClassifier(layout, rng=rng)
        self.num_markers = layout.num_markers
        self.certain = self._certain(rng)
        """A hand without any history."""
        spread = np.arange(_CUTS) + 0.5
        height, azimuth = 1.0 - spread / _CUTS, np.pi * (1.0 + 5.0**0.5) * spread  # even over half a sphere
        flat = np.sqrt(1.0 - height**2)
        self._directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)

    @property
    def fewest(self) -> int:
        """Least number of labeled points of a hand."""
        return max(_FEWEST, int(np.ceil(_LEAST_SHARE * self.num_markers)))

    def _certain(self, rng: np.random.Generator) -> Criteria:
        """The usual criteria, or milder ones that most simulated hands meet with this labeler."""
        usual = Criteria(self.fewest, 0.75, 0.8, 0.008, 0.3)
        seen = rng.permuted(np.tile(np.arange(self.num_markers), (len(self.measures.examples), 1)), axis=1)
        seen = seen[:, self.num_markers // 6 :]
        hands = list(np.take_along_axis(self.measures.examples, seen[..., None], axis=1))
        measured = []
        for points, labeling in zip(hands, self._labeler.label_frames(hands), strict=True):
            keep = self.measures.fitting(points, labeling.labels)
            if keep.sum() >= self.fewest:
                share = keep.sum() / (labeling.labels >= 0).sum()
                misfit = self.measures.misfit(points[keep], labeling.labels[keep])
                measured.append((labeling.confidence[keep].mean(), share, -misfit))
        if not measured:
            return usual
        confidence, share, misfit = np.quantile(measured, _MISSED, axis=0)
        return dataclasses.replace(
            usual,
            confidence=min(usual.confidence, float(confidence)),
            fitting_share=min(usual.fitting_share, float(share)),
            misfit=max(usual.misfit, -float(misfit)),
        )

    def find(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[tuple[list[FoundHand], bool]]:
        """The hands of each frame that stand apart, and whether these are all clusters of points.

        Args:
            frames: Points of each frame [m].
        """
        wanted, choices = [], []
        pending = np.zeros(len(frames), dtype=np.int64)
        for number, points in enumerate(frames):
            groups = clusters(points, self.measures.link_distance)
            pending[number] = sum(len(group) >= _FEW for group in groups)
            for group in groups:
                if self.fewest <= len(group) <= self.num_markers + _SPARE:
                    choices.append(number)
                    wanted.append((points, group))
        found: list[list[FoundHand]] = [[] for _ in frames]
        for number, hand in zip(choices, self.label(wanted, self.certain), strict=True):
            if hand is not None:
                found[number].append(hand)
        return [(hands, len(hands) == count) for hands, count in zip(found, pending, strict=True)]

    def find_merged(self, points: Float[np.ndarray, "N 3"]) -> list[FoundHand]:
        """The hands of one frame, also of those that touch; slower.

        Args:
            points: Points of the frame [m].
        """
        found: list[FoundHand] = []
        for group in self._groups(points):
            found += self._cut(points, group)
        return found

    def is_merged(self, points: Float[np.ndarray, "N 3"]) -> bool:
        """Whether a cluster has more points than a hand."""
        return any(len(group) > self.num_markers + _SPARE for group in self._groups(points))

    def label(
        self, clouds: Sequence[tuple[NDArray[np.float64], Group]], criteria: Criteria
    ) -> list[FoundHand | None]:
        """The hand among some points of a frame, or None, for each of many clouds.

        Args:
            clouds: Points of a frame [m], and which of them.
            criteria: What a hand must satisfy.
        """
        found: list[FoundHand | None] = [None] * len(clouds)
        parts = [points[group] for points, group in clouds]
        large = [number for number, part in enumerate(parts) if _extent(part) >= _SMALLEST]
        labelings = self._labeler.label_frames([parts[number] for number in large])
        for number, labeling in zip(large, labelings, strict=True):
            points, group = clouds[number]
            found[number] = self._check(points, group, labeling.labels, labeling.confidence, criteria)
        return found

    def _check(
        self,
        points: NDArray[np.float64],
        group: Group,
        labels: NDArray[np.int64],
        confidence: NDArray[np.float64],
        criteria: Criteria,
    ) -> FoundHand | None:
        fitting = self.measures.fitting(points[group], labels)
        here, names, sure = group[fitting], labels[fitting], confidence[fitting]
        named = int((labels >= 0).sum())
        if len(here) < max(criteria.fewest, criteria.fitting_share * named):
            return None
        if sure.mean() < criteria.confidence or self.measures.misfit(points[here], names) > criteria.misfit:
            return None
        side, clearness = self._classifier.classify(points[here], names)
        if clearness < criteria.clearness:
            return None
        if sure.mean() < _SURE and not self._is_likely(points[here], names, side):
            return None
        return FoundHand(here, names, sure, clearness if side == "right" else -clearness)

    def _is_likely(self, points: NDArray[np.float64], labels: NDArray[np.int64], side: Side) -> bool:
        """Whether labeled points lie as a hand's markers do, as far as the labeler knows hands as wholes."""
        if self._prior is None:
            return True
        density = self._prior.log_density(points, labels, mirrored=side == "left")
        return density >= _LEAST_DENSITY * points.size

    def _groups(self, points: NDArray[np.float64]) -> list[Group]:
        groups = clusters(points, self.measures.link_distance)
        return [group for group in groups if self.fewest <= len(group) <= _MOST]

    def _split(self, points: NDArray[np.float64], group: Group) -> list[Group]:
        """Parts of a cluster at the longest distance at which it has two; the cluster itself otherwise."""
        for share in _SHORTER_LINKS:
            parts = clusters(points[group], share * self.measures.link_distance)
            if len(parts) > 1 and len(parts[1]) >= self.fewest:
                return [group[part] for part in parts if len(part) >= self.fewest]
        return [group]

    def _cut(self, points: NDArray[np.float64], group: Group) -> list[FoundHand]:
        """The one or two hands of a cluster: what explains most of its points."""
        parts = [group]
        if len(group) > self.num_markers + _SPARE:
            half = len(group) // 2
            parts += self._split(points, group)
            for direction in self._directions:
                order = group[np.argsort(points[group] @ direction)]
                parts += [order[:half], order[half:]]
        first = [hand for hand in self._label_parts(points, parts) if hand is not None]
        first = sorted(first, key=lambda hand: hand.weight, reverse=True)[:_TRIED]
        second = self._label_parts(points, (np.setdiff1d(group, hand.points) for hand in first))
        rests = [group if other is None else np.setdiff1d(group, other.points) for other in second]
        again = self._label_parts(points, rests)
        best: list[FoundHand] = []
        for hand, other, improved in zip(first, second, again, strict=True):
            larger = hand if improved is None or improved.weight < hand.weight else improved
            pair = [larger] if other is None else [larger, other]
            if sum(one.weight for one in pair) > sum(one.weight for one in best):
                best = pair
        return best

    def _label_parts(self, points: NDArray[np.float64], parts: Iterable[Group]) -> list[FoundHand | None]:
        return self.label([(points, part) for part in parts], self.certain)


def _extent(points: NDArray[np.float64]) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0
