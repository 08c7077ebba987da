"""Checks of what a stream brings, before anything relies on it: points, IDs and the time of a frame.

A bad frame does not stop a stream. What cannot be used is left out, and a note says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from handsim.errors import ArgumentError
from track.config import IntakeConfig


class IncomingFrame(NamedTuple):
    """A frame as the tracker uses it."""

    points: Float[np.ndarray, "P 3"]
    """Points [m], all of them finite."""
    ids: Int[np.ndarray, "P"]
    """Their IDs; -1 where a point has none of its own."""
    kept: Int[np.ndarray, "P"]
    """Indices of these points in the frame as it came."""
    time: float
    """Time on a clock that only goes forward [s]."""
    notes: tuple[str, ...]
    """What was wrong with the frame, in words."""


class Intake:
    """Checks the frames of one stream.

    Args:
        config: Bounds, and the usual interval between frames.
    """

    def __init__(self, config: IntakeConfig = IntakeConfig()) -> None:  # noqa: B008 (frozen)
        self._config = config
        self._last = np.nan
        self._clock = 0.0
        self._interval = config.usual_interval

    def take(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> IncomingFrame:
        """Check the next frame.

        Args:
            points: Points [m].
            ids: Their IDs; -1 where there is none.
            time: Time stamp of the frame [s].

        Raises:
            ArgumentError: `points` and `ids` do not fit together, which is the caller's mistake, not the
                stream's.
        """
        points, ids = np.asarray(points, dtype=np.float64), np.asarray(ids, dtype=np.int64)
        if points.shape != (len(ids), 3):
            raise ArgumentError(
                f"points have shape {points.shape}, expected ({len(ids)}, 3) for {len(ids)} IDs"
            )
        notes = self._tick(float(time))
        with np.errstate(invalid="ignore"):
            usable = np.abs(points).max(axis=1, initial=0.0) < self._config.farthest  # which NaN is not
        if not usable.all():
            notes.append(f"{np.sum(~usable)} of {len(points)} points are nowhere and left out")
        kept = np.flatnonzero(usable)
        points, ids = points[kept], ids[kept]
        known = [number for number in ids.tolist() if number >= 0]
        if len(set(known)) < len(known):
            several = sorted({number for number in known if known.count(number) > 1})
            notes.append(f"IDs of several points at once: {', '.join(map(str, several[:5]))}")
            ids = np.where(np.isin(ids, several), -1, ids)
        return IncomingFrame(points, np.maximum(ids, -1), kept, self._clock, tuple(notes))

    def _tick(self, time: float) -> list[str]:
        """Advance the clock; return notes on what was wrong with the time stamp."""
        span = time - self._last
        if abs(time) < self._config.latest_time:
            self._last = time
        else:
            self._clock += self._interval
            return [f"the time is {time:g} s" if np.isfinite(time) else "the time is not a number"]
        if np.isnan(span):  # the first frame
            self._clock += self._interval
            return []
        if span <= 0.0:
            self._clock += self._interval
            return [f"the time went back by {-span:.3g} s" if span else "the time stood still"]
        # Time stamps jitter, and velocities are divided by their differences.
        self._clock += max(span, self._config.shortest_interval * self._interval)
        if span > self._config.silence:
            return [f"no frame for {span:.3g} s"]
        newest = min(span, self._config.longest_interval * self._interval)
        self._interval += self._config.interval_smoothing * (newest - self._interval)
        return []
