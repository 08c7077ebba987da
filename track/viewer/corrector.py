"""Corrections of a tracked take that a person makes one by one, and the take with all of them."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gloves.takes.corrections import (
    NO_MARKER,
    Correction,
    applied_corrections,
    corrections_of,
    corrections_path,
    follow_point,
    save_corrections,
)
from gloves.takes.take import Take
from handsim.errors import CaptureError
from track.corrected_take import correct_take


class Corrector:
    """A take that is open for corrections.

    Args:
        path: The take's file; the corrections beside it are read.

    Raises:
        CaptureError: The corrections cannot be read, or cannot be meant for this take.
    """

    def __init__(self, path: Path, take: Take) -> None:
        self.path, self._base, self._lock = path, take, threading.Lock()
        self.saved: tuple[Correction, ...] = corrections_of(path)
        """What the file of corrections holds."""
        self.added: tuple[Correction, ...] = ()
        """What was added and is not saved."""
        self.take = take
        """The take with all corrections."""
        self.unfitting: tuple[Correction, ...] = ()
        """Saved corrections that fit no point."""
        self._state = _state_of(path)
        records = applied_corrections(take)
        self._stale = any(correction.record() not in records for correction in self.saved)
        if self._stale:
            try:
                self._make(())
            except CaptureError as error:
                raise CaptureError(f"{corrections_path(path)}: {error}") from error

    @property
    def unsaved(self) -> bool:
        """Whether the take with all corrections differs from its file."""
        return bool(self.added) or self._stale

    def span_of(self, frame: int, column: int) -> tuple[int, int]:
        """The frames around one in which its point has the same ID and label without a gap."""
        take, points = self.take, self.take.point_list
        point = points.at(frame, column)
        if points.ids[point] < 0:
            return frame, frame
        same = (points.ids == points.ids[point]) & (points.labels == points.labels[point])
        ends = np.setdiff1d(np.arange(take.num_frames), points.frames[same])
        position = np.searchsorted(ends, frame)
        first = int(ends[position - 1]) + 1 if position else 0
        last = int(ends[position]) - 1 if position < len(ends) else take.num_frames - 1
        return first, last

    def add(self, frame: int, column: int, span: tuple[int, int], label: str) -> Correction:
        """Give a point its right label.

        Args:
            frame: A frame in which the point is there.
            span: The first and the last frame in which the label is right.
            label: Name of its marker, or `NO_MARKER`.

        Returns:
            The correction, for those frames of the span in which the point is there.

        Raises:
            CaptureError: The point is not in the span, or another one of a frame is corrected to that marker.
        """
        with self._lock:
            correction = self._meant(frame, column, span, label)
            self._make((*self.added, correction))
        return correction

    def undo(self) -> None:
        """Take back what was added last."""
        with self._lock:
            if self.added:
                self._make(self.added[:-1])

    def save(self) -> str:
        """Write the corrections and the take, and say so.

        Raises:
            CaptureError: A file cannot be written, or was changed since it was read.
        """
        with self._lock:
            if _state_of(self.path) != self._state or corrections_of(self.path) != self.saved:
                raise CaptureError(
                    f"{self.path} or its corrections have changed since they were opened, expected the same "
                    "files; open it again"
                )
            beside, every = corrections_path(self.path), (*self.saved, *self.added)
            save_corrections(beside, every)
            self.saved, self.added, self._stale = corrections_of(self.path), (), True
            try:
                self.take.save(self.path)
            except OSError as error:
                words = error.strerror or error
                raise CaptureError(f"{self.path}: cannot be written: {words}") from error
            self._base, self._state, self._stale = self.take, _state_of(self.path), False
        return f"saved {self.path} and {beside}"

    def _meant(self, frame: int, column: int, span: tuple[int, int], label: str) -> Correction:
        """A correction of the frames of a span in which a point is there."""
        points = self.take.point_list
        first, last = min(span), max(span)
        point = points.at(frame, column)
        start = frame
        if points.ids[point] >= 0:
            same = np.flatnonzero(points.ids == points.ids[point])
            same = same[(points.frames[same] >= first) & (points.frames[same] <= last)]
            if not len(same):
                raise CaptureError(
                    f"the point is not there in frames {first} to {last}, expected a frame with it"
                )
            point = int(same[0])
            start, last = int(points.frames[point]), int(points.frames[same[-1]])
        place: list[float] = points.points[point].tolist()
        correction = Correction(start, max(start, last), (place[0], place[1], place[2]), label)
        followed = points.frames[follow_point(points, correction)]
        return Correction(start, int(followed[-1]), correction.place, label)

    def _make(self, added: Sequence[Correction]) -> None:
        """Make the take with these corrections, unless they cannot be meant."""
        every = (*self.saved, *added)
        corrected = correct_take(self._base, every)
        self.added, self.unfitting = tuple(added), corrected.unfitting
        self.take = corrected.take if every else self._base


def label_of(take: Take, frame: int, column: int) -> str:
    """Name of a point's marker, or `NO_MARKER`."""
    label = int(take.point_list.labels[take.point_list.at(frame, column)])
    return take.label_names[label] if label >= 0 else NO_MARKER


def _state_of(path: Path) -> tuple[int, int] | None:
    """What changes when a file is written anew; None where it is gone."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
