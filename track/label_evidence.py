"""What a whole take tells of the label of each point, beyond what the tracker knew when it came to its frame.

Points are followed from frame to frame, by their IDs where these last, so that a label can be compared with
the others of the point's life; points, poses and labels of a frame are compared with those of other frames.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.takes.take import LOST, Take, labeled_markers
from handsim.hand.topology import BONES, DIGITS, NUM_JOINTS
from handsim.kernels.kernel import kernel
from track.kinematics.joint_prior import resting_prior

LABELED: Final = (
    "other labels in its life",
    "frames without a label in its life",
    "shortness of its life",
    "residual",
    "residual in a short life",
    "a better exchange",
    "an unlabeled point at the marker",
    "a free marker at the point",
    "markers not seen",
    "residual of the hand",
    "bias of the marker",
    "RMS of the hand",
    "improbable digit",
)
"""What is told of a point with a label."""
UNLABELED: Final = (
    "labels in its life",
    "length of its life",
    "shortness of its life",
    "a marker within 10 mm",
    "a marker within 30 mm",
    "a free marker within 3 mm",
    "a free marker within 10 mm",
    "a free marker within 30 mm",
    "a point within 30 mm",
    "a lost hand",
    "points beside it and a lost hand",
    "markers not seen",
    "RMS of the hand",
)
"""What is told of a point without a label."""
_LEAST_RESIDUAL: Final = 0.0007  # [m] that a marker is usually off, at least: the noise of optical systems
_FEWEST: Final = 10  # frames that tell how far a marker is usually off
_LINK: Final = 0.015  # [m] that a point moves in its hand from frame to frame at most, where IDs do not last
_EXCHANGE: Final = 0.005  # [m] that points jump at least whose IDs were exchanged
_BESIDE: Final = 0.1  # [m] within which points are those of one hand
_SHORT: Final = 20.0  # frames of a life that tells nothing by being short
_FAR: Final = 1.0  # [m] in the place of what is not there


class Evidence(NamedTuple):
    """What is told of the P points of a take, in the order of its frames."""

    frames: Int[np.ndarray, "P"]
    """Frame of each point."""
    columns: Int[np.ndarray, "P"]
    """Its column."""
    labels: Int[np.ndarray, "P"]
    """Its label, -1 for none."""
    hands: Int[np.ndarray, "P"]
    """The hand of its label, or the nearest."""
    labeled: Float[np.ndarray, "L F"]
    """What is told of the points with a label, see `LABELED`."""
    unlabeled: Float[np.ndarray, "U G"]
    """What is told of those without one, see `UNLABELED`."""


def evidence_of(take: Take) -> Evidence:
    """What a take with poses tells of the labels of its hands' markers; points of rigid bodies are left out."""
    count = take.hand_labels[-1].stop
    frames, columns = np.nonzero(np.isfinite(take.points[..., 0]) & (take.labels < count))
    points, labels = take.points[frames, columns], take.labels[frames, columns].astype(np.int64)
    owners = np.repeat(np.arange(len(take.hands)), [len(part) for part in take.hand_labels])
    expected = np.concatenate([take.pose_markers(side) for side in take.sides], axis=1)
    seen = labeled_markers(take.points, take.labels, range(count))
    residuals = np.linalg.norm(seen - expected, axis=-1)
    usual = _usual(residuals)
    centers = np.stack([expected[:, owners == hand].mean(axis=1) for hand in range(len(take.hands))], axis=1)
    starts = np.searchsorted(frames, np.arange(take.num_frames + 1))
    lives = _follow(points, take.ids[frames, columns].astype(np.int64), starts, centers, _LINK, _EXCHANGE)
    own, others, length = _lives(lives, labels, count)
    near = _surroundings(points, labels, starts, expected, usual, own, length, _BESIDE, _FAR)
    hands = np.where(labels >= 0, owners[np.maximum(labels, 0)], owners[near.marker])
    of_hand = _of_hands(take, residuals / usual, owners)[frames, hands]  # (P, 3)
    shortness = np.log(_SHORT / np.minimum(length, _SHORT))
    which, free = np.flatnonzero(labels >= 0), np.flatnonzero(labels < 0)
    label, frame = labels[which], frames[which]
    off = np.clip(np.log(np.fmax(residuals[frame, label], 1e-4) / usual[label]), 0.0, 2.5)
    off = np.nan_to_num(off, nan=1.0)
    labeled = [
        np.log((others + 0.5) / (own + 0.5))[which],
        np.log((length - own - others + 0.5) / (own + 0.5))[which],
        shortness[which],
        off,
        off * shortness[which],
        *(np.exp(-np.maximum(cost[which], 0.0) / 4.0) for cost in (near.exchange, near.rival, near.free)),
        *of_hand[which, :2].T,
        _bias(take)[label],
        of_hand[which, 2],
        _improbable(take, owners)[frame, label],
    ]
    lost = (take.status == LOST).sum(axis=1)[frames[free]]
    unlabeled = [
        np.log((others + 0.5) / (own + 0.5))[free],
        np.log(length)[free],
        shortness[free],
        *(np.exp(-near.any[free] / scale) for scale in (0.01, 0.03)),
        *(np.exp(-near.free[free] / scale) for scale in (0.003, 0.01, 0.03)),
        np.exp(-near.point[free] / 0.03),
        lost,
        np.log1p(near.beside[free]) * (lost > 0),
        of_hand[free, 0],
        of_hand[free, 2],
    ]
    return Evidence(frames, columns, labels, hands, np.stack(labeled, axis=1), np.stack(unlabeled, axis=1))


def _usual(residuals: Float[np.ndarray, "T K"]) -> Float[np.ndarray, "K"]:
    """How far each marker is usually off its pose [m]."""
    known = np.isfinite(residuals).sum(axis=0) >= _FEWEST
    usual = np.full(residuals.shape[1], np.nan)
    usual[known] = np.nanmedian(residuals[:, known], axis=0)
    usual[~known] = np.median(usual[known]) if known.any() else _LEAST_RESIDUAL
    return np.maximum(usual, _LEAST_RESIDUAL)


def _lives(
    lives: Int[np.ndarray, "P"], labels: Int[np.ndarray, "P"], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Frames in the life of each point with its label, with another one, and of the whole life."""
    pairs = lives * (count + 1) + labels + 1
    _, inverse, counts = np.unique(pairs, return_inverse=True, return_counts=True)
    own, with_label, length = counts[inverse], np.bincount(lives, labels >= 0), np.bincount(lives)
    others = with_label[lives].astype(np.int64) - np.where(labels >= 0, own, 0)
    return own, others, length[lives]


def _of_hands(
    take: Take, residuals: Float[np.ndarray, "T K"], owners: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "T H 3"]:
    """What is told of a hand: its markers not seen, its residuals against the usual ones, its RMS."""
    values = np.zeros((*take.status.shape, 3))
    for hand in range(len(take.hands)):
        own = residuals[:, owners == hand]
        seen = np.isfinite(own)
        values[:, hand, 0] = np.log1p(20.0 * (1.0 - seen.mean(axis=1)))
        mean = np.sqrt(np.where(seen, own, 0.0) ** 2).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        values[:, hand, 1] = np.clip(np.log(np.maximum(mean, 0.3)), -1.0, 2.0)
        values[:, hand, 2] = np.clip(np.log(np.nan_to_num(1e3 * take.rms[:, hand], nan=4.0) + 0.3), -1.0, 2.5)
    return values


def _bias(take: Take) -> Float[np.ndarray, "K"]:
    """Bias of each marker [cm]."""
    biases = [np.linalg.norm(take.marker_bias(side), axis=1) for side in take.sides]
    return np.minimum(100.0 * np.concatenate(biases), 3.0)


def _improbable(take: Take, owners: Int[np.ndarray, "K"]) -> Float[np.ndarray, "T K"]:
    """How far from those of resting hands the angles of each marker's digit are; 0 for the palm."""
    prior, n = resting_prior(), NUM_JOINTS // len(DIGITS)
    digits = np.concatenate([[BONES[bone].digit for bone in hand.attachment.main_bones] for hand in take.hands])
    improbable = np.zeros((take.num_frames, len(digits)))
    for digit in range(len(DIGITS)):
        part = slice(n * digit, n * digit + n)
        precision = np.linalg.inv(prior.covariance[part, part])
        off = take.qpos[..., 7:][..., part] - prior.angles[part]
        square = np.nan_to_num(np.einsum("thi,ij,thj->th", off, precision, off)) / n
        own = np.flatnonzero(digits == digit)
        improbable[:, own] = np.log1p(square)[:, owners[own]]
    return improbable


class _Surroundings(NamedTuple):
    """What is around each point."""

    marker: Int[np.ndarray, "P"]
    """The nearest marker of a pose; 0 without any."""
    any: Float[np.ndarray, "P"]
    """Its distance [m]."""
    free: Float[np.ndarray, "P"]
    """How much farther the nearest marker without a point is than the point's own [usual residuals]; of a
    point without a label, its distance [m]."""
    exchange: Float[np.ndarray, "P"]
    """What the least costly exchange with another point costs [usual residuals]."""
    rival: Float[np.ndarray, "P"]
    """How much farther from its marker the nearest point without a label is, that has lived as long as this
    one has the label [usual residuals]."""
    point: Float[np.ndarray, "P"]
    """Distance of the nearest other point [m]."""
    beside: Int[np.ndarray, "P"]
    """Points without a label beside it."""


def _surroundings(
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    starts: NDArray[np.int64],
    expected: NDArray[np.float64],
    usual: NDArray[np.float64],
    own: NDArray[np.int64],
    length: NDArray[np.int64],
    beside: float,
    far: float,
) -> _Surroundings:
    """What is around each point, see `_look_around`."""
    marker, count = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    values = np.full((5, len(points)), far)
    values[1:4, labels >= 0] = 99.0
    _look_around(points, labels, starts, expected, usual, own, length, beside, marker, count, values)
    return _Surroundings(marker, *values, count)


@kernel
def _look_around(
    points: Float[np.ndarray, "P 3"],
    labels: Int[np.ndarray, "P"],
    starts: Int[np.ndarray, "T+1"],
    expected: Float[np.ndarray, "T K 3"],
    usual: Float[np.ndarray, "K"],
    own: Int[np.ndarray, "P"],
    length: Int[np.ndarray, "P"],
    beside: float,
    marker: Int[np.ndarray, "P"],
    count: Int[np.ndarray, "P"],
    values: Float[np.ndarray, "5 P"],
) -> None:
    """Fill in the fields of `_Surroundings`.

    Args:
        points: Points of all frames [m].
        labels: Their labels, -1 for none.
        starts: First point of each frame, and the number of points.
        expected: Markers of the poses [m], NaN where a hand has none.
        usual: How far each marker is usually off [m].
        own: Frames that each point has its label for.
        length: Frames that it lives.
        beside: Distance of points beside a point [m].
        marker: `marker`, overwritten.
        count: `beside`, overwritten.
        values: The others, overwritten.
    """
    for frame in range(len(starts) - 1):
        first, last = starts[frame], starts[frame + 1]
        free = np.ones(len(usual), dtype=np.bool_)
        for i in range(first, last):
            if labels[i] >= 0:
                free[labels[i]] = False
        for i in range(first, last):
            label = labels[i]
            off = 0.0 if label < 0 else _distance(points[i], expected[frame, label]) / usual[label]
            for k in range(len(usual)):
                distance = _distance(points[i], expected[frame, k])
                if distance < values[0, i]:
                    values[0, i], marker[i] = distance, k
                if free[k]:
                    distance = distance if label < 0 else distance / usual[k] - off
                    if distance < values[1, i]:
                        values[1, i] = distance
            for j in range(first, last):
                if i == j:
                    continue
                distance, other = _distance(points[i], points[j]), labels[j]
                values[4, i] = min(values[4, i], distance)
                if other < 0:
                    count[i] += distance < beside
                if label < 0:
                    continue
                nearer = _distance(points[j], expected[frame, label]) / usual[label] - off
                if other < 0:
                    if length[j] >= own[i] and nearer < values[3, i]:
                        values[3, i] = nearer
                else:
                    cost = nearer + _distance(points[i], expected[frame, other]) / usual[other]
                    cost -= _distance(points[j], expected[frame, other]) / usual[other]
                    if cost < values[2, i]:
                        values[2, i] = cost


@kernel
def _follow(
    points: Float[np.ndarray, "P 3"],
    ids: Int[np.ndarray, "P"],
    starts: Int[np.ndarray, "T+1"],
    centers: Float[np.ndarray, "T H 3"],
    link: float,
    exchange: float,
) -> Int[np.ndarray, "P"]:
    """The life that each point is of: that of its ID, where IDs last, and where two are not exchanged.

    Args:
        points: Points of all frames [m].
        ids: The system's IDs, -1 for none.
        starts: First point of each frame, and the number of points.
        centers: Middle of each hand's markers [m]; the points around it move with it.
        link: Step [m] to a point of the next frame at most, where IDs do not last.
        exchange: Step [m] at least of points whose IDs were exchanged.
    """
    lives, number = np.full(len(points), -1), 0
    for frame in range(len(starts) - 1):
        first, last = starts[frame], starts[frame + 1]
        before = starts[frame - 1] if frame else first
        predicted = points[before:first].copy()
        for i in range(len(predicted)):
            nearest, hand = 0.2, -1
            for h in range(centers.shape[1]):
                distance = _distance(predicted[i], centers[frame - 1, h])
                if distance < nearest and not np.isnan(centers[frame, h, 0]):
                    nearest, hand = distance, h
            if hand >= 0:
                predicted[i] += centers[frame, hand] - centers[frame - 1, hand]
        source, same = np.full(last - first, -1), 0
        for j in range(last - first):
            for i in range(len(predicted)):
                if ids[first + j] >= 0 and ids[first + j] == ids[before + i]:
                    source[j], same = i, same + 1
        if 2 * same < min(len(source), len(predicted)):
            source[:] = -1
            for j in range(len(source)):
                i = _nearest(predicted, points[first + j], link)
                if i >= 0 and _nearest(points[first:last], predicted[i], link) == j:
                    source[j] = i
        else:
            for j in range(len(source)):
                for m in range(j):
                    one, other = source[j], source[m]
                    if one < 0 or other < 0:
                        continue
                    kept = _distance(predicted[one], points[first + j])
                    also = _distance(predicted[other], points[first + m])
                    if kept < exchange or also < exchange:
                        continue
                    changed = _distance(predicted[one], points[first + m])
                    changed += _distance(predicted[other], points[first + j])
                    if changed < 0.5 * (kept + also):
                        source[j], source[m] = other, one
        for j in range(len(source)):
            if source[j] >= 0:
                lives[first + j] = lives[before + source[j]]
            else:
                lives[first + j], number = number, number + 1
    return lives


@kernel
def _nearest(points: Float[np.ndarray, "N 3"], place: Float[np.ndarray, "3"], most: float) -> int:
    """The point nearest to a place, -1 if it is farther than `most` [m]."""
    found = -1
    for i in range(len(points)):
        distance = _distance(points[i], place)
        if distance < most:
            most, found = distance, i
    return found


@kernel(inline=True)
def _distance(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Distance of two points [m]."""
    return np.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)  # type: ignore[no-any-return]
