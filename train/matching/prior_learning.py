"""A pose prior from the frames of a training set: clusters of hands, each with its principal components."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from train.matching.pose_prior import PosePrior

MOST_COMPONENTS: Final = 400
_FRAMES_EACH: Final = 400  # of a component; fewer frames give fewer components
_LEAST_COMPONENTS: Final = 12  # a prior of fewer knows less than the network
_LEAST_MEMBERS: Final = 20  # of a component
_DIRECTIONS: Final = 24  # about the degrees of freedom of a hand
_NOISE: Final = 0.0012  # of a marker's coordinate in a capture [m], optics and skin
_LENT: Final = 100.0  # frames' worth of its neighbors' covariance that each component is given
_NEIGHBORS: Final = 8
_CLUSTERINGS: Final = 4
_RIGID: Final = 6  # directions that the alignment takes out
_CHUNK: Final = 8192
_MOST_FRAMES: Final = 200_000


def learn_pose_prior(markers: Float[np.ndarray, "T M 3"], *, rng: np.random.Generator) -> PosePrior | None:
    """The prior of the hands in some frames; None where they are too few, or too few markers.

    Args:
        markers: Markers of right hands [m], anywhere; frames in which one is missing are left out.
        rng: Chooses frames and first clusters.
    """
    markers = markers[np.isfinite(markers).all(axis=(1, 2))]
    if len(markers) > _MOST_FRAMES:
        markers = markers[np.sort(rng.permutation(len(markers))[:_MOST_FRAMES])]
    count = min(MOST_COMPONENTS, len(markers) // _FRAMES_EACH)
    rank = min(_DIRECTIONS, 3 * markers.shape[1] - _RIGID - 1)
    if count < _LEAST_COMPONENTS or rank < 1:
        return None
    members = _clusters(markers.astype(np.float64), count, rng)
    means, scatters, sizes = _moments(markers.astype(np.float64), members, count)
    covariances = _lent(means, scatters, sizes)
    values, vectors = np.linalg.eigh(covariances)  # in ascending order
    spreads = np.sqrt(values[:, _RIGID:-rank].mean(axis=1) + _NOISE**2)
    deviations = np.sqrt(np.maximum(values[:, -rank:] + _NOISE**2 - spreads[:, None] ** 2, 0.0))
    directions = vectors[:, :, -rank:] * deviations[:, None]
    return PosePrior(
        means.astype(np.float32),
        directions.reshape(*means.shape, rank).astype(np.float32),
        spreads.astype(np.float32),
        np.log(sizes / sizes.sum()).astype(np.float32),
    )


def align_all(
    hands: Float[np.ndarray, "T M 3"], target: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "T M 3"]:
    """Hands turned and moved onto one hand with the least squares of distances (Kabsch 1976)."""
    centered = hands - hands.mean(axis=1, keepdims=True)
    center = target.mean(axis=0)
    left, _, right = np.linalg.svd(centered.swapaxes(1, 2) @ (target - center))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    aligned: NDArray[np.float64] = centered @ (left @ right) + center
    return aligned


def _clusters(
    markers: Float[np.ndarray, "T M 3"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, "T"]:
    """The cluster of each frame, by k-means of the hands aligned with their mean."""
    mean = markers[0]
    for _ in range(_CLUSTERINGS):
        mean = align_all(markers, mean).mean(axis=0)
    flat = align_all(markers, mean).reshape(len(markers), -1)
    centers = flat[rng.permutation(len(flat))[:count]]
    members = _nearest(flat, centers)
    for _ in range(_CLUSTERINGS):
        sums = np.zeros_like(centers)
        np.add.at(sums, members, flat)
        sizes = np.bincount(members, minlength=count)
        centers = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centers)
        members = _nearest(flat, centers)
    return members


def _nearest(flat: Float[np.ndarray, "T D"], centers: Float[np.ndarray, "K D"]) -> Int[np.ndarray, "T"]:
    """The nearest center of each row."""
    offsets = (centers**2).sum(axis=1)
    parts = [
        (offsets - 2.0 * flat[first : first + _CHUNK] @ centers.T).argmin(axis=1)
        for first in range(0, len(flat), _CHUNK)
    ]
    return np.concatenate(parts)


def _moments(
    markers: Float[np.ndarray, "T M 3"], members: Int[np.ndarray, "T"], count: int
) -> tuple[Float[np.ndarray, "K M 3"], Float[np.ndarray, "K D D"], Int[np.ndarray, "K"]]:
    """Mean hand, scatter matrix and size of each cluster, its hands aligned with that mean; no small ones."""
    means, scatters, sizes = [], [], []
    for cluster in range(count):
        hands = markers[members == cluster]
        if len(hands) < _LEAST_MEMBERS:
            continue
        mean = hands[0]
        for _ in range(_CLUSTERINGS):
            aligned = align_all(hands, mean)
            mean = aligned.mean(axis=0)
        off = (aligned - mean).reshape(len(hands), -1)
        means.append(mean)
        scatters.append(off.T @ off)
        sizes.append(len(hands))
    return np.array(means), np.array(scatters), np.array(sizes)


def _lent(
    means: Float[np.ndarray, "K M 3"], scatters: Float[np.ndarray, "K D D"], sizes: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K D D"]:
    """Covariances, each with some of its neighbors', because its own frames are few."""
    flat = means.reshape(len(means), -1)
    covariances = np.empty_like(scatters)
    for cluster, mean in enumerate(flat):
        near = np.argsort(((flat - mean) ** 2).sum(axis=1))[1 : _NEIGHBORS + 1]
        around = scatters[near].sum(axis=0) / sizes[near].sum()
        covariances[cluster] = (scatters[cluster] + _LENT * around) / (sizes[cluster] + _LENT)
    return covariances
