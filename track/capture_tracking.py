"""A tracker led through a capture or a live stream, frame by frame, and what comes of it as a take.

Files say nothing of IDs. Every format that is read (.trc, .c3d, Motive's .csv) keeps a trajectory a column,
so a column is an ID for as long as it has a point; after a gap it is another one, because columns of
unlabeled points may go on with somebody else. Column names are not used.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gloves.captures.capture import Capture
from gloves.fit import GloveFit
from gloves.optics.identities import number_runs
from gloves.takes.tracked_take import LOST, STATUSES, MarkedBody, TrackedTake
from handsim.errors import CaptureError
from handsim.hand.topology import NUM_QPOS
from track.streams.point_stream import StreamedFrame
from track.tracked_frame import Status, TrackedFrame
from track.tracker import Tracker
from train.labelers.protocol import Labeler, check_unit

if TYPE_CHECKING:
    from jaxtyping import Bool
    from numpy.typing import NDArray

    Progress = Callable[[int, int], None]

_RESTART: Final = 0.01
"""Time between the last frame of a recording and its first, when it begins anew [s]."""
_APART: Final = 0.5  # [m] between hands that are tried out
_NUMBERS: Final = {status: STATUSES.index(status.value) for status in Status}


def track(capture: Capture, tracker: Tracker, *, progress: Progress | None = None) -> TrackedTake:
    """Lead a tracker through a capture.

    Args:
        capture: What was seen; its names are not used.
        tracker: A tracker that has seen nothing yet.
        progress: Called after each frame with how many are done and how many there are.

    Raises:
        ArgumentError: The capture is not in meters.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    recorder = TakeRecorder(tracker)
    for frame, tracked in follow(frames, tracker):
        recorder.add(frame, tracked)
        if progress is not None:
            progress(recorder.num_frames, len(frames))
    return recorder.take(capture)


def capture_frames(capture: Capture) -> Iterator[StreamedFrame]:
    """The frames of a capture as a stream would bring them."""
    there = np.isfinite(capture.positions[..., 0])
    ids = number_runs(there)
    for number, (points, seen) in enumerate(zip(capture.positions, there, strict=True)):
        yield StreamedFrame(number, number / capture.rate, points[seen], ids[number, seen])


def follow(frames: Iterable[StreamedFrame], tracker: Tracker) -> Iterator[tuple[StreamedFrame, TrackedFrame]]:
    """Lead a tracker through frames as they come, live ones too.

    After a silence of a stream the tracker is told that there are no points, at the time that has gone by
    since. A stream whose time runs back, as that of a recording which begins anew, goes on where it was.

    Yields:
        Each frame, with the time that the tracker was told, and what the tracker made of it.
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
                ahead += last - now + _RESTART
                now = last + _RESTART
            last = now
        told = StreamedFrame(frame.number, now, frame.points, frame.ids, frame.silent)
        yield told, tracker.step(frame.points, frame.ids, now)


def warm_up(hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Make ready what a tracker needs: on a machine's first run its kernels are compiled, for half a minute.

    Without it the first frames of a stream would wait for that.
    """
    tracker = Tracker(hands, labeler)
    qpos = np.zeros((len(hands), NUM_QPOS))
    qpos[:, 0], qpos[:, 3] = _APART * np.arange(len(hands)), 1.0
    points = np.concatenate(
        [
            hand.attachment.centers(hand.model, hand.model.forward_kinematics(row[None]))[0]
            for hand, row in zip(hands, qpos, strict=True)
        ]
    )
    for number in range(3):  # found, followed, and named anew
        ids = np.arange(len(points)) + (number == 2) * len(points) * (np.arange(len(points)) % 4 == 0)
        tracker.step(points, ids, 0.01 * number)


class TakeRecorder:
    """Keeps what a tracker said, frame by frame; `take` may be asked for at any time.

    Args:
        tracker: Whose hands and bodies these are.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._hands = tracker.hands
        self._config = tracker.config
        self._bodies = tuple(MarkedBody(body.name, body.marker_names, body.places) for body in tracker.bodies)
        self._frames: list[tuple[StreamedFrame, TrackedFrame]] = []

    @property
    def num_frames(self) -> int:
        """How many frames there are by now."""
        return len(self._frames)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._frames[-1][0].time - self._frames[0][0].time if self._frames else 0.0

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Keep a frame; a silence is none."""
        if not frame.silent:
            self._frames.append((frame, tracked))

    def take(self, capture: Capture | None = None) -> TrackedTake:
        """What there is so far.

        Args:
            capture: Whose frames these are: its columns are kept. A stream has none, and its rate is the
                usual one.

        Raises:
            CaptureError: There are too few frames to tell the rate of a stream.
        """
        frames = [frame for frame, _ in self._frames]
        tracked = [one for _, one in self._frames]
        if not frames or (capture is None and len(frames) < 2):
            raise CaptureError(f"{len(frames)} frames came, expected two or more")
        times = np.array([frame.time for frame in frames])
        counts = np.array([len(frame.points) for frame in frames])
        there = np.arange(counts.max(initial=0)) < counts[:, None]
        if capture is not None:
            there = np.isfinite(capture.positions[: len(frames), :, 0])
        hands = [one.hands for one in tracked]
        filled = np.zeros((len(frames), len(self._hands), hands[0][0].markers.shape[0]), dtype=bool)
        for number, row in enumerate(hands):
            for place, hand in enumerate(row):
                filled[number, place, hand.filled] = True
        return TrackedTake(
            rate=1.0 / float(np.median(np.diff(times))) if capture is None else capture.rate,
            times=times,
            hands=self._hands,
            qpos=np.array([[hand.qpos for hand in row] for row in hands]),
            status=np.array([[_NUMBERS[hand.status] for hand in row] for row in hands], dtype=np.int8),
            rms=np.array([[hand.rms for hand in row] for row in hands]),
            markers=np.array([[hand.markers for hand in row] for row in hands]),
            filled=filled,
            points=_spread(there, [frame.points for frame in frames], np.nan),
            ids=_spread(there, [frame.ids for frame in frames], -1).astype(np.int32),
            labels=_spread(there, [one.labels for one in tracked], -1).astype(np.int16),
            confidence=_spread(there, [one.confidence for one in tracked], np.nan),
            **self._body_tracks(tracked),
            settings={"tracker": dataclasses.asdict(self._config)},
        )

    def _body_tracks(self, tracked: Sequence[TrackedFrame]) -> dict[str, Any]:
        shape = len(tracked), len(self._bodies)
        poses, rms = np.full((*shape, 7), np.nan), np.full(shape, np.nan)
        status = np.full(shape, LOST, dtype=np.int8)
        for number, frame in enumerate(tracked):
            for place, body in enumerate(frame.bodies):
                poses[number, place] = np.concatenate([body.translation, body.rotation])
                status[number, place], rms[number, place] = _NUMBERS[body.status], body.rms
        return {"bodies": self._bodies, "body_poses": poses, "body_status": status, "body_rms": rms}


def _spread(there: Bool[np.ndarray, "T N"], rows: list[NDArray[Any]], missing: float) -> NDArray[Any]:
    """Values of the points of all frames, each in its column."""
    values = np.concatenate(rows)
    table = np.full(there.shape + values.shape[1:], missing, dtype=values.dtype)
    table[there] = values
    return table
