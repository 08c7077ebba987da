"""Points that are near each other: clusters within a frame, and a point in the next frame; compiled."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel

AMBIGUOUS: Final = 0.4
"""Share of the second distance above which the nearest point may be another one, so that labels decide."""


def clusters(points: Float[np.ndarray, "N 3"], distance: float) -> list[NDArray[np.int64]]:
    """Groups of points that are linked by steps of at most `distance` [m], the largest first.

    Args:
        points: Points of a frame [m].
        distance: Longest step [m].
    """
    number = _single_linkage(points, distance)
    groups = [np.flatnonzero(number == one) for one in range(int(number.max(initial=-1)) + 1)]
    return sorted(groups, key=len, reverse=True)


@kernel
def _single_linkage(points: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Number of the group of each point."""
    number = np.full(len(points), -1)
    stack = np.zeros(len(points), dtype=np.int64)
    groups = 0
    for first in range(len(points)):
        if number[first] >= 0:
            continue
        number[first], stack[0], height = groups, first, 1
        while height > 0:
            height -= 1
            here = stack[height]
            for other in range(len(points)):
                if number[other] < 0 and _squared(points[here], points[other]) <= distance**2:
                    number[other] = groups
                    stack[height] = other
                    height += 1
        groups += 1
    return number


@kernel
def _next_point(
    expected: NDArray[np.float64],
    reach: float,
    label: int,
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    miss: float,
) -> tuple[int, float]:
    """Which point of a frame a point is, -1 for none, and its squared distance.

    Args:
        expected: Where the point is expected (3,) [m].
        reach: Longest distance from there [m].
        label: Its label, -1 for none.
        points: Points of the frame (N, 3) [m].
        labels: Their labels (N,).
        miss: Squared distance of points from where they are expected, by their labels [m^2].
    """
    nearest, at, second = np.inf, -1, np.inf  # squared distances
    best, least = -1, np.inf  # without points of other labels
    for new in range(len(points)):
        squared = _squared(expected, points[new])
        if squared < nearest:
            nearest, at, second = squared, new, nearest
        else:
            second = min(second, squared)
        if squared < least and (label < 0 or labels[new] < 0 or labels[new] == label):
            best, least = new, squared
    if max(nearest, miss) <= AMBIGUOUS**2 * second:
        best, least = at, nearest
    return (best, least) if least < reach**2 else (-1, np.inf)


@kernel
def _usual_miss(
    expected: NDArray[np.float64],
    before: NDArray[np.int64],
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
) -> float:
    """Median of the squared distances of labeled points from where they are expected [m^2], 0 without any.

    Args:
        expected: Where the points of the frame before are expected (O, 3) [m].
        before: Their labels (O,), -1 for none.
        points: Points of a frame (N, 3) [m].
        labels: Their labels (N,).
    """
    squares = np.empty(len(points))
    count = 0
    for new in range(len(points)):
        for old in range(len(before)):
            if labels[new] >= 0 and before[old] == labels[new]:
                squares[count] = _squared(expected[old], points[new])
                count += 1
                break
    return float(np.median(squares[:count])) if count else 0.0


@kernel
def previous_points(
    points: Float[np.ndarray, "P 3"],
    starts: Int[np.ndarray, "T+1"],
    labels: Int[np.ndarray, "P"],
    reach: float,
    expected_reach: float,
) -> Int[np.ndarray, "P"]:
    """Which point of the frame before each point was, -1 where none is: the nearest both ways.

    A point that was followed once is expected where its last step leads it. Where another point is about as
    near, or the hand has moved nearly as far as its markers are apart, points of different labels are
    different points.

    Args:
        points: Points of all frames in a row [m].
        starts: Where each frame starts among them, and where the last one ends.
        labels: Label of each point, -1 for none.
        reach: Longest first step [m].
        expected_reach: Longest distance from where a point is expected [m].
    """
    previous = np.full(len(points), -1)
    expected = points.copy()
    reaches = np.full(len(points), reach)
    for frame in range(1, len(starts) - 1):
        before, now, end = starts[frame - 1], starts[frame], starts[frame + 1]
        back = np.full(end - now, -1)
        nearest = np.full(end - now, np.inf)
        miss = _usual_miss(expected[before:now], labels[before:now], points[now:end], labels[now:end])
        for old in range(before, now):
            best, least = _next_point(
                expected[old], reaches[old], labels[old], points[now:end], labels[now:end], miss
            )
            best += now if best >= 0 else 0
            if best >= 0 and least < nearest[best - now]:
                back[best - now], nearest[best - now] = old, least
        for new in range(now, end):
            old = back[new - now]
            if old >= 0:
                previous[new], reaches[new] = old, expected_reach
                for axis in range(3):
                    expected[new, axis] = 2.0 * points[new, axis] - points[old, axis]
    return previous


def following_points(previous: Int[np.ndarray, "P"]) -> Int[np.ndarray, "P"]:
    """Which point of the next frame each point is, -1 where none is; see `previous_points`."""
    following = np.full(len(previous), -1)
    linked = np.flatnonzero(previous >= 0)
    following[previous[linked]] = linked
    return following


@kernel(inline=True)
def _squared(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    squared: float = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    return squared
