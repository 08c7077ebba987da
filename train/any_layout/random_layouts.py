"""Random layouts out of the places of a bank: scattered ones, and regular ones as most gloves have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.layout import MarkerPlace
from handsim.hand.topology import BONE_NAMES, DIGITS, PALM, bones_of

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_GAP: Final = (0.006, 0.014)  # between a layout's markers on average over poses, at least [m]
_REGULAR: Final = 0.5  # share of layouts whose fingers are alike
_LOST_DIGIT: Final = 0.1
_ON_PALM: Final = (1, 6)  # markers of a regular layout
_ROW_ALONG: Final = (0.2, 0.85)
_ROW_AROUND: Final = float(np.deg2rad(20.0))  # standard deviation
_UNEVEN: Final = (0.02, 0.1, 0.3)  # standard deviation along the bone between the fingers of a row
_RADIANS_PER_BONE: Final = 3.0  # an angle about a bone that is as far as the bone's length


class RandomLayouts:
    """Draws layouts.

    Args:
        places: The places to choose from.
        spacing: Mean distance between every two of them [m].
    """

    def __init__(self, places: Sequence[MarkerPlace], spacing: Float[np.ndarray, "C C"]) -> None:
        self._bones = np.array([BONE_NAMES.index(place.bone) for place in places])
        self._along = np.array([place.along for place in places])
        self._around = np.array([place.around for place in places])
        self._spacing = spacing

    def draw(self, count: int, rng: np.random.Generator) -> Int[np.ndarray, "M"]:
        """Indices of the places of a layout of `count` markers, not too near to each other."""
        while True:
            gap = rng.uniform(*_GAP)
            wanted = self._rows(count, rng) if rng.random() < _REGULAR else []
            chosen: list[int] = []
            for place in (*wanted, *self._scattered(rng, palm_first=bool(wanted))):
                if len(chosen) < count and all(self._spacing[place, other] > gap for other in chosen):
                    chosen.append(int(place))
            if len(chosen) == count:
                return rng.permutation(np.array(chosen))

    def _scattered(self, rng: np.random.Generator, *, palm_first: bool) -> Int[np.ndarray, "C"]:
        """All places in a random order, evenly or unevenly over the bones."""
        bones = self._bones
        share = rng.dirichlet(np.full(bones.max() + 1, rng.choice([0.3, 1.0, 4.0])))
        share[PALM] *= 1000.0 if palm_first else rng.uniform(1.0, 6.0)
        weight = np.maximum((share / np.maximum(np.bincount(bones), 1))[bones], 1e-9)
        order: Int[np.ndarray, "C"] = rng.choice(
            len(bones), len(bones), replace=False, p=weight / weight.sum()
        )
        return order

    def _rows(self, count: int, rng: np.random.Generator) -> list[int]:
        """Places at nearly the same part of every digit, for one to four rows; room is left for the palm."""
        rows = [
            (int(rng.integers(3)), rng.uniform(*_ROW_ALONG), _ROW_AROUND * rng.standard_normal())
            for _ in range(int(rng.integers(1, 5)))
        ]
        uneven = rng.choice(_UNEVEN)
        digits = np.flatnonzero(rng.random(len(DIGITS)) > _LOST_DIGIT)
        wanted = []
        for segment, along, around in rows:
            for digit in digits:
                off = uneven * rng.standard_normal(2) * (1.0, _RADIANS_PER_BONE)
                bone = bones_of(DIGITS[digit])[segment]
                wanted.append(self._nearest(bone, along + off[0], around + off[1]))
        return wanted[: max(0, count - int(rng.integers(*_ON_PALM)))]

    def _nearest(self, bone: int, along: float, around: float) -> int:
        """The place on a bone that is nearest to what is wanted."""
        here = np.flatnonzero(self._bones == bone)
        off = np.hypot(self._along[here] - along, (self._around[here] - around) / _RADIANS_PER_BONE)
        return int(here[off.argmin()])
