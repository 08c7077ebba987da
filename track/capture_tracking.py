"""Tracking of a whole capture or stream, frame by frame, and its result as a take.

Marker files have no IDs. Every format that is read has one column per trajectory,
so a column is an ID for as long as it has a point. After a gap it is a new ID, because a column of
unlabeled points may continue with another marker. Column names are not used.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.captures.plausibility import check_place, check_unit
from gloves.fit import GloveFit
from gloves.optics.identities import number_runs
from gloves.takes.take import STATUSES, Take
from handsim.errors import CaptureError
from handsim.hand.topology import NUM_QPOS
from track.intake import FARTHEST
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import Status, TrackedFrame
from track.tracker import Tracker
from train.labelers.protocol import Labeler

Progress = Callable[[int, int], None]
Taken = Callable[[StreamedFrame, TrackedFrame], None]

_LOOP_GAP: Final = 0.01
"""Time between the last frame of a recording and its first, when it starts again [s]."""
_HAND_SPACING: Final = 0.5  # [m] between the hands of the warm-up
_UNSURE_EXTENT: Final = 0.12  # of clouds that no labeler is sure of [m]
_NUMBERS: Final = {status: STATUSES.index(status.value) for status in Status}


def track_capture(
    capture: Capture, tracker: Tracker, *, progress: Progress | None = None, taken: Taken | None = None
) -> Take:
    """Track a capture.

    Args:
        capture: Positions (T, N, 3) [m]; marker names are not used.
        tracker: A tracker that has not seen a frame.
        progress: Called after each frame with the number of tracked frames and of all frames.
        taken: Called with each frame, its time in [s], and what the tracker made of it.

    Returns:
        Poses (T, H, 27) [m, rad], labels (T, N) and status of every frame.

    Raises:
        ArgumentError: The capture is not in meters.
        CaptureError: Most of its points are far from any room.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    check_place(capture, FARTHEST)
    recorder = TakeRecorder(tracker)
    for frame, tracked in track_stream(frames, tracker):
        if taken is not None:
            taken(frame, tracked)
        recorder.add(frame, tracked)
        if progress is not None:
            progress(recorder.num_frames, len(frames))
    return recorder.take(capture)


def capture_frames(capture: Capture) -> Iterator[StreamedFrame]:
    """The frames of a capture as of a stream: points [m], IDs and times [s]."""
    present = np.isfinite(capture.positions[..., 0])
    ids = number_runs(present)
    for number, (points, seen) in enumerate(zip(capture.positions, present, strict=True)):
        yield StreamedFrame(number, number / capture.rate, points[seen], ids[number, seen])


def track_stream(
    frames: Iterable[StreamedFrame], tracker: Tracker
) -> Iterator[tuple[StreamedFrame, TrackedFrame]]:
    """Track frames as they arrive, also from a live stream.

    During a silence of the stream the tracker gets frames without points, at the time that has passed. When
    the stream's time begins anew, as in a recording that starts again, the tracker's time continues.

    Args:
        frames: Frames in order of arrival, points in [m].
        tracker: The tracker.

    Yields:
        Each frame with the tracker's time [s], and the tracked frame.
    """
    ahead, last = 0.0, -np.inf
    heard = time.monotonic()
    for frame in frames:
        now = frame.time + ahead
        if frame.silent:
            now += time.monotonic() - heard
        else:
            waited, heard = time.monotonic() - heard, time.monotonic()
            if now <= last or frame.restarted:
                begin = last + max(_LOOP_GAP, waited) if last > -np.inf else 0.0
                ahead += begin - now
                now = begin
            last = now
        yield dataclasses.replace(frame, time=now), tracker.step(frame.points, frame.ids, now)


def warm_up(hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Load the tracker's kernels, which the first run on a machine compiles for half a minute.

    Otherwise the first frames of a stream would have to wait.

    Args:
        hands: The user's hands.
        labeler: Labeler of their glove.
    """
    tracker = Tracker(hands, labeler)
    qpos = np.zeros((len(hands), NUM_QPOS))
    qpos[:, 0], qpos[:, 3] = _HAND_SPACING * np.arange(len(hands)), 1.0
    points = np.concatenate(
        [
            hand.attachment.centers(hand.model, hand.model.forward_kinematics(row[None]))[0]
            for hand, row in zip(hands, qpos, strict=True)
        ]
    )
    for number in range(3):  # initialized, tracked, and labeled again
        ids = np.arange(len(points)) + (number == 2) * len(points) * (np.arange(len(points)) % 4 == 0)
        tracker.step(points, ids, 0.01 * number)
    unsure = np.random.default_rng(0).uniform(0.0, _UNSURE_EXTENT, (4, len(points) // len(hands), 3))
    for cloud in unsure:  # labels that a pose has to verify
        labeler.label_frames([cloud])


class TakeRecorder:
    """Records tracked frames; `take` gives the take so far at any time.

    Args:
        tracker: The tracker, for its hands and bodies.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._hands = tracker.hands
        self._config = tracker.config
        self._bodies = tracker.bodies
        self._rows: list[dict[str, NDArray[Any]]] = []

    @property
    def num_frames(self) -> int:
        """Number of recorded frames."""
        return len(self._rows)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return float(self._rows[-1]["times"] - self._rows[0]["times"]) if self._rows else 0.0

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Record a frame, unless it stands for a silence of the stream."""
        if not frame.silent:
            self._rows.append(frame_values(frame, tracked))

    def take(self, capture: Capture | None = None) -> Take:
        """The take so far.

        Args:
            capture: The capture of these frames, whose columns and rate are kept; None for a stream, whose
                rate is the median one.

        Raises:
            CaptureError: There are too few frames to determine the rate of a stream.
        """
        rows = self._rows
        if not rows or (capture is None and len(rows) < 2):
            raise CaptureError(f"{len(rows)} frames came, expected two or more")
        settings = {"tracker": dataclasses.asdict(self._config)}
        return Take.of_frames(rows, self._hands, self._bodies, capture=capture, settings=settings)


def frame_values(frame: StreamedFrame, tracked: TrackedFrame) -> dict[str, NDArray[Any]]:
    """A frame's entries of the arrays of a take, by their names; those of points for its N points."""
    hands, bodies = tracked.hands, tracked.bodies
    poses = [np.concatenate([body.translation, body.rotation]) for body in bodies]
    return {
        "times": np.array(frame.time),
        "numbers": np.array(frame.number),
        "qpos": np.array([hand.qpos for hand in hands]),
        "status": np.array([_NUMBERS[hand.status] for hand in hands], dtype=np.int8),
        "rms": np.array([hand.rms for hand in hands]),
        "body_poses": np.array(poses).reshape(len(bodies), 7),
        "body_status": np.array([_NUMBERS[body.status] for body in bodies], dtype=np.int8),
        "body_rms": np.array([body.rms for body in bodies], dtype=np.float64),
        "points": frame.points,
        "ids": frame.ids.astype(np.int32),
        "labels": tracked.labels.astype(np.int16),
        "confidence": tracked.confidence,
    }
