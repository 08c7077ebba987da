"""The user: hands of somebody's size in somebody's gloves, which is all a tracker has to know of them."""

from __future__ import annotations

from dataclasses import dataclass

from gloves.attach import Attachment, attach
from gloves.layout import MarkerLayout
from handsim.model import HandModel
from handsim.topology import Side


@dataclass(frozen=True, slots=True, eq=False)
class UserHand:
    """One hand of the user in its glove."""

    model: HandModel
    attachment: Attachment

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.model.shape.side


def usual_hand(layout: MarkerLayout, size: str, side: Side) -> UserHand:
    """A hand of one of the five sizes, its glove put on as designed: where a calibration begins."""
    model = HandModel.named(size, side=side)
    return UserHand(model, attach(layout, model))
