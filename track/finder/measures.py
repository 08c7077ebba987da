"""How far the markers of a hand can be apart, and the check that labeled points fit a hand.

Simulated hands of children and adults in random poses, in gloves that slipped, give the least and the
greatest distance of each pair of markers. Points of something else that a labeler names like a hand break
many of these.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.layout import MarkerLayout
from handsim.hand.model import join_qpos
from handsim.hand.shape import Population
from handsim.kernels.kernel import kernel
from poses.shapes.validity import sample_valid_angles
from train.simulation.people import sample_hands, wear_gloves

_PEOPLE, _POSES = 60, 30
_EXAMPLES: Final = 180  # hands that are kept
_CHILDREN: Final = 0.3
_SLIP_ALONG, _SLIP_AROUND = 0.05, np.deg2rad(5.0)
_SHARE, _MARGIN = 0.05, 0.005  # by which distances may be beyond those of the simulated hands; [m]
_HIDDEN: Final = 1 / 6  # share of markers that are hidden when neighbors are learnt
_LINKED: Final = 0.99  # share of hands whose markers are all linked
_COMPONENTS: Final = 20  # of the distances of all pairs: about the degrees of freedom of a hand and its size
_LEAST_SPREAD: Final = 0.002  # of a distance around the components [m]


class HandMeasures:
    """Distances between the markers of a hand of any size in any pose.

    Args:
        layout: The glove.
        rng: Source of the hands that it learns from.
    """

    def __init__(self, layout: MarkerLayout, *, rng: np.random.Generator) -> None:
        markers = np.concatenate([_sample_markers(layout, rng) for _ in range(_PEOPLE)])
        self.num_markers = layout.num_markers
        self.examples: NDArray[np.float64] = markers[:: len(markers) // _EXAMPLES]
        """Markers (E, M, 3) of some of the hands [m]."""
        distances = np.linalg.norm(markers[:, :, None] - markers[:, None], axis=-1)
        self._least: NDArray[np.float64] = distances.min(axis=0) * (1.0 - _SHARE) - _MARGIN
        self._most: NDArray[np.float64] = distances.max(axis=0) * (1.0 + _SHARE) + _MARGIN
        self.link_distance = float(np.quantile([_longest_link(one, rng) for one in markers], _LINKED))
        """Distance within which neighboring markers of a hand are, also with some hidden [m]."""
        self._first, self._second = np.triu_indices(layout.num_markers, 1)
        pairs = distances[:, self._first, self._second]
        self._mean: NDArray[np.float64] = pairs.mean(axis=0)
        variances, axes = np.linalg.eigh(np.cov(pairs.T))  # in ascending order
        kept = min(_COMPONENTS, len(variances) // 2)
        self._components: NDArray[np.float64] = axes[:, -kept:] * np.sqrt(variances[-kept:])
        left = float(variances[:-kept].sum()) / len(variances)
        self._variance = 2.0 * max(left, _LEAST_SPREAD**2)
        self._pair = np.zeros((layout.num_markers, layout.num_markers), dtype=np.int64)
        self._pair[self._first, self._second] = np.arange(len(self._first))
        self._pair += self._pair.T

    def fitting(
        self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N"]:
        """Which labeled points together fit a hand: without those that break the most distances.

        Args:
            points: Points [m].
            labels: Marker of each point, -1 for none.
        """
        keep: NDArray[np.bool_] = _fitting(points, labels, self._least, self._most)
        return keep

    def misfit(self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"]) -> float:
        """How far the distances of labeled points are from those of the hand that fits best [m].

        A hand is the mean of the simulated ones and a sum of their principal components, each as unlikely as
        it is large.

        Args:
            points: Points [m], two or more.
            labels: Marker of each point.
        """
        first, second = np.triu_indices(len(points), 1)
        pair = self._pair[labels[first], labels[second]]
        off = np.linalg.norm(points[first] - points[second], axis=-1) - self._mean[pair]
        components = self._components[pair]
        normal = components.T @ components + self._variance * np.eye(components.shape[1])
        along = np.linalg.solve(normal, components.T @ off)
        rest = off - components @ along
        return float(np.sqrt((rest @ rest + self._variance * (along @ along)) / len(off)))


def _sample_markers(layout: MarkerLayout, rng: np.random.Generator) -> NDArray[np.float64]:
    """Markers of one person's right hand in random poses (T, M, 3) [m]."""
    models = sample_hands(Population(children=_CHILDREN), rng=rng)
    (fit,) = wear_gloves(layout, models[1:], along=_SLIP_ALONG, around=_SLIP_AROUND, rng=rng)
    markers, _ = fit.markers(join_qpos(sample_valid_angles(fit.model, _POSES, rng=rng)))
    return markers


def _longest_link(markers: Float[np.ndarray, "M 3"], rng: np.random.Generator) -> float:
    """The least distance at which the markers are linked while some are hidden [m]."""
    seen = rng.permutation(len(markers))[int(_HIDDEN * len(markers)) :]
    return longest_link(markers[seen])


@kernel
def longest_link(points: Float[np.ndarray, "N 3"]) -> float:
    """The least distance at which points are linked to one group [m], as Prim grows their tree."""
    nearest, linked = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.bool_)
    here, longest = 0, 0.0
    for _ in range(len(points) - 1):
        linked[here] = True
        last, here = here, -1
        for other in range(len(points)):
            if not linked[other]:
                squared = 0.0
                for axis in range(3):
                    squared += (points[last, axis] - points[other, axis]) ** 2
                nearest[other] = min(nearest[other], squared)
                if here < 0 or nearest[other] < nearest[here]:
                    here = other
        longest = max(longest, nearest[here])
    return float(np.sqrt(longest))


@kernel
def _fitting(
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    least: NDArray[np.float64],
    most: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """See `HandMeasures.fitting`; distances [m]."""
    keep = labels >= 0
    broken = np.zeros((len(points), len(points)), dtype=np.bool_)
    count = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        for j in range(i):
            if keep[i] and keep[j]:
                squared = 0.0
                for axis in range(3):
                    squared += (points[i, axis] - points[j, axis]) ** 2
                distance = np.sqrt(squared)
                a, b = labels[i], labels[j]
                if distance < least[a, b] or distance > most[a, b]:
                    broken[i, j] = broken[j, i] = True
                    count[i] += 1
                    count[j] += 1
    while len(count) and count.max() > 0:
        worst = count.argmax()
        keep[worst] = False
        for other in range(len(points)):
            if broken[worst, other]:
                broken[worst, other] = broken[other, worst] = False
                count[other] -= 1
        count[worst] = 0
    return keep
