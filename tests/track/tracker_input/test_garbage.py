"""The tracker with points, IDs and times that no system would send."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gloves import GloveFit, Status, Take
from tests.track.tracker_input.fed_frames import all_right, check_frame, feed, plain, statuses
from track import Tracker
from train import Labeler


@dataclasses.dataclass(frozen=True, repr=False)
class Bench:
    """What a property is tried on; it has nothing to show when an example fails."""

    users: list[GloveFit]
    labeler: Labeler
    take: Take

    def tracker(self) -> Tracker:
        return Tracker(self.users, self.labeler)


@pytest.fixture(scope="module")
def bench(users, labeler, take) -> Bench:
    return Bench(users, labeler, take)


COORDINATES = st.one_of(
    st.floats(-0.3, 0.3),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, np.nan, 1e300]),
)
IDS = st.one_of(st.integers(-2, 12), st.integers(-(2**63), 2**63 - 1))
TIMES = st.one_of(st.floats(0.0, 1.0), st.floats(-1e9, 1e9), st.just(np.nan))


@st.composite
def garbage(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, float]:
    """Points, IDs and a time that no system would send."""
    count = draw(st.integers(0, 60))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    points = rng.normal(scale=draw(st.sampled_from([0.0, 1e-4, 0.03, 0.1, 5.0])), size=(count, 3))
    some = draw(st.lists(st.tuples(st.integers(0, 59), st.integers(0, 2), COORDINATES), max_size=8))
    for row, column, value in some:
        points[row % max(count, 1) : row % max(count, 1) + 1, column] = value
    ids = draw(arrays(np.int64, count, elements=IDS))
    return points, ids, draw(TIMES)


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(frames=st.lists(garbage(), min_size=1, max_size=6), lead=st.booleans(), data=st.data())
def test_garbage_never_raises_and_leaves_nothing_behind(bench, frames, lead, data):
    """Alone, and amid a take: among the true points, shuffled, with some lost."""
    tracker, take = bench.tracker(), bench.take
    time = 0.0
    for frame in range(3 if lead else 0):
        tracker.step(*plain(take, frame)[:3])
    for number, (strays, numbers, time) in enumerate(frames):
        points, ids, fed = strays, numbers, plain(take, 3 + number)
        if data.draw(st.booleans()):
            kept = fed.points[:: data.draw(st.integers(1, 4))]
            points, ids = np.concatenate([strays, kept]), np.concatenate([numbers, fed.ids[: len(kept)]])
        with np.errstate(all="raise", under="ignore"):
            check_frame(tracker.step(points, ids, time), points)
    begin = 0.0 if np.isnan(time) else time
    for frame in range(1, 31):
        last = tracker.step(np.zeros((0, 3)), np.zeros(0, dtype=int), begin + frame / 120.0)
    assert statuses([last]) == {Status.LOST}
    fed, tracked = feed(tracker, take, range(40, 44), lambda n, one: one._replace(time=begin + n / 120.0))
    assert all(all_right(fed, tracked))
