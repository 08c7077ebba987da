"""The paper's loop on simulated captures: how it begins, what it carries on, what it names anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.paper_tracker import (
    GATE,
    PaperTracker,
    cluster_points,
    label_by_proximity,
    labeler_cloud,
)
from benchmarks.paper.take_evaluation import evaluate_tracker, hide_points, seen_frame, true_users
from gloves import GloveFit, Status, Take
from handsim.hand.shape import JOINT_NAMES
from tests.labelers import CountingLabeler
from track import TrackedFrame
from train import Labeling, simulate_take


@pytest.fixture(scope="module")
def labeler():
    return CountingLabeler()


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=240).without_body()


@pytest.fixture(scope="module")
def users(take) -> list[GloveFit]:
    return true_users(take)


@pytest.fixture(scope="module")
def still(take) -> Take:
    """A frame of which every marker is seen, standing still."""
    frame = int(np.flatnonzero(take.markers_present().all(axis=1))[0])
    part = take.cut(frame, frame + 1)
    arrays = (part.qpos, part.points, part.ids, part.labels)
    qpos, points, ids, labels = (np.repeat(array, 40, axis=0) for array in arrays)
    return Take.of_truth(part.hands, qpos, points, ids, labels, rate=part.rate)


def run(tracker: PaperTracker, take: Take) -> list[TrackedFrame]:
    frames = []
    for number in range(take.num_frames):
        seen = seen_frame(take, number)
        frames.append(tracker.step(seen.points, seen.ids, number / take.rate))
    return frames


def settled(users, labeler, still) -> PaperTracker:
    """A tracker that has both hands."""
    tracker = PaperTracker(users, labeler, rng=np.random.default_rng(1))
    assert np.array_equal(run(tracker, still)[-1].labels, seen_frame(still, 0).labels)
    return tracker


def without(still: Take, marker: int, *, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A frame with a marker back under another ID, off by so much; or without it."""
    seen = seen_frame(still, 0)
    points, ids = seen.points.copy(), seen.ids.copy()
    points[seen.labels == marker, 0] += shift
    ids[seen.labels == marker] = 10_000
    return points, ids, seen.labels


def test_hands_are_found_and_followed(take, users, labeler):
    tracker = PaperTracker(users, labeler, rng=np.random.default_rng(3))
    report = evaluate_tracker(take, users, tracker)
    assert report.valid[20:].all(), "both hands are found within a few frames"
    assert report.right[20:].mean() >= 0.95
    assert np.nanmean(report.joint_error) < 0.0005


def test_sides_are_drawn_and_a_wrong_one_is_thrown_away(users, labeler, still):
    first = []
    for seed in range(12):
        tracker = PaperTracker(users, labeler, rng=np.random.default_rng(seed))
        frames = run(tracker, still)
        first.append([hand.status for hand in frames[0].hands])
        assert all(hand.status is Status.TRACKED for hand in frames[-1].hands)
        assert np.array_equal(frames[-1].labels, seen_frame(still, 0).labels)
    found = [statuses == [Status.INITIALIZED] * 2 for statuses in first]
    assert all(statuses in ([Status.INITIALIZED] * 2, [Status.LOST] * 2) for statuses in first)
    assert 2 <= sum(found) <= 10, "the coin has two sides"


def test_the_labeler_is_asked_only_when_points_are_new(users, labeler, still):
    tracker = settled(users, labeler, still)
    before = sum(labeler.calls)
    run(tracker, still)
    assert sum(labeler.calls) == before
    points, ids, labels = without(still, 7)
    kept = labels != 7
    assert np.array_equal(tracker.step(points[kept], ids[kept], 1.0).labels, labels[kept])
    assert sum(labeler.calls) == before, "a marker that goes away is nothing new"
    assert np.array_equal(tracker.step(points, ids, 1.01).labels, labels)
    assert sum(labeler.calls) == before + 1, "but one that comes back is, for its hand alone"


class Fading(CountingLabeler):
    """A labeler that knows nothing from some time on."""

    silent = False

    def label_frames(self, frames: Sequence[np.ndarray]) -> list[Labeling]:
        if self.silent:
            return [Labeling(np.full(len(cloud), -1), np.ones(len(cloud))) for cloud in frames]
        return super().label_frames(frames)


@pytest.mark.parametrize(("shift", "name"), [(0.8 * GATE, 7), (1.2 * GATE, -1)])
def test_a_marker_that_comes_back_near_its_place_has_its_name_again(shift, name, users, still):
    labeler = Fading()
    tracker = settled(users, labeler, still)
    labeler.silent = True
    points, ids, labels = without(still, 7, shift=shift)
    named = tracker.step(points, ids, 1.0).labels
    assert named[labels == 7] == name
    assert np.array_equal(named[labels != 7], labels[labels != 7])


@pytest.mark.parametrize("silent", [False, True])
def test_markers_that_come_back_elsewhere_are_for_the_labeler(silent, users, still):
    labeler = Fading()
    tracker = settled(users, labeler, still)
    labeler.silent = silent
    seen = seen_frame(still, 0)
    bent = still.qpos[:1, 0].copy()
    bent[0, 7 + JOINT_NAMES.index("index_MCP_flexion")] += 0.6
    model, glove = users[0].model, users[0].attachment
    places = glove.centers(model, model.forward_kinematics(bent))[0]
    names = [glove.layout.names.index(name) for name in ("IndexPIP", "IndexTip")]
    finger = np.isin(seen.labels, names)
    points, ids = seen.points.copy(), seen.ids.copy()
    points[finger] = places[seen.labels[finger]]
    assert np.linalg.norm(points - seen.points, axis=1)[finger].min() > GATE
    tracker.step(points[~finger], ids[~finger], 1.0)
    ids[finger] += 10_000
    named = tracker.step(points, ids, 1.01).labels
    assert np.array_equal(named, np.where(finger, -1, seen.labels) if silent else seen.labels)


def test_poses_of_more_than_8_mm_rms_are_thrown_away(users, labeler, still, rng):
    tracker = settled(users, labeler, still)
    seen = seen_frame(still, 0)
    points = seen.points.copy()
    mine = seen.labels < 19
    points[mine] += rng.normal(0.0, 0.03, size=(int(mine.sum()), 3))
    frame = tracker.step(points, seen.ids, 1.0)
    assert [hand.status for hand in frame.hands] == [Status.LOST, Status.TRACKED]
    assert (frame.labels[mine] == -1).all()
    assert np.isnan(frame.hands[0].qpos).all() and np.isnan(frame.hands[0].markers).all()


def test_hands_are_found_again_after_a_second_without_points(take, users, labeler):
    frames = run(PaperTracker(users, labeler, rng=np.random.default_rng(0)), hide_points(take, 60, 120))
    assert all(hand.status is Status.LOST for hand in frames[100].hands)
    assert all(hand.status is Status.TRACKED for hand in frames[-1].hands)
    assert np.array_equal(frames[-1].labels, seen_frame(take, 239).labels)


PLACES = arrays(np.float64, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-0.5, 0.5))


@settings(deadline=None, max_examples=50)
@given(PLACES, st.integers(1, 25))
def test_every_point_is_in_one_cluster_and_none_is_too_large(points, most):
    clusters = cluster_points(points, most=most)
    assert sorted(np.concatenate([np.zeros(0, dtype=int), *clusters]).tolist()) == list(range(len(points)))
    assert all(len(cluster) <= most for cluster in clusters)
    centers = [points[cluster].mean(axis=0) for cluster in clusters]
    for place, one in enumerate(clusters):
        for other in range(place):
            far = np.linalg.norm(centers[place] - centers[other]) > 0.2 - 1e-9
            assert far or len(one) + len(clusters[other]) > most, "nothing is left to join"


def test_centers_count_and_not_the_points_between():
    chain = np.zeros((6, 3))
    chain[:, 0] = np.arange(6) * 0.15
    assert [cluster.tolist() for cluster in cluster_points(chain, most=22)] == [[0, 1], [2, 3], [4, 5]]


SOME = arrays(np.float64, st.tuples(st.integers(0, 9), st.just(3)), elements=st.floats(0.0, 0.03))


@settings(deadline=None, max_examples=80)
@given(SOME, SOME)
def test_names_are_one_to_one_near_and_leave_no_pair(points, places):
    names = label_by_proximity(points, places, 0.015)
    named = names[names >= 0]
    assert len(np.unique(named)) == len(named)
    apart = np.linalg.norm(points[:, None] - places, axis=-1)
    assert (apart[names >= 0, named] < 0.015).all()
    left = np.delete(apart[names < 0], named, axis=1)
    assert not (left < 0.015).any()


def test_the_nearest_pair_goes_first():
    points, places = np.array([[0.010, 0, 0], [0.001, 0, 0]]), np.array([[0.004, 0, 0], [0.016, 0, 0]])
    assert label_by_proximity(points, places, 0.015).tolist() == [1, 0]
    assert label_by_proximity(points[:1], places[:1] + [0.021, 0, 0], 0.015).tolist() == [-1], "not nearer"


def test_a_cloud_is_the_hand_and_the_nearest_free_points():
    points = np.zeros((9, 3))
    points[:, 0] = [0.0, 0.02, 0.05, 0.04, 0.1, 0.19, 0.3, 0.06, 0.03]
    named, free = np.arange(9) < 2, (np.arange(9) >= 2) & (np.arange(9) < 8)
    assert labeler_cloud(points, named, free, most=5, radius=0.2).tolist() == [0, 1, 3, 2, 7]
    assert labeler_cloud(points, named, free, most=22, radius=0.2).tolist() == [0, 1, 3, 2, 7, 4, 5]
    assert labeler_cloud(points, named, free, most=2, radius=0.2).tolist() == [0, 1]
