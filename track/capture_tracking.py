"""Tracking of a whole capture, frame by frame, and its result as a take."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np

from gloves.captures.capture import Capture
from gloves.optics.identities import number_runs
from gloves.takes.corrections import Correction, find_pins, load_corrections, told
from gloves.takes.points import PointList
from gloves.takes.take import Take, label_names
from handsim.callbacks import Progress, no_progress
from handsim.errors import CaptureError, HandSimWarning
from track.calibration.frames import CalibrationError
from track.corrected_take import correct_take
from track.given import AnyCapture, capture_of
from track.hand_size import sample_frames
from track.label_confidence import label_confidence
from track.recorder import TakeRecorder
from track.settings import TrackSettings
from track.setup import TrackerSetup, as_designed
from track.sinks import SinkGroup
from track.streams.frame_source import StreamedFrame, checked_frames
from track.take_calibration import calibrate_take, kept_user
from track.tracked_frame import TrackedFrame
from track.tracker import Tracker
from track.user import MEASURED

OnFrame = Callable[[StreamedFrame, TrackedFrame], None]


def track_capture(
    capture: AnyCapture,
    settings: TrackSettings | None = None,
    *,
    corrections: str | Path | None = None,
    sinks: SinkGroup | None = None,
    progress: Progress = no_progress,
    on_frame: OnFrame | None = None,
    **options: Any,
) -> Take:
    """Track the hands of a capture, as `handsim track` does.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        settings: How to track; as `TrackSettings()` when not given.
        corrections: A file of labels that a person corrected, as `handsim view` saves it beside a take.
        sinks: Take every frame as it is tracked, from `open_sinks`; the capture is then played at its own
            rate.
        progress: Called after each frame with the number of tracked frames and of all frames.
        on_frame: Called with each frame, its time in [s], and what the tracker made of it.
        options: Fields of `TrackSettings` that differ from `settings`, as `glove="dense19"`, `size="M"`,
            `hands="user.json"`, `bodies=["mug"]` or `calibrate=True`.

    Returns:
        Poses (T, H, 27) [m, rad], labels (T, N) and status of every frame.

    Raises:
        ArgumentError: The capture is not in meters, or arguments do not go together.
        CaptureError: The capture cannot be read, most of its points are far from any room, or corrections do
            not fit it.
        UserError: A user's file cannot be read.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.
    """
    settings = TrackSettings.of(settings, options)
    setup = TrackerSetup.of(settings)
    source = capture_of(capture)
    pins = () if corrections is None else _checked_corrections(Path(corrections), source, setup)
    frames = checked_frames(source)
    is_measured = setup.is_measured
    setup = setup.measured(sample_frames(frames))
    if settings.calibrate:
        recorder = record_frames(frames, setup.tracker(), progress=progress)
        setup = _calibrated(recorder.take(source), setup, is_measured=is_measured)
    recorder = record_frames(frames, setup.tracker(), sinks, on_frame, progress)
    take = recorder.take(source)
    named = {"capture": Path(capture).name} if isinstance(capture, str | Path) else {}
    points = dataclasses.replace(take.point_list, confidence=label_confidence(take))
    take = dataclasses.replace(take, point_list=points, settings={**take.settings, **named, **setup.settings})
    return take if corrections is None else _corrected(take, Path(corrections), pins)


def record_frames(
    frames: Sequence[StreamedFrame],
    tracker: Tracker,
    sinks: SinkGroup | None = None,
    on_frame: OnFrame | None = None,
    progress: Progress = no_progress,
) -> TakeRecorder:
    """Track all frames; sinks take them at the capture's own rate."""
    recorder = TakeRecorder(tracker)
    if sinks:
        sinks.start(tracker.hands, tracker.bodies)
    began = monotonic()
    for frame in frames:
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        if sinks:
            sleep(max(0.0, began + frame.time - monotonic()))
            sinks.send(frame, tracked)
        if on_frame is not None:
            on_frame(frame, tracked)
        recorder.add(frame, tracked)
        progress(recorder.num_frames, len(frames))
    return recorder


def _calibrated(take: Take, setup: TrackerSetup, *, is_measured: bool) -> TrackerSetup:
    """The setup with its hands calibrated on a take of it, as far as they fit held-out frames better."""
    user = setup.user
    try:
        done = calibrate_take(take, as_designed(user) if is_measured else user.hands, user, None)
    except CalibrationError as error:
        warnings.warn(f"not calibrated: {error}", HandSimWarning, stacklevel=3)
        return setup
    notes = f"calibrated on the take itself, {user.notes.removeprefix(MEASURED) or user} to begin with"
    found = kept_user(take, done, user, notes, None)
    better = {hand.side: hand for hand in found}
    hands = tuple(better.get(hand.side, hand) for hand in user)
    settings = {**setup.settings, "user": found.notes}
    return dataclasses.replace(setup, user=dataclasses.replace(found, hands=hands), settings=settings)


def _checked_corrections(path: Path, source: Capture, setup: TrackerSetup) -> tuple[Correction, ...]:
    """The corrections of a file, checked against the capture before the long work."""
    corrections = load_corrections(path)
    ids = number_runs(np.isfinite(source.positions[..., 0]))
    points = PointList.of_tables(source.positions, ids, np.full_like(ids, -1), np.ones(ids.shape))
    try:
        find_pins(corrections, points, label_names(setup.user, setup.bodies))
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}") from error
    return corrections


def _corrected(take: Take, path: Path, corrections: Sequence[Correction]) -> Take:
    """The take with its corrections; what does not fit is told."""
    corrected = correct_take(take, corrections)
    for sentence in told(path, corrected.unfitting):
        warnings.warn(sentence, HandSimWarning, stacklevel=3)
    return corrected.take
