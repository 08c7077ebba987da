"""Frames that a tracker is given, and what is always so of its answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.paper.take_evaluation import seen_frame
from gloves import Status, Take
from handsim import HandModel
from track import TrackedFrame, Tracker

NUM_MARKERS = 38
SURE = Status.TRACKED, Status.INITIALIZED
FARTHEST = 0.004
"""[m] that joints may be off on average wherever a hand is said to be tracked."""


class Fed(NamedTuple):
    """What a tracker is given of a frame, and the truth of it."""

    points: np.ndarray
    ids: np.ndarray
    time: float
    labels: np.ndarray
    """Of each point; -1 for what is none of the hands'."""
    shift: np.ndarray | None = None
    """Of each hand (2, 3) from where the take has it [m]."""


Change = Callable[[int, Fed], Fed]


def plain(take: Take, frame: int) -> Fed:
    seen = seen_frame(take, frame)
    labels = np.where(seen.labels < NUM_MARKERS, seen.labels, -1)  # the controller is not tracked
    return Fed(seen.points, seen.ids, frame / take.rate, labels)


def feed(
    tracker: Tracker, take: Take, frames: Sequence[int], change: Change = lambda number, fed: fed
) -> tuple[list[Fed], list[TrackedFrame]]:
    """Lead a tracker through frames, each changed, and look at everything that is always so."""
    fed = [change(frame, plain(take, frame)) for frame in frames]
    tracked = []
    for one in fed:
        tracked.append(tracker.step(one.points, one.ids, one.time))
        check_frame(tracked[-1], one.points)
    worst = np.nanmax(joint_errors(take, frames, fed, tracked), initial=0.0)
    assert worst <= FARTHEST, f"a pose is stood by that is {1e3 * worst:.1f} mm off"
    return fed, tracked


def check_frame(tracked: TrackedFrame, points: np.ndarray) -> None:
    """Shapes, ranges, one name a marker, and no number where there is no pose."""
    assert tracked.labels.shape == tracked.confidence.shape == (len(points),)
    named = tracked.labels[tracked.labels >= 0]
    assert (tracked.labels >= -1).all() and (named < NUM_MARKERS).all()
    assert len(np.unique(named)) == len(named), "a marker has two points"
    assert ((tracked.confidence >= 0.0) & (tracked.confidence <= 1.0)).all()
    assert (tracked.labels[~np.isfinite(points).all(axis=1)] == -1).all()
    for number, hand in enumerate(tracked.hands):
        mine = (tracked.labels // 19 == number) & (tracked.labels >= 0)
        assert hand.qpos.shape == (27,) and hand.markers.shape == (19, 3)
        if hand.status is Status.LOST:
            assert np.isnan(hand.qpos).all() and np.isnan(hand.rms) and np.isnan(hand.markers).all()
            assert not mine.any() and len(hand.filled) == 0 and not hand.has_pose
            continue
        assert np.isfinite(hand.qpos).all() and np.isfinite(hand.markers).all()
        assert np.linalg.norm(hand.qpos[3:7]) == pytest.approx(1.0)
        assert set(hand.filled) == set(range(19)) - set(tracked.labels[mine] - 19 * number)
        np.testing.assert_array_equal(hand.markers[tracked.labels[mine] - 19 * number], points[mine])
        if hand.status in SURE:
            assert hand.rms <= 0.008 and mine.sum() >= 5


def joint_errors(
    take: Take, frames: Sequence[int], fed: Sequence[Fed], tracked: Sequence[TrackedFrame]
) -> np.ndarray:
    """Mean distance (T, H) of a hand's joints from the truth [m] where the tracker is sure, NaN elsewhere."""
    off = np.full((len(tracked), 2), np.nan)
    for number, hand in enumerate(take.moving_hands()):
        model = HandModel(hand.shape)
        sure = [n for n, one in enumerate(tracked) if one.hands[number].status in SURE]
        if not sure:
            continue
        poses = np.array([tracked[n].hands[number].qpos for n in sure])
        truth = hand.qpos[[frames[n] for n in sure]].copy()
        truth[:, :3] += [np.zeros(3) if fed[n].shift is None else fed[n].shift[number] for n in sure]
        bones = [model.forward_kinematics(qpos)[..., :3, 3] for qpos in (poses, truth)]
        off[sure, number] = np.linalg.norm(bones[0] - bones[1], axis=-1).mean(axis=-1)
    return off


def all_right(fed: Sequence[Fed], tracked: Sequence[TrackedFrame]) -> list[bool]:
    """Whether every hand of a frame is followed or found and every point has its true label."""
    return [
        np.array_equal(one.labels, two.labels) and all(hand.status in SURE for hand in two.hands)
        for one, two in zip(fed, tracked, strict=True)
    ]


def statuses(tracked: Sequence[TrackedFrame]) -> set[Status]:
    return {hand.status for frame in tracked for hand in frame.hands}


def nothing(number: int, fed: Fed) -> Fed:
    return fed._replace(points=np.zeros((0, 3)), ids=np.zeros(0, dtype=int), labels=np.zeros(0, dtype=int))


def only(fed: Fed, kept: np.ndarray | slice | list[int]) -> Fed:
    return fed._replace(points=fed.points[kept], ids=fed.ids[kept], labels=fed.labels[kept])
