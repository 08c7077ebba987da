"""Tracking of a whole capture or stream, frame by frame, and its result as a tracked take.

Marker files have no IDs. Every format that is read (.trc, .c3d, Motive's .csv) has one column per trajectory,
so a column is an ID for as long as it has a point. After a gap it is a new ID, because a column of
unlabeled points may continue with another marker. Column names are not used.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gloves.captures.capture import Capture
from gloves.captures.plausibility import check_place, check_unit
from gloves.fit import GloveFit
from gloves.optics.identities import number_runs
from gloves.takes.tracked_take import LOST, STATUSES, TrackedTake
from handsim.errors import CaptureError
from handsim.hand.topology import NUM_QPOS
from track.streams.point_stream import StreamedFrame
from track.tracked_frame import Status, TrackedFrame
from track.tracker import Tracker
from train.labelers.protocol import Labeler

if TYPE_CHECKING:
    from jaxtyping import Bool
    from numpy.typing import NDArray

    Progress = Callable[[int, int], None]

_LOOP_GAP: Final = 0.01
"""Time between the last frame of a recording and its first, when it starts again [s]."""
_HAND_SPACING: Final = 0.5  # [m] between the hands of the warm-up
_NUMBERS: Final = {status: STATUSES.index(status.value) for status in Status}


def track_capture(capture: Capture, tracker: Tracker, *, progress: Progress | None = None) -> TrackedTake:
    """Track a capture.

    Args:
        capture: Positions (T, N, 3) [m]; marker names are not used.
        tracker: A tracker that has not seen a frame.
        progress: Called after each frame with the number of tracked frames and of all frames.

    Returns:
        Poses (T, H, 27) [m, rad], labels (T, N) and status of every frame.

    Raises:
        ArgumentError: The capture is not in meters.
        CaptureError: Most of its points are far from any room.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    check_place(capture, tracker.config.intake.farthest)
    recorder = TakeRecorder(tracker)
    for frame, tracked in track_stream(frames, tracker):
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
    the stream's time runs back, as in a recording that starts again, the tracker's time continues.

    Args:
        frames: Frames in order of arrival.
        tracker: The tracker.

    Yields:
        Each frame with the tracker's time, and the tracked frame.
    """
    ahead, last = 0.0, -np.inf
    heard = time.monotonic()
    for frame in frames:
        now = frame.time + ahead
        if frame.silent:
            now += time.monotonic() - heard
        else:
            heard = time.monotonic()
            if now <= last:
                ahead += last - now + _LOOP_GAP
                now = last + _LOOP_GAP
            last = now
        timed = StreamedFrame(frame.number, now, frame.points, frame.ids, frame.silent)
        yield timed, tracker.step(frame.points, frame.ids, now)


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


class TakeRecorder:
    """Records tracked frames; `take` gives the take so far at any time.

    Args:
        tracker: The tracker, for its hands and bodies.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._hands = tracker.hands
        self._config = tracker.config
        self._bodies = tracker.bodies
        self._frames: list[tuple[StreamedFrame, TrackedFrame]] = []

    @property
    def num_frames(self) -> int:
        """Number of recorded frames."""
        return len(self._frames)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._frames[-1][0].time - self._frames[0][0].time if self._frames else 0.0

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Record a frame, unless it stands for a silence of the stream."""
        if not frame.silent:
            self._frames.append((frame, tracked))

    def take(self, capture: Capture | None = None) -> TrackedTake:
        """The tracked take so far.

        Args:
            capture: The capture of these frames, whose columns and rate are kept; None for a stream, whose
                rate is the median one.

        Raises:
            CaptureError: There are too few frames to determine the rate of a stream.
        """
        frames = [frame for frame, _ in self._frames]
        tracked = [one for _, one in self._frames]
        if not frames or (capture is None and len(frames) < 2):
            raise CaptureError(f"{len(frames)} frames came, expected two or more")
        times = np.array([frame.time for frame in frames])
        counts = np.array([len(frame.points) for frame in frames])
        present = np.arange(counts.max(initial=0)) < counts[:, None]
        if capture is not None:
            present = np.isfinite(capture.positions[: len(frames), :, 0])
        hands = [one.hands for one in tracked]
        filled = np.zeros((len(frames), len(self._hands), hands[0][0].markers.shape[0]), dtype=bool)
        for number, row in enumerate(hands):
            for index, hand in enumerate(row):
                filled[number, index, hand.filled] = True
        return TrackedTake(
            rate=1.0 / float(np.median(np.diff(times))) if capture is None else capture.rate,
            times=times,
            hands=self._hands,
            qpos=np.array([[hand.qpos for hand in row] for row in hands]),
            status=np.array([[_NUMBERS[hand.status] for hand in row] for row in hands], dtype=np.int8),
            rms=np.array([[hand.rms for hand in row] for row in hands]),
            markers=np.array([[hand.markers for hand in row] for row in hands]),
            filled=filled,
            points=_spread(present, [frame.points for frame in frames], np.nan),
            ids=_spread(present, [frame.ids for frame in frames], -1).astype(np.int32),
            labels=_spread(present, [one.labels for one in tracked], -1).astype(np.int16),
            confidence=_spread(present, [one.confidence for one in tracked], np.nan),
            **self._body_tracks(tracked),
            settings={"tracker": dataclasses.asdict(self._config)},
        )

    def _body_tracks(self, tracked: Sequence[TrackedFrame]) -> dict[str, Any]:
        shape = len(tracked), len(self._bodies)
        poses, rms = np.full((*shape, 7), np.nan), np.full(shape, np.nan)
        status = np.full(shape, LOST, dtype=np.int8)
        for number, frame in enumerate(tracked):
            for index, body in enumerate(frame.bodies):
                poses[number, index] = np.concatenate([body.translation, body.rotation])
                status[number, index], rms[number, index] = _NUMBERS[body.status], body.rms
        return {"bodies": self._bodies, "body_poses": poses, "body_status": status, "body_rms": rms}


def _spread(present: Bool[np.ndarray, "T N"], rows: list[NDArray[Any]], missing: float) -> NDArray[Any]:
    """A table (T, N, ...) of the values of all frames' points, each in its column; `missing` elsewhere."""
    values = np.concatenate(rows)
    table = np.full(present.shape + values.shape[1:], missing, dtype=values.dtype)
    table[present] = values
    return table
