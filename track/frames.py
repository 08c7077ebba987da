"""Frames of points: read from a capture, validated for the tracker, and tracked.

A bad frame does not stop a stream. Unusable points are left out, and a note says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture, check_place, check_unit
from gloves.captures.formats import READABLE, read_capture
from gloves.optics.reconstruction import number_runs
from gloves.takes.points import Status
from gloves.takes.take import Take, load_take
from handsim._checks import as_numbers, check_choice, shown_value
from handsim.errors import ArgumentError
from handsim.hand.shape import JOINT_NAMES, NUM_JOINTS, NUM_KEYPOINTS, Side
from track.config import TrackerConfig

AnyCapture = Capture | Take | str | Path
"""A capture; a take, of which only the points are used; or the path of one."""
FARTHEST: Final = 1e3
"""Largest coordinate of a point [m]; no capture volume is larger."""
LATEST_TIME: Final = 1e11
"""Largest time stamp [s]: beyond it doubles cannot resolve the time between frames."""
_USUAL_INTERVAL: Final = 1.0 / 120.0  # [s] assumed until a stream shows its own; usual for optical systems
_INTERVAL_SMOOTHING: Final = 0.1  # weight of the newest interval in the running mean
_SHORTEST_INTERVAL: Final = 0.1  # The tracker's clock advances by at least this share of the mean interval.
_LONGEST_INTERVAL: Final = 2.0  # Longer intervals enter the mean as this multiple of it.


@dataclass(frozen=True, slots=True, eq=False)
class StreamedFrame:
    """The points of one frame."""

    number: int
    """The server's frame number."""
    time: float
    """The server's time [s]."""
    points: Float[np.ndarray, "N 3"]
    """Positions [m] in the server's axes."""
    ids: Int[np.ndarray, "N"]
    """The server's ID of each point, -1 where it gives none."""
    silent: bool = False
    """Whether no frame has arrived for a while: no points, the last frame's number, and the current time."""
    restarted: bool = False
    """Whether the server's time began anew and does not continue that of the frame before."""
    arrived: float = math.nan
    """Monotonic time of its arrival on this machine [s]; NaN if it is not live."""
    latency: float = math.nan
    """Time from the middle of its exposure to its sending [s]; NaN if the source does not give it."""


def capture_of(capture: AnyCapture) -> Capture:
    """The points of a capture or a take, without labels."""
    if isinstance(capture, str | Path):
        capture = read_points(capture)
    if not isinstance(capture, Capture | Take):
        endings = ", ".join((*READABLE, ".npz"))
        made = "; Capture(names, positions, rate) makes one of positions (T, N, 3) in meters"
        raise ArgumentError(
            f"capture is {shown_value(capture)}, expected a Capture, a Take, or the path of a file "
            f"({endings}){made if isinstance(capture, np.ndarray) else ''}"
        )
    return capture if isinstance(capture, Capture) else capture.capture()


def read_points(path: str | Path) -> Capture | Take:
    """The capture or take of a file."""
    if str(path).lower().endswith((".npz", ".npz.part")):
        return load_take(path)
    return read_capture(path)


def capture_frames(capture: Capture) -> Iterator[StreamedFrame]:
    """The frames of a capture as those of a stream: points [m], IDs and times [s].

    Marker files have no IDs. Every supported format has one column per trajectory, so a column is an ID until
    its point disappears. After a gap it is a new ID, because a column of unlabeled points may go on with
    another marker. Column names are not used.
    """
    present = np.isfinite(capture.positions[..., 0])
    ids = number_runs(present)
    for number, (points, seen) in enumerate(zip(capture.positions, present, strict=True)):
        yield StreamedFrame(number, number / capture.rate, points[seen], ids[number, seen])


def checked_frames(capture: Capture) -> list[StreamedFrame]:
    """The frames of a capture, after checking unit and place of its points."""
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    check_place(capture, FARTHEST)
    return frames


class IncomingFrame(NamedTuple):
    """A frame as the tracker uses it."""

    points: Float[np.ndarray, "P 3"]
    """Points [m], all of them finite."""
    ids: Int[np.ndarray, "P"]
    """Their IDs; -1 where there is none or several points share one."""
    kept: Int[np.ndarray, "P"]
    """Indices of these points in the original frame."""
    num_points: int
    """Number of points in the original frame."""
    stamp: float
    """Original time stamp of the frame [s]."""
    time: float
    """Time on a clock that only goes forward [s]."""
    notes: tuple[str, ...]
    """What was wrong with the frame, in words."""


class FrameValidator:
    """Validates the frames of one stream; a longer `silence` without a frame is noted [s]."""

    def __init__(self, silence: float = TrackerConfig.silence) -> None:
        self._silence = silence
        self._last = np.nan
        self._clock = 0.0
        self._interval = _USUAL_INTERVAL

    def check_frame(
        self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"] | None, time: float | None
    ) -> IncomingFrame:
        """Validate the next frame; an ID is -1 where there is none, and `ids` may be None."""
        points = as_numbers("points", points)
        ids = np.full(points.shape[:1], -1) if ids is None else as_numbers("ids", ids, np.int64)
        if ids.ndim != 1 or points.shape != (len(ids), 3):
            count = ids.size
            raise ArgumentError(f"points have shape {points.shape}, expected ({count}, 3) for {count} IDs")
        if not isinstance(time, int | float | np.integer | np.floating):
            raise ArgumentError(f"time is {shown_value(time)}, expected the time of the frame in seconds")
        stamp = float(time)
        notes = self._tick(stamp)
        with np.errstate(invalid="ignore"):
            usable = np.abs(points).max(axis=1, initial=0.0) < FARTHEST  # NaN compares as false
        if not usable.all():
            notes.append(f"{np.sum(~usable)} of {len(points)} points have no position within 1 km: left out")
        kept = np.flatnonzero(usable)
        num_points, points, ids = len(points), points[kept], ids[kept]
        known = [number for number in ids.tolist() if number >= 0]
        if len(set(known)) < len(known):
            several = sorted({number for number in known if known.count(number) > 1})
            notes.append(f"IDs of several points at once: {', '.join(map(str, several[:5]))}")
            ids = np.where(np.isin(ids, several), -1, ids)
        return IncomingFrame(points, np.maximum(ids, -1), kept, num_points, stamp, self._clock, tuple(notes))

    def _tick(self, time: float) -> list[str]:
        """Advance the clock; return notes on what was wrong with the time stamp."""
        span, is_usable = time - self._last, abs(time) < LATEST_TIME
        if is_usable:
            self._last = time
        if not is_usable or not span > 0.0:  # NaN for the first frame
            self._clock += self._interval
            if not is_usable:
                return [f"the time is {time:g} s" if np.isfinite(time) else "the time is not a number"]
            back = f"the time went back by {-span:.3g} s" if span else "the time stood still"
            return [] if np.isnan(span) else [back]
        # Time stamps jitter, and velocities are divided by their differences.
        self._clock += max(span, _SHORTEST_INTERVAL * self._interval)
        if span > self._silence:
            return [f"no frame for {span:.3g} s"]
        newest = min(span, _LONGEST_INTERVAL * self._interval)
        self._interval += _INTERVAL_SMOOTHING * (newest - self._interval)
        return []


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
    """RMS distance of the labeled markers from the pose's, biases included [m]; NaN without a fit."""
    markers: Float[np.ndarray, "M 3"]
    """The labeled markers [m], those of the pose where one is missing; NaN where the hand is lost."""
    filled: Int[np.ndarray, "F"]
    """Indices of the markers that are filled in from the pose."""
    find_spreads: Callable[[], Spreads] = field(default=_unknown_spreads, repr=False)
    """Computes the standard deviations when they are first read, as a frame has little time."""
    velocity: Float[np.ndarray, "26"] = field(default_factory=lambda: np.full(26, np.nan))
    """Velocity of the wrist [m/s], its angular velocity in its own frame and that of each joint [rad/s];
    NaN where the hand is not tracked."""

    @property
    def angle_spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each joint angle [rad]; NaN where it is unknown or the hand is lost."""
        return self._spreads[0]

    @property
    def keypoint_spread(self) -> Float[np.ndarray, "21"]:
        """Standard deviation of each keypoint in each direction [m]; NaN as for the angles."""
        return self._spreads[1]

    @cached_property
    def _spreads(self) -> Spreads:
        return self.find_spreads()

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return self.status is not Status.LOST

    @property
    def seen_markers(self) -> Float[np.ndarray, "M 3"]:
        """The labeled markers [m]; NaN where a marker has no point."""
        markers = self.markers.copy()
        markers[self.filled] = np.nan
        return markers

    @property
    def angles(self) -> dict[str, float]:
        """The angle of each joint by its name [rad]; NaN where the hand is lost."""
        return dict(zip(JOINT_NAMES, self.qpos[7:].tolist(), strict=True))

    @property
    def angle_velocities(self) -> dict[str, float]:
        """The angular velocity of each joint by its name [rad/s]; NaN where the hand is not tracked."""
        return dict(zip(JOINT_NAMES, self.velocity[6:].tolist(), strict=True))


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
    """Index of each point's marker, counted through all hands in order, then all bodies; -1 for none."""
    confidence: Float[np.ndarray, "N"]
    """Confidence in each label, 0 to 1."""
    bodies: tuple[TrackedBody, ...] = ()
    notes: tuple[str, ...] = ()
    """What was wrong with the frame itself, in words; empty for most frames."""
    seconds: float = np.nan
    """Computing time of the tracker [s]; NaN where it was not measured."""
    size_state: str = ""
    """Why the size of a live stream's hands is not known yet; empty when it is known or was given."""

    def hand(self, side: Side) -> TrackedHand:
        """The hand of a side; an `ArgumentError` if none of that side is tracked."""
        sides = [hand.side for hand in self.hands]
        check_choice(side, sides, noun="hand")
        return self.hands[sides.index(side)]
