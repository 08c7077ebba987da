"""Random poses: gestures and their blends, fingers that curl together or alone, corners of the ranges.

No recorded motion is used: three sources are mixed so that common poses are dense and all possible poses are
covered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_number
from poses.shapes.couplings import HIGH, LOW, apply_couplings, finger_view
from poses.shapes.library import all_gestures

_FLEXION_NOISE: Final = np.deg2rad(6.0)
_ABDUCTION_NOISE: Final = np.deg2rad(2.0)
_SWAY: Final = np.deg2rad(3.0)  # all fingers to one side
# How often the fingers part: index-middle, middle-ring, ring-little.
_SPLIT: Final = np.array([0.3, 0.2, 0.25])
_ALIKE: Final = 0.993
# How much curl may grow from index to little, standard deviation in the latent.
_SLOPE: Final = 0.15 * np.array([-1.5, -0.5, 0.5, 1.5])
_DIP_SHARE: Final = 0.68
_DIP_LAG: Final = np.deg2rad(6.0)
_DIP_NOISE: Final = np.deg2rad(9.0)
_MCP_OPEN, _MCP_CLOSED = np.deg2rad([-18.0, 92.0])
_PIP_OPEN, _PIP_CLOSED = np.deg2rad([-3.0, 112.0])
_SPREAD: Final = np.deg2rad([7.0, 1.5, -5.0, -11.0])  # one standard deviation of fanning, index to little


@dataclass(frozen=True, slots=True)
class PoseMix:
    """How often each source of poses is drawn; the shares are normalized.

    Raises:
        ArgumentError: A share is negative, or all are zero.
    """

    gestures: float = 0.45
    """Blends of two named gestures, each digit a little ahead or behind."""
    curls: float = 0.50
    """Correlated finger curls: neighbors move together, any finger may leave the others."""
    anywhere: float = 0.05
    """Uniform within the ranges."""

    def __post_init__(self) -> None:
        for name in ("gestures", "curls", "anywhere"):
            check_number(name, getattr(self, name), 0.0)
        check_number(
            "the sum of gestures, curls and anywhere",
            self.gestures + self.curls + self.anywhere,
            0.0,
            above=True,
        )


DEFAULT_MIX: Final = PoseMix()


def sample_angles(
    count: int, mix: PoseMix = DEFAULT_MIX, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Random joint angles [rad] inside ranges and couplings; digits may still touch.

    `poses.shapes.validity` makes such poses valid.
    """
    shares = np.array([mix.gestures, mix.curls, mix.anywhere])
    source = rng.choice(3, size=count, p=shares / shares.sum())
    angles = np.empty((count, len(LOW)))
    for number, draw in enumerate((_blend_gestures, _curl_fingers, _anywhere)):
        chosen = source == number
        angles[chosen] = draw(int(chosen.sum()), rng)
    return apply_couplings(angles)


def _blend_gestures(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    library = all_gestures()
    first, second = library[rng.integers(len(library), size=(2, count))]
    progress = rng.uniform(-0.1, 1.1, size=(count, 1)) + 0.12 * rng.standard_normal((count, 5))
    weight = np.repeat(np.clip(progress, 0.0, 1.0), 4, axis=1)
    angles: NDArray[np.float64] = (1.0 - weight) * first + weight * second
    noise = np.stack([_shared_normals(count, rng, digits=5) for _ in range(4)], axis=2) * _FLEXION_NOISE
    noise[..., 0] *= _ABDUCTION_NOISE / _FLEXION_NOISE
    flat: NDArray[np.float64] = noise.reshape(count, 20)
    angles += flat
    return angles


def _curl_fingers(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    from scipy.special import ndtr

    angles = _thumbs(count, rng)
    digits = finger_view(angles)
    within = rng.uniform(0.3, 1.0, size=(count, 1))  # how much the two joints of one finger move together
    splits = rng.random((count, 3)) < _SPLIT
    knuckles = _grouped(splits, rng.standard_normal((count, 4)))
    middles = within * knuckles + np.sqrt(1 - within**2) * _grouped(splits, rng.standard_normal((count, 4)))
    knuckles += _SLOPE * rng.standard_normal((count, 1))
    middles += _SLOPE * rng.standard_normal((count, 1))
    digits[:, 1:, 1] = _MCP_OPEN + (_MCP_CLOSED - _MCP_OPEN) * ndtr(1.15 * knuckles)
    digits[:, 1:, 2] = _PIP_OPEN + (_PIP_CLOSED - _PIP_OPEN) * ndtr(1.3 * middles)
    digits[:, 1:, 3] = _DIP_SHARE * digits[:, 1:, 2] - _DIP_LAG + _DIP_NOISE * _shared_normals(count, rng)
    fan, sway = rng.standard_normal((2, count, 1))
    digits[:, 1:, 0] = fan * _SPREAD + sway * _SWAY + _ABDUCTION_NOISE * rng.standard_normal((count, 4))
    return angles


def _shared_normals(count: int, rng: np.random.Generator, *, digits: int = 4) -> NDArray[np.float64]:
    """Standard normals (T, digits) that are mostly the same for all digits of a pose."""
    common, own = rng.standard_normal((count, 1)), rng.standard_normal((count, digits))
    mixed: NDArray[np.float64] = np.sqrt(0.75) * common + np.sqrt(0.25) * own
    return mixed


def _grouped(splits: NDArray[np.bool_], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard normals (T, 4), alike within a group of neighboring fingers, drawn anew at each split."""
    grouped = normals.copy()
    for finger in range(1, 4):
        along = _ALIKE * grouped[:, finger - 1] + np.sqrt(1 - _ALIKE**2) * normals[:, finger]
        grouped[:, finger] = np.where(splits[:, finger - 1], normals[:, finger], along)
    return grouped


def _thumbs(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Thumbs that oppose (palmar abduction comes with flexion) and fold (MCP and IP bend together)."""
    angles = np.zeros((count, 20))
    reach, sweep, fold, tip = rng.standard_normal((4, count))
    angles[:, 0] = np.deg2rad(14.0) * reach
    angles[:, 1] = np.deg2rad(6.0) + np.deg2rad(15.0) * (0.6 * reach + 0.8 * sweep)
    angles[:, 2] = np.deg2rad(22.0) + np.deg2rad(16.0) * (0.3 * sweep + 0.95 * fold)
    angles[:, 3] = np.deg2rad(24.0) + np.deg2rad(22.0) * (0.4 * fold + 0.3 * sweep + 0.87 * tip)
    return angles


def _anywhere(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.uniform(LOW, HIGH, size=(count, len(LOW)))
