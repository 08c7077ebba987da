"""From where the paper's network sees a cloud: at random as in the paper, or aligned with the mean hand.

A view is an orthogonal matrix from the cloud's frame into the camera's; one with determinant -1 shows a left
hand as a right one. Aligned views turn every hand like the mean hand of its layout, so the network does not
have to learn all orientations. While training, the true markers tell how; for labeling, views along the
cloud's principal axes begin, and the predicted markers turn the next view.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.space.transforms import quaternion_matrix, random_quaternions, rigid_fit

SIGNS: Final = np.array(list(product((1.0, -1.0), repeat=3)))
"""Signs (8, 3) of the principal axes, four for each side of the body."""
MIRROR_IMAGE: Final = np.array([-1.0, 1.0, 1.0])
"""Signs of the camera's axes in a mirrored view."""
_CANDIDATES: Final = 10  # views, of which the one on which a cloud spreads best is taken (Han et al., 3.1)
_MOMENTS: Final = tuple(
    powers for order in (3, 5) for powers in combinations_with_replacement(range(3), order)
)
NUM_MOMENTS: Final = len(_MOMENTS)
_ALIGNED_SHARE: Final = 0.6  # of the views in training; the others are along principal axes
_SPREAD: Final = np.radians(12.0)  # standard deviation of an aligned view's angle from the truth [rad]
_ROUNDS: Final = 10  # of averaging hands and aligning them with the average
_REGULAR: Final = 1e-4  # added to the variances of moments, which have no unit


@dataclass(frozen=True, slots=True, eq=False)
class MeanHand:
    """The mean right hand of a layout, and what the moments of its clouds look like."""

    markers: Float[np.ndarray, "M 3"]
    """Mean positions of the aligned markers [m], principal axes along x, y and z."""
    moments: Float[np.ndarray, "K"]
    """Mean third and fifth moments of clouds along their principal axes, with the right signs."""
    precision: Float[np.ndarray, "K K"]
    """Inverse of their covariance."""

    @classmethod
    def of_clouds(
        cls,
        markers: Float[np.ndarray, "B M 3"],
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
    ) -> MeanHand:
        """The mean hand of a training set.

        Args:
            markers: Markers of right hands [m].
            points: What a camera system made of them [m].
        """
        mean = markers[0]
        for _ in range(_ROUNDS):
            rotations, _ = rigid_fit(markers, mean)
            turned = (markers - markers.mean(1, keepdims=True)) @ rotations.swapaxes(1, 2)
            mean = turned.mean(axis=0)
        upright = principal_axes(mean[None], np.ones((1, len(mean)), dtype=bool))[0]
        mean = mean @ (upright * np.linalg.det(upright)).T
        rotations, _ = rigid_fit(markers, mean)
        seen = _moments(points, present, _nearest_axes(points, present, rotations)[:, None])[:, 0]
        covariance = np.cov(seen.T) + _REGULAR * np.eye(NUM_MOMENTS)
        return cls(mean, seen.mean(axis=0), np.linalg.inv(covariance))

    def align(self, markers: Float[np.ndarray, "B M 3"], side: Float[np.ndarray, "B"]) -> NDArray[np.float64]:
        """Views (B, 3, 3) that turn markers [m] like the mean hand; mirrored where `side` is -1, not 1."""
        mirrors = np.ones((len(markers), 1, 3))
        mirrors[:, 0, 0] = side
        rotations, _ = rigid_fit(markers * mirrors, self.markers)
        return rotations * mirrors

    def first_views(
        self, points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
    ) -> NDArray[np.float64]:
        """Views (B, 8, 3, 3) along the principal axes of clouds [m], the likeliest signs first.

        The moments of odd order change sign with the axes; each choice of signs is as likely as the moments
        that it gives, in a normal distribution.
        """
        views = SIGNS[:, :, None] * principal_axes(points, present)[:, None]
        offsets = _moments(points, present, views) - self.moments
        unlikely = np.einsum("bvi,ij,bvj->bv", offsets, self.precision, offsets)
        order = unlikely.argsort(axis=1, kind="stable")
        return np.take_along_axis(views, order[..., None, None], axis=1)

    def training_views(
        self,
        points: Float[np.ndarray, "B N 3"],
        present: Bool[np.ndarray, "B N"],
        markers: Float[np.ndarray, "B M 3"],
        *,
        rng: np.random.Generator,
    ) -> NDArray[np.float64]:
        """Views (B, 3, 3) of clouds of right hands: what labeling begins with, and what it is turned to.

        Args:
            markers: The markers behind them [m].
        """
        aligned = self.align(markers, np.ones(len(markers)))
        axes = _nearest_axes(points, present, aligned)
        direction = rng.standard_normal((len(points), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        turns = Rotation.from_rotvec(direction * (_SPREAD * rng.standard_normal((len(points), 1))))
        chosen = rng.random(len(points)) < _ALIGNED_SHARE
        return np.where(chosen[:, None, None], turns.as_matrix() @ aligned, axes)


def principal_axes(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
) -> NDArray[np.float64]:
    """Orthogonal matrices (B, 3, 3) whose rows are the principal axes of clouds, the longest first."""
    offsets, _ = centered(points, present)
    _, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets)
    return axes[:, :, ::-1].swapaxes(1, 2)


def random_views(count: int, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Rotations (count, 3, 3) to views from anywhere; the paper's in training (section 3.1)."""
    return quaternion_matrix(random_quaternions(count, rng=rng))


def spread_views(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Rotations (B, 3, 3) to the one of ten views on which each cloud spreads best (section 3.1).

    The ten are the same for all clouds. A cloud spreads best where the smaller eigenvalue of its projection's
    covariance is largest; of equals the larger eigenvalue counts, which is the order of determinants but
    tells views of a straight line apart.
    """
    candidates = random_views(_CANDIDATES, rng=rng)  # (V, 3, 3)
    offsets, _ = centered(points, present)
    covariance = offsets.swapaxes(1, 2) @ offsets / np.maximum(present.sum(1), 1)[:, None, None]  # (B, 3, 3)
    image_axes = candidates[:, :2]  # (V, 2, 3)
    spreads = np.linalg.eigvalsh(image_axes @ covariance[:, None] @ image_axes.swapaxes(1, 2))  # ascending
    rounding = 1e-12 * np.trace(covariance, axis1=1, axis2=2)[:, None]
    smaller = np.where(spreads[..., 0] > rounding, spreads[..., 0], 0.0)
    best = np.lexsort((spreads[..., 1], smaller), axis=-1)[:, -1]
    return candidates[best]


def centered(
    points: Float[np.ndarray, "B N 3"], present: Bool[np.ndarray, "B N"]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offsets (B, N, 3) of points from the mean of their cloud, 0 for padding, and the means (B, 3)."""
    known = np.where(present[..., None], points, 0.0)
    means = known.sum(axis=1) / np.maximum(present.sum(axis=1), 1)[:, None]
    return np.where(present[..., None], known - means[:, None], 0.0), means


def _moments(
    points: NDArray[np.float64], present: NDArray[np.bool_], views: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Third and fifth moments (B, V, K) of clouds (B, N, 3) in views (B, V, 3, 3), for a spread of one."""
    seen = centered(points, present)[0][:, None] @ views.swapaxes(2, 3)  # (B, V, N, 3)
    count = np.maximum(present.sum(axis=1), 1)[:, None]
    spread = np.sqrt((seen * seen).sum(axis=(2, 3)) / count)
    seen = seen / np.where(spread > 0.0, spread, 1.0)[..., None, None]
    columns = [seen[..., list(powers)].prod(axis=-1).sum(axis=-1) / count for powers in _MOMENTS]
    return np.stack(columns, axis=-1)


def _nearest_axes(
    points: NDArray[np.float64], present: NDArray[np.bool_], aligned: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotations (B, 3, 3) to the principal axes, with the signs nearest to the aligned views."""
    axes = principal_axes(points, present)
    axes = axes * np.linalg.det(axes)[:, None, None]
    rotations = SIGNS[SIGNS.prod(axis=1) > 0]
    nearest = np.einsum("bij,si,bij->bs", aligned, rotations, axes).argmax(axis=1)
    found: NDArray[np.float64] = rotations[nearest][:, :, None] * axes
    return found
