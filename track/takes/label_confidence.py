"""Calibrated confidence in the labels of a whole take: of labels with confidence 0.9, 90 % are right.

A life is the frames through which one point is followed, by its ID if IDs persist, otherwise by position. Two
logistic models weigh the evidence on each point: one for points with a label, one for points without. Both
were fitted to simulated captures by benchmarks/doubtful_frames at commit 1f52414.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.takes.take import LOST, Take
from handsim.arrays import Integers
from handsim.hand.shape import DIGITS, NUM_JOINTS
from handsim.kernels import kernel, point_distance
from handsim.space.transforms import quaternion_matrix
from track.alternatives.alternatives import label_probability
from track.kinematics.pose_spread import resting_prior

_LEAST_RESIDUAL: Final = 0.0003  # [m] lower bound of a marker's usual residual: the noise of optical systems
_FEWEST_FRAMES: Final = 10  # frames needed to estimate the usual residual of a marker
_LINK_DISTANCE: Final = 0.015  # [m] largest motion within the hand between frames, without lasting IDs
_EXCHANGE_JUMP: Final = 0.005  # [m] smallest jump of points whose IDs were exchanged
_BESIDE_DISTANCE: Final = 0.1  # [m] radius within which points belong to one hand
_LONG_LIFE: Final = 20.0  # Lives of at least this many frames count as long.
_NO_NEIGHBOR: Final = 1.0  # [m] distance that stands for a missing neighbor
_MOST_RESIDUAL_RATIO: Final = 100.0  # upper bound of a residual in the evidence, in usual residuals
_REPEAT_DISTANCE: Final = 0.005  # [m] Brief points this close to each other on a hand may be one marker.
_LABELED_WEIGHTS: Final = (-8.11, 0.72, 3.08, 0.08, 0.68, 1.49, 2.49, 0.78)
"""Log-odds of a wrong label: bias, and weight of each piece of evidence."""
_UNLABELED_WEIGHTS: Final = (-9.44, 3.91, 3.13, 6.01, -0.76, 3.30, 1.62, 0.76, 1.35, 2.0)
"""Log-odds that an unlabeled point is a marker: bias, and weight of each piece of evidence.

The last weight is not fitted, because markers that are hardly ever seen are rare in those captures. From 1.7
on it reports a fingertip that is seen in nine of 600 frames, 24 mm from its place on the pose.
"""


class Evidence(NamedTuple):
    """Evidence on P points of a take, in order of its frames."""

    points: Int[np.ndarray, "P"]
    """Indices of the points in the take's list."""
    labels: Int[np.ndarray, "P"]
    """Label of each point, -1 if unlabeled."""
    markers: Int[np.ndarray, "P"]
    """Label of each point; of an unlabeled one, the nearest free marker."""
    labeled: Float[np.ndarray, "L 7"]
    """Evidence on the labeled points, in the order of `evidence_of`."""
    unlabeled: Float[np.ndarray, "U 9"]
    """Evidence on the unlabeled points."""


@lru_cache(maxsize=1)  # Confidences of a take and its doubtful spans are asked for one after the other.
def evidence_of(take: Take) -> Evidence:
    """Evidence on the labels of a take with poses, except those of rigid bodies."""
    from scipy.spatial import cKDTree

    count = take.hand_labels[-1].stop
    listed = take.point_list
    chosen = np.flatnonzero(listed.labels < count)
    frames, points = listed.frames[chosen], listed.points[chosen]
    labels = listed.labels[chosen].astype(np.int64)
    owners = np.repeat(np.arange(len(take.hands)), [len(part) for part in take.hand_labels])
    expected = np.concatenate([take.pose_markers(side) for side in take.sides], axis=1)
    centers = np.stack([expected[:, owners == hand].mean(axis=1) for hand in range(len(take.hands))], axis=1)
    starts = np.searchsorted(frames, np.arange(take.num_frames + 1))
    lives = _number_lives(points, listed.ids[chosen].astype(np.int64), starts, centers)
    own, others, length = _frames_of_lives(lives, labels, count)
    of_life, short = np.log1p(others / own), np.log(_LONG_LIFE / np.minimum(length, _LONG_LIFE))
    which, free = np.flatnonzero(labels >= 0), np.flatnonzero(labels < 0)
    seen = take.observed(range(count))
    residuals, markers = np.linalg.norm(seen - expected, axis=-1), labels.copy()
    markers[free], near = _surroundings(points, labels, starts, expected)
    of_hand = _hand_evidence(take, np.isfinite(seen[..., 0]), owners)[frames, owners[markers]]
    label, frame = labels[which], frames[which]
    off = np.fmax(residuals[frame, label] / _usual_residuals(residuals)[label], 1.0)
    off = np.minimum(np.nan_to_num(off, nan=3.0), _MOST_RESIDUAL_RATIO)
    labeled = [
        of_life[which],  # other labels in its life
        np.log1p((length - own - others) / own)[which],  # frames without a label in its life
        off - 1.0,  # residual
        np.log(off) * short[which],  # residual in a short life
        *of_hand[which].T,
        _digit_improbability(take, owners)[frame, label],
    ]
    is_brief, repeats = (near[0] < _BESIDE_DISTANCE) & (length[free] < _LONG_LIFE), np.zeros(len(free))
    brief = free[is_brief]
    nearest = markers[brief]
    rotations = quaternion_matrix(take.qpos[frames[brief], owners[nearest], 3:7])
    shifts = np.einsum("bji,bj->bi", rotations, points[brief] - expected[frames[brief], nearest])
    places = np.column_stack([shifts, nearest])  # The marker keeps offsets from different markers apart.
    again = cKDTree(places).query_ball_point(places, _REPEAT_DISTANCE, return_length=True) - length[brief]
    repeats[is_brief] = np.maximum(again, 0) / (1.0 + np.isfinite(residuals).sum(axis=0)[nearest])
    is_lost = (take.status == LOST).any(axis=1)[frames[free]]
    unlabeled = [
        of_life[free],  # labels in its life
        np.exp(-near[0] / 0.01),  # a free marker within 10 mm
        np.exp(-near[0] / 0.03),  # a free marker within 30 mm
        np.exp(-near[0] / 0.03) * short[free],  # the same in a short life
        np.exp(-near[1] / 0.03),  # a point within 30 mm
        np.log1p(near[2]) * is_lost,  # points beside it and a lost hand
        *of_hand[free].T,
        np.log1p(repeats),  # brief points at this offset from the marker, per frame with its label
    ]
    return Evidence(chosen, labels, markers, np.stack(labeled, axis=1), np.stack(unlabeled, axis=1))


def _usual_residuals(residuals: Float[np.ndarray, "T K"]) -> Float[np.ndarray, "K"]:
    """Usual residual of each marker [m]: its median, or that of the others if it has too few frames."""
    known = np.isfinite(residuals).sum(axis=0) >= _FEWEST_FRAMES
    usual = np.full(residuals.shape[1], np.nan)
    usual[known] = np.nanmedian(residuals[:, known], axis=0)
    usual[~known] = np.median(usual[known]) if known.any() else _LEAST_RESIDUAL
    return np.asarray(np.maximum(usual, _LEAST_RESIDUAL))


def _frames_of_lives(
    lives: Int[np.ndarray, "P"], labels: Int[np.ndarray, "P"], count: int
) -> tuple[Integers, Integers, Integers]:
    """Number of frames in each point's life: with the point's label, with another label, and in total."""
    pairs = lives * (count + 1) + labels + 1
    _, inverse, counts = np.unique(pairs, return_inverse=True, return_counts=True)
    own, with_label, length = counts[inverse], np.bincount(lives, labels >= 0), np.bincount(lives)
    others = with_label[lives].astype(np.int64) - np.where(labels >= 0, own, 0)
    return own, others, length[lives]


def _hand_evidence(
    take: Take, seen: Bool[np.ndarray, "T K"], owners: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "T H 2"]:
    """Evidence on each hand: its share of hidden markers, and the size of its marker biases."""
    values = np.zeros((*take.status.shape, 2))
    for hand, side in enumerate(take.sides):
        values[:, hand, 0] = np.log1p(20.0 * (1.0 - seen[:, owners == hand].mean(axis=1)))
        values[:, hand, 1] = np.log1p(1e3 * np.linalg.norm(take.marker_bias(side), axis=1).mean())
    return values


def _digit_improbability(take: Take, owners: Int[np.ndarray, "K"]) -> Float[np.ndarray, "T K"]:
    """How improbable the angles of each marker's digit are under the resting prior; 0 for the palm."""
    prior, n = resting_prior(), NUM_JOINTS // len(DIGITS)
    digits = np.concatenate([hand.attachment.digits for hand in take.hands])
    improbable = np.zeros((take.num_frames, len(digits)))
    for digit in range(len(DIGITS)):
        part = slice(n * digit, n * digit + n)
        precision = np.linalg.inv(prior.covariance[part, part])
        off = take.qpos[..., 7:][..., part] - prior.angles[part]
        square = np.nan_to_num(np.einsum("thi,ij,thj->th", off, precision, off)) / n
        own = np.flatnonzero(digits == digit)
        improbable[:, own] = np.log1p(square)[:, owners[own]]
    return improbable


@kernel
def _surroundings(
    points: Float[np.ndarray, "P 3"],
    labels: Int[np.ndarray, "P"],
    starts: Int[np.ndarray, "T+1"],
    expected: Float[np.ndarray, "T K 3"],
) -> tuple[Int[np.ndarray, "U"], Float[np.ndarray, "3 U"]]:
    """Surroundings of the unlabeled points.

    Returns the nearest free marker; its distance and that of the nearest other point [m], and the number of
    unlabeled points nearby.
    """
    count = (labels < 0).sum()
    marker, near = np.zeros(count, dtype=np.int64), np.full((3, count), _NO_NEIGHBOR)
    near[2], u = 0.0, 0
    for frame in range(len(starts) - 1):
        first, last = starts[frame], starts[frame + 1]
        free = np.ones(expected.shape[1], dtype=np.bool_)
        for i in range(first, last):
            if labels[i] >= 0:
                free[labels[i]] = False
        for i in range(first, last):
            if labels[i] >= 0:
                continue
            for k in range(len(free)):
                if free[k]:
                    distance = point_distance(points[i], expected[frame, k])
                    if distance < near[0, u]:
                        near[0, u], marker[u] = distance, k
            for j in range(first, last):
                if i != j:
                    distance = point_distance(points[i], points[j])
                    near[1, u] = min(near[1, u], distance)
                    near[2, u] += labels[j] < 0 and distance < _BESIDE_DISTANCE
            u += 1
    return marker, near


@kernel
def _number_lives(
    points: Float[np.ndarray, "P 3"],
    ids: Int[np.ndarray, "P"],
    starts: Int[np.ndarray, "T+1"],
    centers: Float[np.ndarray, "T H 3"],
) -> Int[np.ndarray, "P"]:
    """The life of each point, followed by IDs if they persist, else by position; exchanged IDs are undone."""
    lives, number = np.full(len(points), -1), 0
    for frame in range(len(starts) - 1):
        first, last = starts[frame], starts[frame + 1]
        before = starts[frame - 1] if frame else first
        predicted, current = points[before:first].copy(), points[first:last]
        if frame:
            _move_with_hands(predicted, centers[frame - 1], centers[frame])
        source = np.full(last - first, -1)
        for j in range(len(source)):
            for i in range(len(predicted)):
                if ids[first + j] >= 0 and ids[first + j] == ids[before + i]:
                    source[j] = i
        if 2 * (source >= 0).sum() < min(len(source), len(predicted)):
            for j in range(len(source)):
                i = _nearest(predicted, current[j], _LINK_DISTANCE)
                source[j] = i if i >= 0 and _nearest(current, predicted[i], _LINK_DISTANCE) == j else -1
        else:
            _undo_exchanges(predicted, current, source)
        for j in range(len(source)):
            lives[first + j] = lives[before + source[j]] if source[j] >= 0 else number
            number += source[j] < 0
    return lives


@kernel
def _move_with_hands(
    points: Float[np.ndarray, "N 3"], old: Float[np.ndarray, "H 3"], new: Float[np.ndarray, "H 3"]
) -> None:
    """Move points near a hand along with the hand's center [m]."""
    for i in range(len(points)):
        hand = _nearest(old, points[i], 0.2)
        if hand >= 0 and not np.isnan(new[hand, 0]):
            points[i] += new[hand] - old[hand]


@kernel
def _undo_exchanges(
    predicted: Float[np.ndarray, "Q 3"], points: Float[np.ndarray, "N 3"], source: Int[np.ndarray, "N"]
) -> None:
    """Exchange the sources of two points that jump, if each is where the other was predicted."""
    for j in range(len(source)):
        for m in range(j):
            one, other = source[j], source[m]
            if one < 0 or other < 0:
                continue
            kept = point_distance(predicted[one], points[j])
            also = point_distance(predicted[other], points[m])
            changed = point_distance(predicted[one], points[m]) + point_distance(predicted[other], points[j])
            if min(kept, also) >= _EXCHANGE_JUMP and changed < 0.5 * (kept + also):
                source[j], source[m] = other, one


@kernel
def _nearest(points: Float[np.ndarray, "N 3"], place: Float[np.ndarray, "3"], most: float) -> int:
    """The point nearest to a place, -1 if it is farther than `most` [m]."""
    found = -1
    for i in range(len(points)):
        distance = point_distance(points[i], place)
        if distance < most:
            most, found = distance, i
    return found


def label_confidence(take: Take) -> Float[np.ndarray, "P"]:
    """Probability that each point's label is right; for an unlabeled point, that it is no marker.

    The confidence of rigid bodies' points does not change, nor that of a take without poses.
    """
    confidence = take.point_list.confidence.copy()
    if not np.isfinite(take.qpos).any():
        return confidence
    evidence = evidence_of(take)
    labeled = evidence.labels >= 0
    right = np.zeros(len(labeled))
    of_labels = labeled, evidence.labeled, _LABELED_WEIGHTS
    of_others = ~labeled, evidence.unlabeled, _UNLABELED_WEIGHTS
    for which, values, (bias, *weights) in (of_labels, of_others):
        right[which] = 1.0 / (1.0 + np.exp(bias + values @ np.array(weights)))
    right[labeled] *= label_probability(take)[evidence.labels[labeled]]
    confidence[evidence.points] = right
    return confidence
