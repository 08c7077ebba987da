"""Trials of initialization and recovery: frames that a tracker needs until all labels and poses are right."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Float

from benchmarks.paper.take_evaluation import FrameTracker, is_right, is_valid, seen_frame
from gloves import Take
from handsim.errors import ArgumentError

_FRAMES_BEFORE: Final = 60  # frames that a tracker sees before all points are hidden
_FRAMES_HIDDEN: Final = 120  # a second
_MOST_FRAMES: Final = 120  # frames after which a trial has failed
FEWEST_FRAMES: Final = _FRAMES_BEFORE + _FRAMES_HIDDEN + _MOST_FRAMES
"""Frames that a take needs for trials."""


def hide_points(take: Take, first: int, frames: int) -> Take:
    """A take with all points of some frames hidden; later points have new IDs.

    Args:
        take: The take.
        first: First frame without points.
        frames: Number of frames without points.
    """
    points = take.point_list
    is_later = (points.frames >= first) & (points.ids >= 0)
    ids = points.ids + np.where(is_later, points.ids.max(initial=-1) + 1, 0)
    hidden = (points.frames >= first) & (points.frames < first + frames)
    return dataclasses.replace(take, point_list=dataclasses.replace(points, ids=ids).without(hidden))


def initialization_times(
    take: Take, make: Callable[[Take], FrameTracker], starts: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "S"]:
    """Number of frames until all labels and poses are right, starting from random frames of a take.

    Args:
        take: The take, of at least 120 frames.
        make: A new tracker for a part of the take.
        starts: Number of trials, S.
        rng: Draws the first frames.

    Returns:
        0 for the first frame; NaN where 120 frames were not enough.
    """
    times = np.full(starts, np.nan)
    for number, first in enumerate(_random_starts(take, _MOST_FRAMES, starts, rng)):
        part = take.cut(first, first + _MOST_FRAMES)
        times[number] = _frames_until_right(part, make(part), 0)
    return times


def recovery_times(
    take: Take, make: Callable[[Take], FrameTracker], trials: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "S"]:
    """The same after 60 frames of the take and 120 frames (a second) without points.

    Args:
        take: The take, of at least `FEWEST_FRAMES` frames.
        make: A new tracker for a part of the take.
        trials: Number of trials, S.
        rng: Draws the first frames.
    """
    times = np.full(trials, np.nan)
    for number, first in enumerate(_random_starts(take, FEWEST_FRAMES, trials, rng)):
        part = hide_points(take.cut(first, first + FEWEST_FRAMES), _FRAMES_BEFORE, _FRAMES_HIDDEN)
        times[number] = _frames_until_right(part, make(part), _FRAMES_BEFORE + _FRAMES_HIDDEN)
    return times


def _random_starts(take: Take, frames: int, count: int, rng: np.random.Generator) -> list[int]:
    if take.num_frames < frames:
        raise ArgumentError(f"the take has {take.num_frames} frames, expected at least {frames}")
    first_frames: list[int] = rng.integers(0, take.num_frames - frames + 1, size=count).tolist()
    return first_frames


def _frames_until_right(take: Take, tracker: FrameTracker, since: int) -> float:
    """Number of frames from `since` on until all labels and poses are right; NaN if they never are."""
    for frame in range(take.num_frames):
        seen = seen_frame(take, frame)
        tracked = tracker.step(seen.points, seen.ids, frame / take.rate)
        if frame >= since and is_valid(tracked) and is_right(take, tracked, seen):
            return float(frame - since)
    return np.nan
