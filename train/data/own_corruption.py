"""Corruption of a user's own, loaded by name and checked: clean markers in, labeled points out."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_callable
from handsim._plugins import call_plugin, load_plugin, plugin_name
from handsim.errors import ArgumentError
from train.data.augmentation import Cloud, Corruption, corrupt, shuffled

CORRUPTIONS: Final = "handsim.corruptions"
"""Group of entry points of corruptions."""
_NOUN: Final = "corruption"
_FARTHEST: Final = 10.0  # [m] of a point from the markers' middle
_MOST: Final = 512  # points of a cloud


class OwnCorruption(Protocol):
    """Makes clouds as cameras might see them; any function with this signature is one."""

    def __call__(
        self, markers: Float[np.ndarray, "B M 3"], *, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "B N 3"], Int[np.ndarray, "B N"]]:
        """Corrupt a batch.

        Args:
            markers: All markers of right hands [m], around each hand's middle; left ones are mirrored.
            rng: Source of all randomness.

        Returns:
            Points [m] in any order, NaN in places without a point; and the marker of each, -1 for a ghost.
        """


def draw_cloud(
    corruption: Corruption | OwnCorruption | str,
    markers: Float[np.ndarray, "B M 3"],
    *,
    rng: np.random.Generator,
) -> Cloud:
    """Shuffled clouds (B, N) of clean markers [m] by our corruption or a user's, see `own_cloud`."""
    if isinstance(corruption, Corruption):
        return corrupt(markers, corruption, rng=rng)
    return own_cloud(corruption, markers, rng=rng)


def own_cloud(
    corruption: OwnCorruption | str, markers: Float[np.ndarray, "B M 3"], *, rng: np.random.Generator
) -> Cloud:
    """Shuffled clouds (B, N) of clean markers [m] by a user's corruption.

    Args:
        corruption: A function like `OwnCorruption`; `module:name` of one or of a class whose instances are;
            or an entry point of the group `handsim.corruptions`.
        markers: Clean markers.

    Raises:
        ArgumentError: There is none of that name, it does not take these arguments, or what it returns has
            another shape, labels that are none, or points that are half NaN or beyond 10 m.
        HandSimError: It raised an error.
    """
    if isinstance(corruption, str):
        function = load_plugin(corruption, group=CORRUPTIONS, noun=_NOUN)
    else:
        check_callable(_NOUN, corruption, "a Corruption, a function (markers, *, rng), or its module:name")
        function = corruption
    name = plugin_name(corruption)
    returned = call_plugin(function, name, _NOUN, markers.copy(), rng=rng)
    owner = f"{_NOUN} '{name}'"
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ArgumentError(f"{owner} returns {type(returned).__name__}, expected the pair points, labels")
    try:
        points, labels = np.asarray(returned[0], dtype=np.float64), np.asarray(returned[1])
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{owner} returns no arrays: {error}") from error
    _check(owner, points, labels, *markers.shape[:2])
    present = np.asarray(np.isfinite(points).all(axis=-1))
    return shuffled(points, present, labels.astype(np.int64), rng=rng)


def check_corruption(corruption: OwnCorruption | str, num_markers: int) -> None:
    """Load a corruption and try it on two clouds, before the work.

    Raises:
        HandSimError: As `own_cloud`.
    """
    rng = np.random.default_rng(0)
    own_cloud(corruption, rng.uniform(-0.1, 0.1, (2, num_markers, 3)), rng=rng)


def _check(
    owner: str, points: NDArray[np.float64], labels: NDArray[np.generic], batch: int, count: int
) -> None:
    if points.ndim != 3 or points.shape[0] != batch or points.shape[2] != 3 or points.shape[1] > _MOST:
        raise ArgumentError(
            f"{owner} returns points of shape {points.shape}, expected ({batch}, N, 3) with N up to {_MOST}"
        )
    if labels.shape != points.shape[:2] or labels.dtype.kind not in "iu":
        raise ArgumentError(
            f"{owner} returns labels of type {labels.dtype} and shape {labels.shape}, expected whole numbers "
            f"{points.shape[:2]}"
        )
    missing = np.isnan(points)
    if (missing.any(axis=-1) != missing.all(axis=-1)).any() or (np.abs(points) > _FARTHEST).any():
        raise ArgumentError(
            f"{owner} returns points of which some coordinates are NaN or beyond {_FARTHEST:g} m, expected "
            "meters, and NaN for whole points that are missing"
        )
    there = ~missing.any(axis=-1)
    known = np.where(there, labels, -1).astype(np.int64)
    if known.min(initial=-1) < -1 or known.max(initial=-1) >= count:
        raise ArgumentError(
            f"{owner} returns labels from {known.min()} to {known.max()}, expected -1 to {count - 1}"
        )
    ordered = np.sort(known, axis=1)
    if ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        raise ArgumentError(f"{owner} returns a marker twice in a cloud, expected each at most once")
