"""What a tracker says of one frame: a pose a hand, a label a point, and how it came to them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from handsim.hand.topology import Side

if TYPE_CHECKING:
    from jaxtyping import Float, Int


class Status(Enum):
    """How far a hand's pose can be relied on."""

    TRACKED = "tracked"
    """It follows from the frame before."""
    FOUND = "found"
    """It was found among the points without any history."""
    COASTING = "coasting"
    """Too few markers are there: the pose is the one that was coming; it is given for a few frames only."""
    LOST = "lost"
    """There is no pose."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedHand:
    """One hand in one frame."""

    side: Side
    status: Status
    qpos: Float[np.ndarray, "27"]
    """NaN where the hand is lost."""
    rms: float
    """3D RMS distance of the labeled markers from the pose's [m]; NaN without a fit."""
    markers: Float[np.ndarray, "M 3"]
    """The labeled markers [m], and the pose's where they are missing; NaN where the hand is lost."""
    filled: Int[np.ndarray, "F"]
    """Which of these are filled in from the pose."""

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose to stand by."""
        return self.status is not Status.LOST


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBody:
    """One rigid body in one frame."""

    name: str
    status: Status
    translation: Float[np.ndarray, "3"]
    """Of the body's frame in the world [m]; NaN where it is lost."""
    rotation: Float[np.ndarray, "4"]
    """Its orientation, wxyz; NaN where it is lost."""
    rms: float
    """RMS distance of its labeled points from its markers [m]; NaN without any."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame's hands, bodies and points."""

    time: float
    hands: tuple[TrackedHand, ...]
    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands in their order, then the bodies; -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """How sure each label is, 0 to 1."""
    bodies: tuple[TrackedBody, ...] = ()
    notes: tuple[str, ...] = ()
    """What was wrong with the frame itself, in words; most frames have nothing to say."""
