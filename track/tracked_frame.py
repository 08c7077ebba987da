"""A tracker's output for one frame: one pose per hand, one label per point, and their status."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from gloves.takes.points import Status
from handsim.hand.shape import NUM_JOINTS, NUM_KEYPOINTS, Side

Spreads = tuple[Float[np.ndarray, "20"], Float[np.ndarray, "21"]]
"""Standard deviation of each joint angle [rad], and of each keypoint in each direction [m]."""


def _unknown_spreads() -> Spreads:
    return np.full(NUM_JOINTS, np.nan), np.full(NUM_KEYPOINTS, np.nan)


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """One hand in one frame."""

    side: Side
    status: Status
    qpos: Float[np.ndarray, "27"]
    """The pose; NaN where the hand is lost."""
    rms: float
    """3D RMS distance of the labeled markers from the pose's, biases included [m]; NaN without a fit."""
    markers: Float[np.ndarray, "M 3"]
    """The labeled markers [m], and the pose's where they are missing; NaN where the hand is lost."""
    filled: Int[np.ndarray, "F"]
    """Indices of the markers that are filled in from the pose."""
    find_spreads: Callable[[], Spreads] = field(default=_unknown_spreads, repr=False)
    """Computes the standard deviations: only where they are asked for, since a frame has little time."""

    @property
    def angle_spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each joint angle [rad]; NaN where the hand is lost or it is not known."""
        return self._spreads[0]

    @property
    def keypoint_spread(self) -> Float[np.ndarray, "21"]:
        """Standard deviation of each keypoint in each direction [m]; NaN as of the angles."""
        return self._spreads[1]

    @cached_property
    def _spreads(self) -> Spreads:
        return self.find_spreads()

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return self.status is not Status.LOST


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBody:
    """One rigid body in one frame."""

    name: str
    status: Status
    translation: Float[np.ndarray, "3"]
    """Position of the body's frame in the world [m]; NaN where it is lost."""
    rotation: Float[np.ndarray, "4"]
    """Its orientation, wxyz; NaN where it is lost."""
    rms: float
    """RMS distance of its labeled points from its markers [m]; NaN without any."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame's hands, bodies and points."""

    time: float
    """Time of the frame [s]."""
    hands: tuple[TrackedHand, ...]
    labels: Int[np.ndarray, "N"]
    """Marker of each point, counted through the hands in their order, then the bodies; -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Confidence in each label, 0 to 1."""
    bodies: tuple[TrackedBody, ...] = ()
    notes: tuple[str, ...] = ()
    """What was wrong with the frame itself, in words; empty for most frames."""
    seconds: float = np.nan
    """Computing time of the tracker [s]; NaN where it was not measured."""


class FrameTracker(Protocol):
    """Anything that tracks a capture frame by frame."""

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Track the next frame: points [m], their IDs, and the time [s]."""
        ...
