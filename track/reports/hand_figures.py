"""What a take tells of each hand: joint angles, residuals and presence of markers, and their statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.takes.take import INITIALIZED, LOST, Take
from handsim.hand.shape import Side

RANGE: Final = {"least": 0.0, "5th": 5.0, "median": 50.0, "95th": 95.0, "largest": 100.0}
"""What is told of a range of motion, as percentiles."""
_CHUNK: Final = 4096  # frames whose bones are posed at once


@dataclass(frozen=True, slots=True, eq=False)
class HandFigures:
    """One hand of a take over its T frames, with its M markers."""

    side: Side
    marker_names: tuple[str, ...]
    status: Int[np.ndarray, "T"]
    """Indices into `STATUSES`."""
    angles: Float[np.ndarray, "T 20"]
    """Joint angles in the order of `JOINT_NAMES` [deg]; NaN where the hand is lost."""
    angle_spread: Float[np.ndarray, "T 20"] | None
    """Standard deviation of each angle [deg]; None where the take does not know them."""
    residuals: Float[np.ndarray, "T M"]
    """Distance of each labeled point from the pose's marker [m]; NaN without a point or a pose."""
    confidence: Float[np.ndarray, "T M"]
    """Probability of each marker's label; NaN where the marker has no point."""

    @property
    def seen(self) -> Bool[np.ndarray, "T M"]:
        """Which markers have a point."""
        seen: NDArray[np.bool_] = np.isfinite(self.confidence)
        return seen

    @property
    def fitted(self) -> Bool[np.ndarray, "T"]:
        """Frames whose pose was fitted to points, which a coasting hand's is not."""
        return self.status >= INITIALIZED

    @property
    def rms(self) -> Float[np.ndarray, "T"]:
        """3D RMS of the residuals of each frame [m], of a truth too; NaN where there is none."""
        known = np.isfinite(self.residuals)
        total = np.sum(np.square(self.residuals), axis=1, where=known)
        square: NDArray[np.float64] = np.full(len(total), np.nan)
        np.divide(total, known.sum(axis=1), out=square, where=known.any(axis=1))
        return np.sqrt(square)

    def usual_spreads(self) -> Float[np.ndarray, "20"]:
        """Median standard deviation of each joint's angle over the fitted frames [deg]; NaN if unknown."""
        if self.angle_spread is None or not self.fitted.any():
            return np.full(self.angles.shape[1], np.nan)
        usual: NDArray[np.float64] = np.median(self.angle_spread[self.fitted], axis=0)
        return usual

    def range_of_motion(self) -> Float[np.ndarray, "20 5"]:
        """`RANGE` of each joint's angle over the fitted frames [deg]; NaN where there are none."""
        if not self.fitted.any():
            return np.full((self.angles.shape[1], len(RANGE)), np.nan)
        ranges: NDArray[np.float64] = np.percentile(self.angles[self.fitted], list(RANGE.values()), axis=0)
        return ranges.T

    def markers(self) -> list[MarkerFigures]:
        """What was seen of each marker, in the order of the glove."""
        seen = self.seen
        return [
            _marker_figures(name, seen[:, marker], self.residuals[:, marker], self.confidence[:, marker])
            for marker, name in enumerate(self.marker_names)
        ]


class MarkerFigures(NamedTuple):
    """What was seen of a marker; NaN where it was never seen, and without a pose."""

    name: str
    seen: float
    """Share of all frames in which it has a point."""
    num_gaps: int
    """How often it was lost and seen again."""
    longest_gap: int
    """Frames."""
    median_residual: float
    """Distance from the pose's marker [m]."""
    high_residual: float
    """The 95th percentile [m]."""
    median_confidence: float
    """Of its labels."""


def hand_figures(take: Take) -> tuple[HandFigures, ...]:
    """The figures of each hand of a take, simulated or tracked, in their order."""
    found = []
    for number, (hand, labels) in enumerate(zip(take.hands, take.hand_labels, strict=True)):
        there = take.status[:, number] != LOST
        angles = np.where(there[:, None], np.rad2deg(take.qpos[:, number, 7:]), np.nan)
        confidence = np.full((take.num_frames, len(labels)), np.nan)
        points = take.point_list
        own = (points.labels >= labels.start) & (points.labels < labels.stop)
        confidence[points.frames[own], points.labels[own] - labels.start] = points.confidence[own]
        residuals = np.full((take.num_frames, len(labels)), np.nan)
        observed, shown = take.observed(hand.side), np.flatnonzero(there)
        for first in range(0, len(shown), _CHUNK):
            part = shown[first : first + _CHUNK]
            expected, _ = hand.markers(take.qpos[part, number])
            residuals[part] = np.linalg.norm(observed[part] - expected, axis=2)
        spread = None if take.angle_spread is None else np.rad2deg(take.angle_spread[:, number])
        status, names = take.status[:, number], hand.layout.names
        found.append(HandFigures(hand.side, names, status, angles, spread, residuals, confidence))
    return tuple(found)


def _marker_figures(
    name: str,
    seen: Bool[np.ndarray, "T"],
    residuals: Float[np.ndarray, "T"],
    confidence: Float[np.ndarray, "T"],
) -> MarkerFigures:
    frames = np.flatnonzero(seen)
    gaps = np.diff(frames) - 1  # frames between one in which it is seen and the next
    known = residuals[np.isfinite(residuals)]
    median, high = np.percentile(known, (50.0, 95.0)) if len(known) else (np.nan, np.nan)
    return MarkerFigures(
        name,
        seen=float(seen.mean()),
        num_gaps=int((gaps > 0).sum()),
        longest_gap=int(gaps.max(initial=0)),
        median_residual=float(median),
        high_residual=float(high),
        median_confidence=float(np.median(confidence[frames])) if len(frames) else np.nan,
    )
