"""What the viewer shows over time: frames of hands, points and bodies, made one at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from handsim.hand.model import HandModel
from handsim.space.cameras import CameraRig
from track.take_summary import Doubt


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """One frame: H hands, N points, B bodies, R rays."""

    time: float
    """[s]"""
    words: tuple[str, ...] = ()
    """The state of the frame, one line each."""
    hands: tuple[HandModel, ...] = ()
    qpos: Float[np.ndarray, "H 27"] = field(default_factory=lambda: np.empty((0, 27)))
    """Poses in the world [m, rad]; NaN where a hand has none."""
    points: Float[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """World [m]."""
    labels: Int[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Indices of `Recording.label_names`, -1 for a ghost."""
    seen: Bool[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """Which points were seen; the others are filled in from a pose."""
    bodies: Float[np.ndarray, "B 7"] = field(default_factory=lambda: np.empty((0, 7)))
    """Position [m] and orientation (wxyz) of each body; NaN where it is lost."""
    rays: Float[np.ndarray, "R 2 3"] = field(default_factory=lambda: np.empty((0, 2, 3)))
    """Lines of sight from markers to the cameras that see them [m]."""


class ShownBody(NamedTuple):
    """A rigid body and its shape; without a shape its axes are drawn."""

    name: str
    vertices: Float[np.ndarray, "V 3"] | None = None
    """In its own frame [m]."""
    faces: Int[np.ndarray, "F 3"] | None = None


class Curve(NamedTuple):
    """A number that changes over the frames."""

    name: str
    values: Float[np.ndarray, "T"]


class Recording(ABC):
    """T frames, made when they are asked for.

    Args:
        times: Time of each frame [s], increasing.
        label_names: Name of each label.
        most_points: The largest number of points in a frame.
        radius: Radius of a marker [m].
        bodies: The rigid bodies, in the order of `ShownFrame.bodies`.
        rig: The cameras, where they are known.
        curves: What to plot over time.
        doubts: Spans of frames that deserve a look, the most doubtful first.
        has_hands: Whether there are hands in any frame.
        has_filled: Whether there are points that were not seen.
    """

    def __init__(
        self,
        times: Float[np.ndarray, "T"],
        label_names: tuple[str, ...],
        *,
        most_points: int,
        radius: float = 0.0035,
        bodies: tuple[ShownBody, ...] = (),
        rig: CameraRig | None = None,
        curves: tuple[Curve, ...] = (),
        doubts: tuple[Doubt, ...] = (),
        has_hands: bool = True,
        has_filled: bool = True,
    ) -> None:
        self.times, self.label_names, self.most_points = times, label_names, most_points
        self.radius, self.bodies, self.rig = radius, bodies, rig
        self.curves, self.doubts = curves, doubts
        self.has_hands, self.has_filled = has_hands, has_filled

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @abstractmethod
    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
