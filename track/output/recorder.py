"""Recording of tracked frames in memory or on disk.

A recording on disk grows in `take.npz.part` (`gloves.takes.archives`), which is readable at any time and
lacks at most the last half second if the process dies. `finish` turns it into `take.npz`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.layout import MarkerLayout
from gloves.takes.archives import GrowingArchive, GrownArchive, finish_archive, growing_path
from gloves.takes.points import FRAMES, KEYPOINTS, NUMBERS, POINTS, SPREADS, PointList
from gloves.takes.take import (
    RATED_FRAMES,
    Take,
    keypoints_of,
    take_header,
    unpack_take,
    usual_rate,
    worn_arrays,
)
from gloves.takes.worn import FORMER, FormerHands, former_array
from handsim._checks import check_type
from handsim.callbacks import Closing
from handsim.errors import DAMAGE, ArgumentError, CaptureError, HandSimWarning
from handsim.files.outputs import check_ending, remove_abandoned
from handsim.files.signals import interrupt_behind
from track.frames import FARTHEST, LATEST_TIME, StreamedFrame, TrackedFrame
from track.tracker import Tracker
from track.user import stored_errors

_MOST_SUMMARIZED: Final = 5_000  # largest number of frames that a summary reads; it takes 3 s
_ID_BITS: Final = (1 << 31) - 1  # bits of IDs in takes


def take_of_rows(rows: Sequence[Mapping[str, NDArray[Any]]], tracker: Tracker, capture: Capture) -> Take:
    """The take of a capture from `frame_values` of its frames, with the capture's columns and rate."""
    arrays = {column.name: np.array([row[column.name] for row in rows]) for column in (*FRAMES, *SPREADS)}
    entries = {column.name: np.concatenate([row[column.name] for row in rows]) for column in POINTS}
    present = np.isfinite(capture.positions[..., 0])
    return Take(
        rate=capture.rate,
        hands=tracker.hands,
        bodies=tracker.bodies,
        settings=settings_of(tracker),
        former=(),
        point_list=PointList(
            present.sum(axis=1), **entries, columns=np.nonzero(present)[1], num_columns=present.shape[1]
        ),
        **arrays,
    )


def settings_of(tracker: Tracker) -> dict[str, Any]:
    """Settings that a take records of its tracker, as JSON."""
    known: dict[str, Any] = {"user": tracker.user.notes} if tracker.user.notes else {}
    errors = stored_errors(tracker.user)
    known |= {"errors": errors} if errors else {}
    return {"glove": tracker.user.layout.name, **known, "tracker": dataclasses.asdict(tracker.config)}


def frame_values(frame: StreamedFrame, tracked: TrackedFrame) -> dict[str, NDArray[Any]]:
    """A frame's row of each array of a take, by name; arrays of points have N rows."""
    hands, bodies = tracked.hands, tracked.bodies
    poses = [np.concatenate([body.translation, body.rotation]) for body in bodies]
    return {
        "times": np.array(frame.time),
        "numbers": np.array(frame.number),
        "qpos": np.array([hand.qpos for hand in hands]),
        "status": np.array([hand.status for hand in hands], dtype=np.int8),
        "rms": np.array([hand.rms for hand in hands]),
        "angle_spread": np.array([hand.angle_spread for hand in hands], dtype=np.float32),
        "keypoint_spread": np.array([hand.keypoint_spread for hand in hands], dtype=np.float32),
        "body_poses": np.array(poses).reshape(len(bodies), 7),
        "body_status": np.array([body.status for body in bodies], dtype=np.int8),
        "body_rms": np.array([body.rms for body in bodies], dtype=np.float64),
        "points": frame.points,
        "ids": np.where(frame.ids < 0, -1, frame.ids & _ID_BITS).astype(np.int32),
        "labels": tracked.labels.astype(np.int16),
        "confidence": tracked.confidence,
    }


class Recorder(Closing):
    """Records tracked frames on disk in a `with` block, frame by frame with `add`.

    The end of the block writes the take, also if Ctrl-C ended it. After any other exception the recording is
    kept in `part`.

    Args:
        path: File of the take, .npz; the recording grows beside it.
        tracker: The tracker, for its hands, bodies and settings.
        settings: Further settings of the take, as JSON.

    Raises:
        ArgumentError: The path does not end in .npz.
        CaptureError: An unfinished recording exists already.
        OSError: The file cannot be written.
    """

    def __init__(
        self, path: str | Path, tracker: Tracker, settings: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        check_type("path", path, (str, Path), "the path of a take's file, .npz")
        check_type("tracker", tracker, Tracker, "the Tracker whose frames are recorded")
        out = Path(path)
        check_ending(out, ".npz", option="path")
        remove_abandoned(out)  # left by a run that was killed in `finish`
        self._tracker, self.out = tracker, out
        """The file of the take."""
        self._settings = {**settings_of(tracker), **settings}
        self._user = tracker.user
        sizes = {"H": len(tracker.hands), "B": len(tracker.bodies)}
        columns = [column.sized(sizes) for column in (*FRAMES, *POINTS, NUMBERS, *SPREADS, KEYPOINTS)]
        self._archive = GrowingArchive(growing_path(out), self._header(None), self._worn_arrays(), columns)
        self._times: tuple[float, float] | None = None
        self._closed = False

    @property
    def part(self) -> Path:
        """The file of the recording."""
        return self._archive.path

    @property
    def num_frames(self) -> int:
        """Number of recorded frames."""
        return self._archive.num_frames

    def kept(self, what: str = "the recording is") -> str:
        """Say where the recording is kept, and how much of it, by reading its file."""
        try:
            kept = GrownArchive(self.part, check=False).num_frames
        except (OSError, *DAMAGE):
            return f"nothing of it is kept in {self.part}"
        what = what if kept >= self.num_frames else f"{kept} of its {self.num_frames} frames are"
        return f"{what} kept in {self.part}"

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._times[1] - self._times[0] if self._times else 0.0

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Record a frame, unless it only marks a silence of the stream.

        Points that the tracker ignores, because they are not finite or very far away, are left out.

        Raises:
            ArgumentError: Its time is not after that of the frame before; what was recorded is kept.
            CaptureError: The file cannot be written; what was recorded until then is kept.
        """
        if frame.silent:
            with self._writing():
                self._archive.flush_due()
            return
        last = self._times[1] if self._times else -LATEST_TIME
        if not last < frame.time < LATEST_TIME:
            raise ArgumentError(
                f"frame {frame.number} is at {frame.time:g} s, expected a time after that of the frame "
                f"before, {last:g} s"
            )
        values = frame_values(frame, tracked)
        usable = np.abs(values["points"]) < FARTHEST  # False for NaN
        if not usable.all():
            kept = usable.all(axis=1)
            values |= {column.name: values[column.name][kept] for column in POINTS}
        keypoints = keypoints_of(self._tracker.hands, values["qpos"][None])[0]
        with self._writing():
            if self._tracker.user is not self._user:
                self._end_hands()
            self._archive.add({**values, KEYPOINTS.name: keypoints}, len(values["points"]))
        self._times = (self._times[0] if self._times else frame.time, frame.time)

    def _end_hands(self) -> None:
        """Record that the frames so far are of other hands, or of another size, than the tracker's now."""
        before, self._user = self._user, self._tracker.user
        self._settings["user"] = self._user.notes
        if self.num_frames:
            ended = FormerHands(self.num_frames, before.hands, before.notes)
            self._archive.add_former(former_array([ended], self._layouts))
        self._archive.replace_head(self._header(None), self._worn_arrays())

    def _worn_arrays(self) -> dict[str, NDArray[Any]]:
        worn = worn_arrays(self._tracker.hands, self._tracker.bodies)
        return {**worn, FORMER: former_array((), self._layouts)}

    @property
    def _layouts(self) -> list[MarkerLayout]:
        return [hand.layout for hand in self._tracker.hands]

    def close(self) -> None:
        """Write waiting frames, and close the recording without writing the take."""
        self._closed = True
        with self._writing():
            self._archive.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Within the block an error of the system ends the recording; say what is kept."""
        try:
            yield
        except OSError as error:
            self._closed = True
            with suppress(OSError):
                self._archive.close()
            raise CaptureError(
                f"the recording ended after {self.num_frames} frames ({error.strerror or error}); "
                f"{self.kept('they are')}"
            ) from error

    def finish(
        self,
        stream: Mapping[str, int] | None = None,
        *,
        size: str = "",
        told: Callable[[], None] = lambda: None,
    ) -> tuple[Take, int]:
        """Write the take, read it back, and remove the recording; with fewer than two frames only remove it.

        Args:
            stream: Counts of the stream's frames (`counts` of `open_source`), for the take's settings.
            size: Why the last hands are not measured; the settings keep it as `size_state`.
            told: Called after every part.

        Returns:
            The take for a summary, and a step: of a long take only every step-th block is read.

        Raises:
            CaptureError: Fewer than two frames came, or the take cannot be written; then the recording is
                kept. It is kept as well, with a warning, if another program damaged it.
        """
        self.close()
        if self.num_frames < 2:
            self.part.unlink(missing_ok=True)
            raise CaptureError(f"{self.num_frames} frames came, expected two or more")
        if stream is not None:
            self._settings["stream"] = dict(stream)
        if size:
            self._settings["size_state"] = size
        try:
            grown = GrownArchive(self.part)
            first = (grown.first(name, RATED_FRAMES) for name in ("times", NUMBERS.name))
            header = self._header(usual_rate(*first))
            step = max(1, -(-grown.num_frames // _MOST_SUMMARIZED))
            take = unpack_take(dict(header), grown.read(step))
            finish_archive(grown, self.out, header, on_block=told)
        except Exception as error:  # keep the recording after any error
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            raise CaptureError(f"{self.out}: cannot be written ({reason}); {self.kept()}") from error
        if grown.num_frames < self.num_frames:
            lost = f"{self.part} was damaged by another program and stays: {self.out} has {grown.num_frames}"
            warnings.warn(f"{lost} of its {self.num_frames} frames", HandSimWarning, stacklevel=2)
        else:
            self.part.unlink()
        return take, step

    def _header(self, rate: float | None) -> dict[str, Any]:
        return take_header(self._tracker.hands, self._tracker.bodies, rate, self._settings)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        stop = None if error is None else interrupt_behind(error)
        if self._closed or (error is not None and stop is None):
            self.close()
        else:
            self.finish()
        if stop is not None and stop is not error:  # compiled code wrapped the interrupt
            raise stop from error
