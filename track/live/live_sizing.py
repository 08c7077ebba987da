"""The size of the hands of a live stream, measured in a separate process while tracking goes on.

Tracking begins with hands of the usual size. They are measured after 0.3 seconds of frames with enough
points, after twice as many while no hand is found, and once more after ten seconds. The tracker adopts a new
size in small steps, one per frame, so that no joint jumps. After a pause, or if the fit suddenly worsens, the
hands may be another person's: measure again.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from time import monotonic
from typing import Any, Final, NamedTuple

import numpy as np

from gloves.takes.points import Status
from handsim.app.workers import LocalProcesses
from handsim.callbacks import Closing
from handsim.errors import HandSimError, HandSimWarning
from handsim.hand.model import HandModel, hand_keypoints
from handsim.kernels import move, velocity_of
from track.captures import judged_setup
from track.frames import StreamedFrame, TrackedFrame, TrackedHand
from track.hand_size import hand_between, sample_frames
from track.settings import TrackerSetup, TrackSettings
from track.tracker import Tracker
from track.user import MEASURED, User

_POINT_SHARE: Final = 0.8  # A frame has enough points if they suffice for this share of a hand's markers.
_FIRST_DURATION: Final = 0.3  # [s] A hand is first measured after this time with enough points.
_FINAL_DURATION: Final = 10.0  # [s] A hand is measured for the last time after this time with enough points.
_LATER_FACTOR: Final = 2.0  # If no hand was found, the next measurement waits this many times as long.
_LONGEST_STEP: Final = 0.1  # [s] A longer gap between two frames counts as this much time with hands.
_MOST_FRAMES: Final = 20_000  # largest number of kept frames; a stream may show no hand for hours
_PAUSE: Final = 1.0  # [s] without a hand, after which the hands may be another person's
_SAME_LENGTH: Final = 0.006  # [m] Lengths of the same hands from brief measurements differ by less.
_CALM_TIME: Final = 5.0  # [s] time after a measurement over which the usual residual is averaged
_RECENT_TIME: Final = 1.0  # [s] time constant of the newest residual's running mean
_RESIDUAL_RATIO: Final = 1.5  # ratio to the usual residual beyond which the hands may be another person's
_STEP_MOTION: Final = 0.002  # [m] motion of the markers of a hand at rest per step to a new size
_FEWEST_STEPS: Final = 4  # Learned marker biases fade out in at least this many steps.
_MOST_EASING: Final = 0.0025  # [m] largest deviation of a keypoint from its motion per frame, at a new size
_USUAL_TIME: Final = 3.0  # [s] A measurement that takes longer lacks processor time.
_NICENESS: Final = 5  # The measuring process has a lower priority than the tracker's.


class _Measured(NamedTuple):
    """Result of measuring the hands in some frames."""

    users: Sequence[User] = ()
    """Hands in small steps towards their measured size; empty if no hand was found."""
    warnings: Sequence[str] = ()
    """Warnings about glove, hands, labels or scale."""
    is_relabeled: bool = False
    """Whether other labels are likelier than those of hands in the glove as designed."""


class LiveSizing(Closing):
    """Measures the hands of a stream and resizes those of its tracker; usable in a `with` block.

    Args:
        setup: The tracker's hands, measured only if their size is automatic, and their labeler.
    """

    def __init__(self, setup: TrackerSetup) -> None:
        self._setup, self._frames = setup, list[StreamedFrame]()
        self._seen_time, self._due = 0.0, _FIRST_DURATION  # [s] frames with enough points: so far, needed
        self._last = self._seen = -np.inf  # [s] times of the last such frame and hand
        self._is_brief, self._is_done = True, False  # is the last measurement brief, the size final?
        self._time_since = self._usual = self._newest = 0.0  # [s] since measured; [m] residuals
        self._is_measured, self._reason, self._begun = False, "", 0.0  # [s] `_begun` on the monotonic clock
        self._is_late = False  # Is the running measurement of hands before a pause or another user?
        self._is_first = True  # Was no hand measured yet?
        self._processes: LocalProcesses | None = None
        if setup.is_auto:
            self._start_process()
        self._measuring: Future[_Measured] | None = None
        self._steps: deque[User] = deque()
        self._before: tuple[TrackedFrame, TrackedFrame] | None = None  # tracked and shown
        self._is_easing = self._is_resized = False  # Is the next frame the first of another size?
        self._judges = False  # Are labels judged in a brief measurement, too?

    @property
    def is_settled(self) -> bool:
        """Whether the tracker has adopted the newest size."""
        return not self._steps

    @property
    def state(self) -> str:
        """Why the hands are not measured, or not those of another user yet; empty if they need not be."""
        nobody_came = not self._is_first and not self._seen_time
        if self._is_measured or nobody_came or not self._setup.is_auto:
            return ""
        if self._measuring is None:
            return self._reason or f"not measured yet: seen for {self._seen_time:.1f} of {self._due:.1f} s"
        has_time = monotonic() < self._begun + _USUAL_TIME
        return "being measured" if has_time else "not measured yet: no processor time"

    def close(self) -> None:
        """Cancel a running measurement."""
        if self._processes is not None:
            self._processes.end()

    def eased(self, tracked: TrackedFrame, tracker: Tracker) -> TrackedFrame:
        """The frame to show, with the state of the measurement.

        A new size may find a hand in another pose, to which it goes in small steps.
        """
        tracked = dataclasses.replace(tracked, size_state=self.state) if self.state else tracked
        shown, last = tracked, self._before
        if self._is_easing and last is not None:
            span = tracked.time - last[0].time if self._is_resized else None
            each = zip(last[0].hands, last[1].hands, tracked.hands, tracker.hands, strict=True)
            hands = tuple(_ease_hand(was, seen, hand, fit.model, span) for was, seen, hand, fit in each)
            self._is_easing = hands != tracked.hands or not self.is_settled
            shown = dataclasses.replace(tracked, hands=hands)
        self._before, self._is_resized = (tracked, shown), False
        return shown

    def step(self, frame: StreamedFrame, tracked: TrackedFrame, tracker: Tracker) -> bool:
        """Process a tracked frame; return whether the tracker's hands were resized."""
        if not self._setup.is_auto:
            return False
        is_there = any(hand.has_pose for hand in tracked.hands)
        came = frame.time > self._seen + _PAUSE and (is_there or self._is_measured)
        if came or self._fit_worse(tracked, min(frame.time - self._seen, _LONGEST_STEP)):
            self._frames.clear()
            self._seen_time, self._due, self._is_brief, self._is_done = 0.0, _FIRST_DURATION, True, False
            self._is_measured, self._reason, self._is_late = False, "", self._measuring is not None
        self._seen = frame.time if is_there else self._seen
        fewest = _POINT_SHARE * self._setup.user.layout.num_markers
        if not self._is_done and len(frame.points) >= fewest:
            self._seen_time += min(frame.time - self._last, _LONGEST_STEP)
            self._last = frame.time
            self._frames.append(frame)
            if len(self._frames) > _MOST_FRAMES:
                self._frames = sample_frames(self._frames)
        if self._measuring is not None and self._measuring.done():
            self._end_measuring(self._measuring, tracker)
        if self._measuring is None and self._seen_time >= self._due and not self._is_done:
            self._begin_measuring(self._steps[-1] if self._steps else tracker.user)
        if not self._steps:
            return False
        user, self._is_easing, self._is_resized = self._steps.popleft(), True, True
        tracker.resize(user, keep=len(self._steps) / (len(self._steps) + 1))
        return True

    def _fit_worse(self, tracked: TrackedFrame, span: float) -> bool:
        """Whether the fit is much worse than just after the measurement; `span` [s] is the time step."""
        rms = [hand.rms for hand in tracked.hands if hand.status is Status.TRACKED]
        if self._steps or not self._is_measured or not rms:
            return False
        mean = sum(rms) / len(rms)
        self._time_since += span
        if self._time_since < _CALM_TIME:
            self._usual += (mean - self._usual) * span / self._time_since
            self._newest = self._usual
        self._newest += (mean - self._newest) * span / _RECENT_TIME
        return self._newest > _RESIDUAL_RATIO * self._usual

    def _begin_measuring(self, user: User) -> None:
        """Start to measure the hands in the frames so far."""
        self._is_late, self._is_brief = False, self._seen_time < _FINAL_DURATION
        self._due = _LATER_FACTOR * self._seen_time
        self._frames, self._begun = sample_frames(self._frames), monotonic()
        processes = self._processes or self._start_process()
        self._measuring = processes.submit(
            _measure, self._setup.settings, self._frames, user, judges=self._judges or not self._is_brief
        )

    def _start_process(self) -> LocalProcesses:
        """Start the process that measures, which takes as long to load as to measure."""
        self._processes = LocalProcesses(1)
        self._processes.submit(_lower_priority)
        return self._processes

    def _end_measuring(self, measuring: Future[_Measured], tracker: Tracker) -> None:
        """Adopt the result of a measurement."""
        self._measuring = None
        try:
            found = measuring.result()
        except (HandSimError, BrokenProcessPool) as error:
            found = _Measured(warnings=[str(error)])
            if isinstance(error, BrokenProcessPool):
                self._processes = None
        for sentence in found.warnings:
            warnings.warn(sentence, HandSimWarning, stacklevel=4)
        if not found.users:
            self._reason = "not measured yet: no hand was found"
            return
        self._is_measured, self._is_first = not self._is_late, False
        if self._is_measured:
            self._due, self._seen = max(self._due, _FINAL_DURATION), max(self._seen, self._last)
        self._judges = self._judges or found.is_relabeled
        self._is_done, self._time_since, self._usual = not self._is_brief, 0.0, 0.0
        before, after = (one[0].shape.length for one in (tracker.user, found.users[-1]))
        is_same = tracker.user.notes.startswith(MEASURED) and abs(after - before) < _SAME_LENGTH
        if not (self._is_brief and is_same):
            self._steps = deque(found.users)


def _lower_priority() -> None:
    """Lower the priority of this process."""
    if hasattr(os, "nice"):
        os.nice(_NICENESS)


def _measure(
    settings: dict[str, Any], frames: Sequence[StreamedFrame], before: User, *, judges: bool
) -> _Measured:
    """Measure the hands in some frames, and judge their labels."""
    setup = TrackerSetup.of(TrackSettings.from_json(settings))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", HandSimWarning)
        setup = setup.measured(frames, warns=False)
    after = measured = setup.user
    told = [str(one.message) for one in caught if issubclass(one.category, HandSimWarning)]
    if not after.notes.startswith(MEASURED):
        return _Measured(warnings=told)
    if judges:
        setup, sentences = judged_setup(frames, setup)
        after, told = setup.user, told + sentences
    is_relabeled = setup.user is not measured
    places = [np.concatenate([hand.attachment.points for hand in user]) for user in (before, after)]
    farthest = float(np.linalg.norm(places[1] - places[0], axis=1).max())
    count = max(_FEWEST_STEPS, int(np.ceil(farthest / _STEP_MOTION)))
    users = []
    for share in np.arange(1, count) / count:
        hands = tuple(hand_between(*pair, float(share)) for pair in zip(before, after, strict=True))
        users.append(dataclasses.replace(after, hands=hands))
    return _Measured([*users, after], told, is_relabeled)


def _ease_hand(
    tracked: TrackedHand, shown: TrackedHand, hand: TrackedHand, model: HandModel, span: float | None
) -> TrackedHand:
    """A hand in its tracked pose, or in one on the way from the pose shown before.

    The shown hand moves as the tracked one does. If another size has moved the tracked one, it continues its
    own motion for `span` seconds.
    """
    if not shown.has_pose or hand.status not in (Status.TRACKED, Status.COASTING):
        return hand
    motion = np.nan_to_num(shown.velocity) * (span or 0.0)
    if span is None:
        motion = velocity_of(tracked.qpos, hand.qpos, 1.0)
    due = move(shown.qpos[None], motion[None])[0]
    ways = np.diff(hand_keypoints(model, np.stack([due, hand.qpos])), axis=0)
    share = _MOST_EASING / max(float(np.linalg.norm(ways, axis=-1).max()), _MOST_EASING)
    if share == 1.0:
        return hand
    qpos = move(due[None], share * velocity_of(due, hand.qpos, 1.0)[None])[0]
    return dataclasses.replace(hand, qpos=qpos, velocity=hand.velocity if span is None else shown.velocity)
