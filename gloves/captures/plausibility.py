"""What the positions of a capture tell about mistakes in its file: a wrong unit or place, zeros for gaps."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from handsim.kernels import kernel, squared_distance

MAX_SPAN: Final = 30.0
"""Largest median span of clouds that are in meters [m]; a hand in millimeters would span more."""
AT_ORIGIN: Final = "all points are at the origin, (0, 0, 0)"
"""What is wrong with such clouds."""
_MIN_SPAN: Final = 0.02  # [m]: smallest median span; a fist with five markers spans three times as much
_MAX_SPACING: Final = 1.5  # [m]: largest median distance of a point from the nearest other one
_MIN_POINTS: Final = 5  # from which a cloud shows its unit; fewer points may all be strays
_MIN_FRAMES: Final = 10  # from which small or wide clouds count; a few frames may show strays alone
_SAMPLED: Final = 200  # frames that are looked at, evenly spread


class UnitFault(NamedTuple):
    """Clouds in a wrong unit."""

    found: str
    """What is wrong with them as meters."""
    guess: str
    """The unit of length that they probably had before they were scaled."""

    @property
    def hint(self) -> str:
        """The guess as a question about positions that should be in meters."""
        return "; scaled twice?" if self.guess == "meters" else f"; {self.guess}?"


def spacing(cloud: Float[np.ndarray, "N 3"]) -> float:
    """Median distance of a point from its nearest neighbor [m], of two points or more."""
    return float(np.median(np.sqrt(_nearest_squared(np.ascontiguousarray(cloud, dtype=np.float64)))))


def unit_fault(clouds: Sequence[Float[np.ndarray, "N 3"]], *, only_wide: bool = False) -> UnitFault | None:
    """What tells that clouds are not in meters, if anything does.

    Medians over the frames decide, since strays of a real system lie anywhere.

    Args:
        only_wide: Ask only whether they span more than a room, since they may be parts of one frame.
    """
    shown = [cloud for cloud in clouds if len(cloud) >= _MIN_POINTS]
    step = -(-len(shown) // _SAMPLED) or 1
    shown = shown[::step]
    if not shown:
        return None
    spans = [float((cloud.max(axis=0) - cloud.min(axis=0)).max()) for cloud in shown]
    span = max(spans)
    if span > MAX_SPAN:  # the median costs more than all else here
        span = float(np.median(spans))
    if span > MAX_SPAN:
        return UnitFault(f"the points of a frame span {span:.0f} m", "millimeters")
    if only_wide or len(shown) < _MIN_FRAMES:
        return None
    span = float(np.median(spans))
    if span < _MIN_SPAN:
        return UnitFault(f"the points of a frame span {1e3 * span:.2g} mm", "meters")
    apart = float(np.median([spacing(cloud) for cloud in shown]))
    if apart > _MAX_SPACING:
        return UnitFault(f"the points of a frame are {apart:.2g} m apart", "centimeters")
    return None


@kernel
def _nearest_squared(cloud: Float[np.ndarray, "N 3"]) -> NDArray[np.float64]:
    """Squared distance (N,) of each point from the nearest other one [m^2]."""
    nearest = np.full(len(cloud), np.inf)
    for i in range(len(cloud)):
        for j in range(i):
            squared = squared_distance(cloud[i], cloud[j])
            nearest[i] = min(nearest[i], squared)
            nearest[j] = min(nearest[j], squared)
    return nearest


def all_at_origin(clouds: Sequence[Float[np.ndarray, "N 3"]]) -> bool:
    """Whether there are several points, and each of them is at exactly (0, 0, 0)."""
    return sum(map(len, clouds)) > 1 and not any(cloud.any() for cloud in clouds)


def check_unit(clouds: Sequence[Float[np.ndarray, "N 3"]], *, only_wide: bool = False) -> None:
    """Refuse clouds that are not in meters, see `unit_fault`."""
    if not only_wide and all_at_origin(clouds):
        raise ArgumentError(f"{AT_ORIGIN}, expected positions in meters")
    fault = unit_fault(clouds, only_wide=only_wide)
    if fault is not None:
        raise ArgumentError(f"{fault.found}, expected a hand in meters{fault.hint}")


def zeros_as_missing(capture: Capture) -> tuple[Capture, int]:
    """A capture whose points at exactly (0, 0, 0) are missing, and how many they were.

    Some programs write zeros for what was not seen. A measured point is never exactly there twice; a capture
    in which nothing moves is left as it is.
    """
    positions = capture.positions
    zero = (positions == 0.0).all(axis=-1)
    count = int(zero.sum())
    if count < 2 or not _moves(positions, np.isfinite(positions[..., 0]) & ~zero):
        return capture, 0
    return dataclasses.replace(capture, positions=np.where(zero[..., None], np.nan, positions)), count


def check_place(capture: Capture, farthest: float) -> None:
    """Warn of points that will be left out, farther than this from the origin in a coordinate [m]."""
    there = np.isfinite(capture.positions[..., 0])
    far = int((np.abs(capture.positions[there]).max(axis=-1, initial=0.0) >= farthest).sum())
    points = int(there.sum())
    if far > points / 2:
        raise CaptureError(
            f"{far} of {points} points lie {farthest:.0f} m or more from the origin, expected hands in a "
            "room; move the origin of the capture into the room"
        )
    if far:
        warnings.warn(
            f"{far} of {points} points lie {farthest:.0f} m or more from the origin and are left out",
            HandSimWarning,
            stacklevel=2,
        )


def _moves(positions: Float[np.ndarray, "T N 3"], there: Bool[np.ndarray, "T N"]) -> bool:
    """Whether any trajectory takes more than one position."""
    for column in range(positions.shape[1]):
        track = positions[there[:, column], column]
        if len(track) and (track != track[0]).any():
            return True
    return False
