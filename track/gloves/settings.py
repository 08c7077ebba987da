"""Settings of learning a glove."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gloves.layout import AnyLayout
from handsim.hand.shape import SIDES, Side
from handsim.settings import Limits, Settings


@dataclass(frozen=True, slots=True)
class LearnSettings(Settings):
    """How a glove is learned from captures: options of `handsim glove learn`, arguments of `learn_glove`."""

    radius_mm: Annotated[float | None, Limits(0.5, 15.0)] = None
    """Radius of the markers [mm]; needed unless there is a start."""
    start: AnyLayout | None = None
    """A guess of the layout, the path of a .toml file: its places are corrected. The captures then need no
    labels."""
    hands: tuple[Side, ...] = SIDES
    """Which hands may be in the captures."""
