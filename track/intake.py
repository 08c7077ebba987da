"""What comes in is looked over before anybody relies on it: points, IDs and the time of a frame.

A stream is not stopped for a bad frame. What cannot be used is left out, and a note says so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.errors import ArgumentError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_FARTHEST: Final = 1e3  # [m] beyond which there is no room
_USUAL_INTERVAL: Final = 1.0 / 120.0  # [s] until a stream has shown its own
_SILENCE: Final = 0.25  # [s] without a frame that is told
_EASE: Final = 0.1  # share of the newest interval in the usual one
_SHORTEST, _LONGEST = 0.1, 2.0  # of the usual interval: between two frames on the clock; of one that counts
_LATEST: Final = 1e11  # [s] beyond which there is no time: a clock of doubles would stand still


class Incoming(NamedTuple):
    """A frame as the tracker uses it."""

    points: Float[np.ndarray, "P 3"]
    """[m], all of them finite."""
    ids: Int[np.ndarray, "P"]
    """-1 where a point has none of its own."""
    kept: Int[np.ndarray, "P"]
    """Which points of the frame these are."""
    time: float
    """On a clock that only goes forward [s]."""
    notes: tuple[str, ...]


class Intake:
    """Looks over the frames of one stream."""

    def __init__(self) -> None:
        self._last = np.nan
        self._clock = 0.0
        self._interval = _USUAL_INTERVAL

    def take(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> Incoming:
        """The next frame.

        Raises:
            ArgumentError: `points` and `ids` do not fit together: the caller's mistake, not the stream's.
        """
        points, ids = np.asarray(points, dtype=np.float64), np.asarray(ids, dtype=np.int64)
        if points.shape != (len(ids), 3):
            raise ArgumentError(
                f"points have shape {points.shape}, expected ({len(ids)}, 3) for {len(ids)} IDs"
            )
        notes = self._tick(float(time))
        with np.errstate(invalid="ignore"):
            usable = np.abs(points).max(axis=1, initial=0.0) < _FARTHEST  # which NaN is not
        if not usable.all():
            notes.append(f"{np.sum(~usable)} of {len(points)} points are nowhere and left out")
        kept = np.flatnonzero(usable)
        points, ids = points[kept], ids[kept]
        known = [number for number in ids.tolist() if number >= 0]
        if len(set(known)) < len(known):
            several = sorted({number for number in known if known.count(number) > 1})
            notes.append(f"IDs of several points at once: {', '.join(map(str, several[:5]))}")
            ids = np.where(np.isin(ids, several), -1, ids)
        return Incoming(points, np.maximum(ids, -1), kept, self._clock, tuple(notes))

    def _tick(self, time: float) -> list[str]:
        """Move the clock on; what was odd about the time."""
        span = time - self._last
        if abs(time) < _LATEST:
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
        # Stamps shake; what moved is divided by the time that it took.
        self._clock += max(span, _SHORTEST * self._interval)
        if span > _SILENCE:
            return [f"no frame for {span:.3g} s"]
        self._interval += _EASE * (min(span, _LONGEST * self._interval) - self._interval)
        return []
