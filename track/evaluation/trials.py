"""Hard beginnings: takes that are cut or go dark, and how long a tracker then needs until all is right."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.takes.take import Take
from handsim.errors import ArgumentError
from track.evaluation.take_evaluation import FrameTracker, is_right, is_valid, seen_frame

if TYPE_CHECKING:
    from jaxtyping import Float

_LEAD: Final = 60  # frames that a tracker sees before all goes dark
_DARK: Final = 120
_PATIENCE: Final = 120  # frames that it may need
FEWEST_FRAMES: Final = _LEAD + _DARK + _PATIENCE
"""Frames of a take that trials are made with, at least."""


def cut(take: Take, first: int, last: int) -> Take:
    """A take from one frame to before another.

    Raises:
        ArgumentError: There are no such frames.
    """
    if not 0 <= first < last <= take.num_frames:
        raise ArgumentError(f"frames {first} to {last}, expected a part of 0 to {take.num_frames}")
    part = slice(first, last)
    hands = tuple(dataclasses.replace(hand, qpos=hand.qpos[part]) for hand in take.hands)
    body = take.body and dataclasses.replace(take.body, T_world_body=take.body.T_world_body[part])
    return dataclasses.replace(
        take, points=take.points[part], ids=take.ids[part], labels=take.labels[part], hands=hands, body=body
    )


def darken(take: Take, first: int, frames: int) -> Take:
    """A take in which nothing at all is seen for some frames; what comes back has other IDs."""
    points, ids, labels = take.points.copy(), take.ids.copy(), take.labels.copy()
    dark, after = slice(first, first + frames), ids[first + frames :]
    points[dark], ids[dark], labels[dark] = np.nan, -1, -1
    after[after >= 0] += take.ids.max() + 1
    return dataclasses.replace(take, points=points, ids=ids, labels=labels)


def without_body(take: Take) -> Take:
    """A take without the points of its body of three or more markers: the optical system's own business.

    The paper's system tracked such bodies beside the hands (its figure 1);
    `train.evaluation.labeler_evaluation.hand_clouds`
    leaves them out as well.
    """
    gone = take.labels >= take.hand_labels[-1].stop
    return dataclasses.replace(
        take,
        points=np.where(gone[..., None], np.nan, take.points),
        ids=np.where(gone, -1, take.ids),
        labels=np.where(gone, -1, take.labels),
        body=None,
    )


def first_locks(
    take: Take, make: Callable[[Take], FrameTracker], starts: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "S"]:
    """Frames that pass before all points and poses are right, from random frames of a take.

    Args:
        take: The take, of at least 120 frames.
        make: A new tracker for a part of the take.
        starts: How often to begin.
        rng: Decides where.

    Returns:
        0 for the very first frame; NaN where 120 were not enough.
    """
    locks = np.full(starts, np.nan)
    for number, first in enumerate(_places(take, _PATIENCE, starts, rng)):
        part = cut(take, first, first + _PATIENCE)
        locks[number] = _wait(part, make(part), 0)
    return locks


def recoveries(
    take: Take, make: Callable[[Take], FrameTracker], trials: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "S"]:
    """The same after 60 frames of the take and 120 more in which nothing is seen: a second at 120 Hz."""
    waits = np.full(trials, np.nan)
    for number, first in enumerate(_places(take, FEWEST_FRAMES, trials, rng)):
        part = darken(cut(take, first, first + FEWEST_FRAMES), _LEAD, _DARK)
        waits[number] = _wait(part, make(part), _LEAD + _DARK)
    return waits


def _places(take: Take, frames: int, count: int, rng: np.random.Generator) -> list[int]:
    if take.num_frames < frames:
        raise ArgumentError(f"the take has {take.num_frames} frames, expected at least {frames}")
    places: list[int] = rng.integers(0, take.num_frames - frames + 1, size=count).tolist()
    return places


def _wait(take: Take, tracker: FrameTracker, since: int) -> float:
    """Frames from one on until all is right."""
    for frame in range(take.num_frames):
        seen = seen_frame(take, frame)
        tracked = tracker.step(seen.points, seen.ids, frame / take.rate)
        if frame >= since and is_valid(tracked) and is_right(take, tracked, seen):
            return float(frame - since)
    return np.nan
