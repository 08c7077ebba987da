"""Settings of learning a glove."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gloves.layout import AnyLayout
from handsim.errors import ArgumentError
from handsim.hand.shape import SIDES, Side
from handsim.settings import Limits, Settings


@dataclass(frozen=True, slots=True)
class LearnSettings(Settings):
    """How a glove is learned from captures: options of `handsim glove learn`, arguments of `learn_glove`."""

    radius_mm: Annotated[float | None, Limits(0.5, 15.0)] = None
    """Radius of the markers [mm]; needed unless there is a start."""
    start: AnyLayout | None = None
    """A guess of the layout, the path of a .toml file: its places are corrected. Captures without its names
    are labeled with it."""
    hands: tuple[Side, ...] = SIDES
    """Which hands may be in the captures."""

    def check(self) -> None:
        """Refuse a radius beside a start, which has one, and hands that are named twice or not at all."""
        if self.start is not None and self.radius_mm is not None:
            raise ArgumentError("radius_mm is given beside a start, which has a radius; expected one of them")
        if not self.hands or len(set(self.hands)) < len(self.hands):
            raise ArgumentError(f"hands are {list(self.hands)}, expected right, left or both, each once")
