"""Frames of points, and what delivers them: a capture, or a source of the user's own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture, check_place, check_unit
from gloves.optics.reconstruction import number_runs
from track.frames import FARTHEST


@dataclass(frozen=True, slots=True, eq=False)
class StreamedFrame:
    """The points of one frame."""

    number: int
    """The server's number of the frame."""
    time: float
    """The server's time [s]."""
    points: Float[np.ndarray, "N 3"]
    """[m], in the server's axes."""
    ids: Int[np.ndarray, "N"]
    """The server's ID of each point, -1 where it gives none."""
    silent: bool = False
    """No frame arrived for a while: there are no points, and number and time are those of the last frame."""
    restarted: bool = False
    """The server's time began anew: it does not continue that of the frame before."""
    arrived: float = math.nan
    """Monotonic time of its arrival on this machine [s]; NaN where it did not come live."""


class FrameSource(Protocol):
    """Delivers the frames of a system of the user's own, for `handsim track --live module:name`.

    The points of a frame are in [m], times in [s]. It is iterated in a thread of its own, once; waiting for
    the next frame is its own affair, and so is an end: after the last frame the take is written. An exception
    ends the stream in the same way, and is told. One that delivers frames faster than their times go on is
    made to wait; of one that keeps their pace the oldest are dropped when they cannot be kept up with.
    """

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The frames in the order of their times."""
        ...

    def close(self) -> None:
        """No further frame is wanted; called once, from another thread, while a frame may be waited for."""
        ...


def capture_frames(capture: Capture) -> Iterator[StreamedFrame]:
    """The frames of a capture as of a stream: points [m], IDs and times [s].

    Marker files have no IDs. Every format that is read has one column per trajectory, so a column is an ID
    for as long as it has a point. After a gap it is a new ID, because a column of unlabeled points may
    continue with another marker. Column names are not used.
    """
    present = np.isfinite(capture.positions[..., 0])
    ids = number_runs(present)
    for number, (points, seen) in enumerate(zip(capture.positions, present, strict=True)):
        yield StreamedFrame(number, number / capture.rate, points[seen], ids[number, seen])


def checked_frames(capture: Capture) -> list[StreamedFrame]:
    """The frames of a capture, if their points can be hands' markers.

    Args:
        capture: Positions (T, N, 3) [m].

    Raises:
        ArgumentError: The capture is not in meters.
        CaptureError: Most of its points are far from any room.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    check_place(capture, FARTHEST)
    return frames
