"""Points vote for their labels along their paths: each label counts in the frames around it as well.

A label that a point has in many of the frames around holds also where the point had none or another one,
and one that it has in a few of them is dropped. Where labels and paths disagree, as in frames that do not
follow each other in time, no vote is passed on.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from handsim.kernels.kernel import kernel

_FADING: Final = 0.1  # time in which a vote fades [s]
_MARGIN: Final = 5  # of these times, beyond which no vote counts
_FRAMES: Final = 1024  # that are counted at once
_NO_LABEL: Final = 0.5  # weight of a frame in which a point has no label
_SHARE: Final = 0.35  # of the votes that a label needs
_AGREEING: Final = 0.9  # share of the expected agreement of the labels along the paths between two frames


def vote(
    labels: Int[np.ndarray, "P"],
    confidence: Float[np.ndarray, "P"],
    asked: Bool[np.ndarray, "P"],
    starts: Int[np.ndarray, "T+1"],
    previous: Int[np.ndarray, "P"],
    *,
    num_markers: int,
    rate: float,
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The labels of all points after the vote, and the share of the votes that each has.

    Args:
        labels: Label of each point of all frames in a row, those of the left hand after those of the right
            one, -1 for none; no two points of a frame have the same.
        confidence: Of each label.
        asked: Whether its frame was labeled; where not, no label says nothing.
        starts: Where each frame starts among the points, and where the last one ends.
        previous: Which point of the frame before each point was, see `track.finder.links.previous_points`.
        num_markers: Markers of a hand.
        rate: Frames per second [Hz].
    """
    margin = int(np.ceil(_MARGIN * _FADING * rate))
    previous = _agreeing(labels % num_markers, np.where(labels >= 0, confidence, 0.0), starts, previous)
    elected, shares = np.full(len(labels), -1), np.zeros(len(labels))
    for first in range(0, len(starts) - 1, _FRAMES):
        last = min(first + _FRAMES, len(starts) - 1)
        low, high = starts[max(first - margin, 0)], starts[min(last + margin, len(starts) - 1)]
        votes = _votes(
            labels[low:high],
            confidence[low:high],
            np.where(asked[low:high], _NO_LABEL, 0.0),
            previous[low:high] - low,
            2 * num_markers,
            float(np.exp(-1.0 / (_FADING * rate))),
        )
        for begin, end in zip(starts[first:last], starts[first + 1 : last + 1], strict=True):
            here = votes[begin - low : end - low]
            points, chosen = linear_sum_assignment(np.where(here >= _SHARE, here, 0.0), maximize=True)
            won = here[points, chosen] >= _SHARE
            elected[begin + points[won]] = chosen[won]
            shares[begin + points[won]] = here[points[won], chosen[won]]
    return elected, shares


def _agreeing(
    names: NDArray[np.int64],
    confidence: NDArray[np.float64],
    starts: NDArray[np.int64],
    previous: NDArray[np.int64],
) -> NDArray[np.int64]:
    """The links (P,) without those to a frame in which labels change more often than they are wrong.

    Args:
        names: Label of each point (P,).
        confidence: Probability (P,) that it is right; 0 where a point has none.
        starts: Where each frame starts among the points, and where the last one ends.
        previous: Which point of the frame before each point was (P,), -1 for none.
    """
    frame = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    linked = np.flatnonzero((previous >= 0) & (confidence > 0.0))
    linked = linked[confidence[previous[linked]] > 0.0]
    before = previous[linked]
    agreeing, expected = (
        np.bincount(frame[linked], weights, minlength=len(starts) - 1)
        for weights in (names[linked] == names[before], confidence[linked] * confidence[before])
    )
    return np.where((agreeing < _AGREEING * expected)[frame], -1, previous)


@kernel
def _votes(
    labels: NDArray[np.int64],
    confidence: NDArray[np.float64],
    no_label: NDArray[np.float64],
    previous: NDArray[np.int64],
    count: int,
    keep: float,
) -> NDArray[np.float64]:
    """Share (P, count) of the votes that each label has at each point.

    Args:
        labels: Label (P,) of each point of some frames in a row, -1 for none.
        confidence: Confidence (P,) of each label.
        no_label: Weight (P,) of a point without one.
        previous: Point (P,) of the frame before, negative for none among these.
        count: Number of labels.
        keep: What is left of a vote in the next frame.
    """
    own = np.zeros((len(labels), count + 1))
    for point in range(len(labels)):
        if labels[point] >= 0:
            own[point, labels[point]] = confidence[point]
            own[point, count] = 1.0
        else:
            own[point, count] = no_label[point]
    forwards, backwards = own.copy(), own.copy()
    for point in range(len(labels)):
        if previous[point] >= 0:
            forwards[point] += keep * forwards[previous[point]]
    for point in range(len(labels) - 1, -1, -1):
        if previous[point] >= 0:
            backwards[previous[point]] += keep * backwards[point]
    total = forwards + backwards - own
    return total[:, :count] / np.maximum(total[:, count:], 1e-9)
