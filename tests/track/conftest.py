"""Messages of two hands and a body, without a tracker; sinks and sources of a user's own."""

from __future__ import annotations

import functools
import sys

import numpy as np
import pytest

from gloves import Status, load_layout
from gloves.fit import nominal_fit
from handsim.hand.shape import NUM_QPOS
from handsim.space.objects import named_object
from track import LiveMessage, RigidTemplate, StreamedFrame, TrackedBody, TrackedFrame, TrackedHand
from track.output.live_message import MessageEncoder


@functools.cache
def encoder() -> MessageEncoder:
    hands = [nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left")]
    return MessageEncoder(hands, [RigidTemplate.of(named_object("mug"))])


def tracked_hand(side, rng, *, lost: bool = False) -> TrackedHand:
    qpos = rng.normal(0.0, 0.3, NUM_QPOS)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    if lost:
        qpos[:] = np.nan
    status = Status.LOST if lost else Status.TRACKED
    angles, keypoints = (
        np.full(count, np.nan if lost else spread) for count, spread in ((20, 0.1), (21, 0.002))
    )
    nothing = np.zeros((19, 3)), np.zeros(0, dtype=int)
    velocity = np.full(26, np.nan) if lost else rng.normal(0.0, 1.0, 26)
    return TrackedHand(side, status, qpos, 0.001, *nothing, lambda: (angles, keypoints), velocity)


def make_message(number: int = 0, *, lost: bool = False, seed: int = 0, points: int = 5) -> LiveMessage:
    """Message of a frame; if `lost`, the left hand and the body are."""
    rng = np.random.default_rng(seed)
    hands = (tracked_hand("right", rng), tracked_hand("left", rng, lost=lost))
    place = np.full(7, np.nan) if lost else np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])
    mug = TrackedBody("mug", Status.LOST if lost else Status.TRACKED, place[:3], place[3:], 0.001)
    frame = StreamedFrame(
        number, number / 120.0, rng.normal(size=(points, 3)), np.arange(points), latency=0.01
    )
    labels = np.arange(points) - 1
    return encoder().encode(frame, TrackedFrame(frame.time, hands, labels, np.ones(points), (mug,)))


@pytest.fixture
def message():
    """Makes messages, see `make_message`."""
    return make_message


@pytest.fixture
def own(request, tmp_path, monkeypatch):
    """A user's own module `own_code` in the working folder: `SOURCE` of the test's module."""
    (tmp_path / "own_code.py").write_text(request.module.SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("own_code", None)
