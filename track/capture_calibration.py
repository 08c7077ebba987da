"""Calibration of all hands in a capture of unlabeled points."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from gloves.fit import GloveFit
from gloves.takes.take import Take
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import HandSimWarning
from track.capture_tracking import record_frames
from track.config import BOTH, Size
from track.given import AnyCapture, AnyGlove, AnyLabeler, capture_of
from track.hand_check import check_hands, check_scale
from track.hand_size import sample_frames
from track.settings import AnyHands, TrackSettings
from track.setup import TrackerSetup, as_designed, found_user
from track.streams.frame_source import checked_frames
from track.take_calibration import calibrate_take, kept_user, leaves_markers
from track.tracker import Tracker
from track.user import MEASURED, User


def calibrate(
    capture: AnyCapture,
    glove: AnyGlove | None = None,
    *,
    hands: AnyHands = BOTH,
    size: Size = "auto",
    labeler: AnyLabeler = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
) -> User:
    """Fit hands and gloves to their user, from any capture; one in which every joint moves tells most.

    The capture is labeled by the tracker. If some markers stay unlabeled, it is labeled once more with the
    calibrated hands. Each hand is solved on two thirds of the time and tried on the rest: where that is no
    better than the hand before, the hand stays, with a warning. Otherwise it is solved on all frames.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers
            are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file; when not given that of
            `hands`, or dense19 for hands that are measured.
        hands: Which hands may be in the capture; or hands to begin with, as `track_capture` takes them.
        size: The size to begin with: XS, S, M, L, XL, or auto, which measures it in the capture.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        progress: Called with what is done of a step, and all there is to do in it.
        on_step: Called with the name of each step, such as "frames".

    Returns:
        The hands that are in the capture; its `calibrations` tell of each how it was found: `held_out`,
        standard errors and `suggestions()` for a better capture. Printed, one is what `notes` keep of it.

    Raises:
        CalibrationError: No hand is in the capture, or it tells too little of one.
        ArgumentError: The capture is not in meters, or arguments do not go together.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.
    """

    def told(what: str, done: int, total: int) -> None:
        on_step(what)
        progress(done, total)

    setup = TrackerSetup.of(TrackSettings(glove=glove, hands=hands, size=size, labeler=labeler))
    source = capture_of(capture)
    frames, user, network = checked_frames(source), setup.user, setup.labeler
    sample = sample_frames(frames)
    check_scale(sample, user, network)
    if setup.is_measured:
        user = found_user(sample, user.layout, user.sides, network) or user
    check_hands(sample, user, network)
    start = as_designed(user) if setup.is_measured else user.hands

    def labeled(hands: Sequence[GloveFit]) -> Take:
        return record_frames(frames, Tracker(hands, network), progress=partial(told, "frames")).take(source)

    take = labeled(user)
    done = calibrate_take(take, start, user, told)
    if leaves_markers(take, done):
        take = labeled([one.hand for one in done])
        done = calibrate_take(take, start, user, told)
    name = Path(capture).name if isinstance(capture, str | Path) else "a capture"
    notes = f"calibrated from {name}, {user.notes.removeprefix(MEASURED) or user} to begin with"
    found = kept_user(take, done, user, notes, told)
    for one in found.calibrations:
        if not one.is_better:
            warnings.warn(f"{one.hand.side} hand: {one}", HandSimWarning, stacklevel=2)
    return found
