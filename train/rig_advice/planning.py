"""The search for a rig: cameras are chosen one after the other, then exchanged while that helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from train.rig_advice.candidate_views import CandidateViews

WEIGHTS: Final = (0.02, 0.4, 0.6, 0.05)
"""What the shares of marker-frames that one, two, three and four cameras see are worth. A point begins with
three rays and goes on with two, so that both count; one alone matters while there is one camera only, and a
fourth forgives a lost picture."""
_ERROR: Final = 0.15  # what a millimeter of mean error costs
_LONGEST: Final = 1.5  # error of points that no two cameras see, or only along nearly one line [mm]
_APART: Final = 0.3  # of two cameras [m]
_GAIN: Final = 1e-5  # of an exchange, at least
_EXCHANGES: Final = 200


class Planning:
    """Cameras chosen among candidates.

    Args:
        views: What each candidate sees.
        positions: Where each is [m].
        kept: Candidates that are chosen before and stay.
    """

    def __init__(
        self, views: CandidateViews, positions: Float[np.ndarray, "K 3"], kept: Sequence[int] = ()
    ) -> None:
        self._views, self._positions, self._kept = views, positions, tuple(kept)
        self.chosen = list(kept)
        """Numbers of the candidates so far."""

    @property
    def value(self) -> float:
        """How good the chosen cameras are."""
        return self._value_of(self.chosen)

    def grow(self, num_cameras: int) -> None:
        """Choose the best candidate, then the best beside it, and so on.

        Raises:
            ArgumentError: There are too few places.
        """
        while len(self.chosen) < num_cameras:
            values = self._values_with(self.chosen)
            if not np.isfinite(values.max()):
                raise ArgumentError(
                    f"there is room for {len(self.chosen)} cameras {_APART:g} m apart, expected "
                    f"{num_cameras}; give more mounts or a larger room"
                )
            self.chosen.append(int(values.argmax()))

    def exchange(self, told: Callable[[float], None] = lambda value: None) -> None:
        """Move one camera at a time to the best candidate, while that helps.

        Args:
            told: Called with the value after every exchange.
        """
        value, idle, number = self.value, 0, len(self._kept)
        free = len(self.chosen) - len(self._kept)
        for _ in range(_EXCHANGES):
            if idle >= free:
                return
            others = self.chosen[:number] + self.chosen[number + 1 :]
            values = self._values_with(others)
            best = int(values.argmax())
            idle += 1
            if values[best] > value + _GAIN:
                self.chosen[number], value, idle = best, float(values[best]), 0
                told(value)
            number = number + 1 if number + 1 < len(self.chosen) else len(self._kept)

    def _value_of(self, chosen: Sequence[int]) -> float:
        seen = [int(np.bitwise_count(plane).sum()) for plane in self._planes(chosen)]
        shares = np.array(seen) / self._views.num_marker_frames
        error = _mean_error(self._views.told[:, list(chosen)].sum(axis=1)[:, None])
        return float(shares @ WEIGHTS - _ERROR * error[0])

    def _values_with(self, chosen: Sequence[int]) -> NDArray[np.float64]:
        """The value (K,) of the chosen cameras and each candidate; -inf where that is too near to one."""
        views = self._views
        planes = self._planes(chosen)
        values = np.zeros(len(views.bits))
        before = [~np.zeros_like(planes[0]), *planes[:-1]]
        for weight, plane, fewer in zip(WEIGHTS, planes, before, strict=True):
            fresh = np.bitwise_count(views.bits & (fewer & ~plane)).sum(axis=1, dtype=np.int64)
            values += weight * (fresh + int(np.bitwise_count(plane).sum()))
        values /= views.num_marker_frames
        told = views.told[:, list(chosen)].sum(axis=1)[:, None]
        values -= _ERROR * _mean_error(told + views.told)
        values[self._crowded(chosen)] = -np.inf
        return values

    def _planes(self, chosen: Sequence[int]) -> list[NDArray[np.uint64]]:
        """Bits of the marker-frames that at least one, two, ... of the chosen cameras see."""
        planes = [np.zeros_like(self._views.bits[0]) for _ in WEIGHTS]
        for camera in chosen:
            for level in range(len(WEIGHTS) - 1, 0, -1):
                planes[level] |= planes[level - 1] & self._views.bits[camera]
            planes[0] |= self._views.bits[camera]
        return planes

    def _crowded(self, chosen: Sequence[int]) -> Bool[np.ndarray, "K"]:
        crowded = np.zeros(len(self._positions), dtype=bool)
        for camera in chosen:
            crowded |= np.linalg.norm(self._positions - self._positions[camera], axis=1) < _APART
        return crowded


def _mean_error(told: Float[np.ndarray, "6 K S"]) -> NDArray[np.float64]:
    """Root mean square distance of points from the truth (K,) [mm], averaged over the points."""
    a, b, c, d, e, f = told
    # The trace of the inverse of [[a, b, c], [b, d, e], [c, e, f]].
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    known = determinant > 1e-6 * np.maximum(a + d + f, 1e-12) ** 3
    squared = np.where(known, minors, _LONGEST**2) / np.where(known, determinant, 1.0)
    mean: NDArray[np.float64] = np.sqrt(np.clip(squared, 0.0, _LONGEST**2)).mean(axis=-1, dtype=np.float64)
    return mean
