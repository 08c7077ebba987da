"""Recording of a live stream: frames go to disk as they come, and memory does not grow.

A recording grows in `take.npz.part` (`gloves.takes.growing`), which is readable at any time and holds all but
the last half second, whatever ends the process. `finish` turns it into `take.npz`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from gloves.takes.columns import FRAMES, KEYPOINTS, NUMBERS
from gloves.takes.growing import GrowingArchive, GrownArchive, finish_archive, growing_path
from gloves.takes.take import (
    RATED_FRAMES,
    Take,
    keypoints_of,
    take_header,
    unpack_take,
    usual_rate,
    worn_arrays,
)
from handsim.errors import CaptureError
from track.capture_tracking import frame_values
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker

_SUMMARIZED: Final = 20_000  # frames at most that are read for a summary


class LiveRecorder:
    """Records tracked frames on disk; the end of a `with` block closes the file and leaves it where it is.

    Args:
        tracker: The tracker, for its hands, bodies and settings.
        out: The take's file, .npz; until `finish` the recording is beside it.
        settings: What made the take, as JSON.

    Raises:
        CaptureError: A recording that was cut off is in the way.
        OSError: The file cannot be written.
    """

    def __init__(self, tracker: Tracker, out: Path, settings: dict[str, Any]) -> None:
        self.part = growing_path(out)
        """The file of the recording."""
        self._out, self._hands, self._bodies = out, tracker.hands, tracker.bodies
        self._settings = {"tracker": dataclasses.asdict(tracker.config), **settings}
        sizes = {"H": len(self._hands), "B": len(self._bodies)}
        self._archive = GrowingArchive(
            self.part,
            self._header(None),
            worn_arrays(self._hands, self._bodies),
            [column.sized(sizes) for column in (*FRAMES, NUMBERS, KEYPOINTS)],
        )
        self._times: tuple[float, float] | None = None

    @property
    def num_frames(self) -> int:
        """Number of recorded frames."""
        return self._archive.num_frames

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._times[1] - self._times[0] if self._times else 0.0

    def add(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Record a frame, unless it stands for a silence of the stream.

        Raises:
            CaptureError: The file cannot be written; what was recorded until then is kept.
        """
        try:
            if frame.silent:
                self._archive.flush_due()
                return
            values = frame_values(frame, tracked)
            keypoints = keypoints_of(self._hands, values["qpos"][None])[0]
            self._archive.add({**values, KEYPOINTS.name: keypoints}, len(frame.points))
        except OSError as error:
            raise CaptureError(
                f"the recording ended after {self.num_frames} frames ({error.strerror or error}); they are "
                f"kept in {self.part}"
            ) from error
        self._times = (self._times[0] if self._times else frame.time, frame.time)

    def close(self) -> None:
        """Write what still waits, and close the file."""
        self._archive.close()

    def finish(self, stream: dict[str, int], *, told: Callable[[], None] = lambda: None) -> tuple[Take, int]:
        """Write the take and remove the recording; without at least two frames, remove it only.

        Args:
            stream: What became of the stream's frames, for the settings of the take.
            told: Called after every part.

        Returns:
            The take for a summary, and a step: of a long take it holds the frames of every step-th block.

        Raises:
            CaptureError: Fewer than two frames came, or the take cannot be written; then the recording is
                kept.
        """
        self.close()
        if self.num_frames < 2:
            self.part.unlink()
            raise CaptureError(f"{self.num_frames} frames came, expected two or more")
        self._settings["stream"] = stream
        grown = GrownArchive(self.part, check=False)
        header = self._header(usual_rate(grown.first("times", RATED_FRAMES)))
        try:
            finish_archive(grown, self._out, header, told=told)
        except OSError as error:
            raise CaptureError(
                f"{self._out}: cannot be written ({error.strerror or error}); the recording is kept in "
                f"{self.part}"
            ) from error
        step = grown.step_for(_SUMMARIZED)
        take = unpack_take(header, grown.read(step))
        self.part.unlink()
        return take, step

    def _header(self, rate: float | None) -> dict[str, Any]:
        return take_header(self._hands, self._bodies, rate, self._settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
