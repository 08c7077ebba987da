"""The tracker on simulated captures whose truth is known, and on frames that no system should send."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.take_evaluation import seen_frame, true_users
from gloves import GloveFit, Status, Take, load_layout
from gloves.fit import nominal_fit
from handsim import HandModel, HandSimError
from handsim.errors import ArgumentError
from handsim.hand.shape import JOINT_NAMES
from tests.sentences import error_names
from track import TrackedFrame, Tracker, TrackerConfig, User
from track.kinematics.pose_spread import SKELETON_NUMBERS, HandErrors
from train import Labeler, load_labeler, simulate_take

NUM_MARKERS = 38
SURE = Status.TRACKED, Status.INITIALIZED
LIMITS = TrackerConfig()
FARTHEST = 0.004
"""[m] that joints may be off on average wherever a hand is said to be tracked."""
USELESS_IDS: dict[str, Change] = {
    "none": lambda number, fed: fed._replace(ids=None),
    "-1": lambda number, fed: fed._replace(ids=0 * fed.ids - 1),
    "the least number": lambda number, fed: fed._replace(ids=0 * fed.ids + np.iinfo(np.int64).min),
    "one for all points": lambda number, fed: fed._replace(ids=0 * fed.ids + 7),
    "new in every frame": lambda number, fed: fed._replace(
        ids=2**62 - 1000 * number - np.arange(len(fed.ids))
    ),
    "in another order": lambda number, fed: only(
        fed, np.random.default_rng(number).permutation(len(fed.ids))
    ),
}
JITTER = np.random.default_rng(0).normal(size=120)
CLOCKS: dict[str, tuple[Sequence[int], Callable[[int], float], float]] = {
    "frames that come twice": ([frame for frame in range(60) for _ in range(2)], float, 1.0),
    **{
        f"every tenth frame {apart:g} s after the one before": (
            range(60), lambda n, apart=apart: n - 1 + 120 * apart if n % 10 == 5 else n, 0.95
        )
        for apart in (3e-3, 1e-4, 1e-6)
    },
    **{
        f"stamps that shake by {wide:g} frames": (
            range(120), np.sort(np.arange(120) + wide * JITTER).__getitem__, 0.95
        )
        for wide in (0.24, 0.48)
    },
    "30 Hz": (range(0, 240, 4), float, 0.9),
    "15 Hz": (range(0, 240, 8), float, 0.9),
}  # fmt: skip
"""Frames, the time of each in frames of the take, and the least share of them that is right."""
COORDINATES = st.one_of(
    st.floats(-0.3, 0.3),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, np.nan, 1e300]),
)
IDS = st.one_of(st.integers(-2, 12), st.integers(-(2**63), 2**63 - 1))
TIMES = st.one_of(st.floats(0.0, 1.0), st.floats(-1e9, 1e9), st.just(np.nan))


@pytest.fixture(scope="session")
def labeler():
    return load_labeler("dense19")


@pytest.fixture(scope="session")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=240)


@pytest.fixture(scope="session")
def users(take) -> list[GloveFit]:
    return true_users(take)


@pytest.fixture
def tracker(users, labeler) -> Tracker:
    return Tracker(users, labeler)


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
    labels = np.where(seen.labels < take.hand_labels[-1].stop, seen.labels, -1)  # not the controller
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
            assert hand.rms <= LIMITS.most_rms and mine.sum() >= LIMITS.fewest_labels


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


def test_hands_are_initialized_and_tracked_and_what_was_said_stays_said(tracker, take):
    fed, tracked = feed(tracker, take, range(take.num_frames))
    assert [hand.status for hand in tracked[0].hands] == [Status.INITIALIZED] * 2
    assert statuses(tracked[1:]) == {Status.TRACKED}
    assert np.mean(all_right(fed, tracked)) >= 0.98
    poses = np.array([[hand.qpos for hand in frame.hands] for frame in tracked])
    assert np.nanmean(joint_errors(take, range(take.num_frames), fed, tracked)) <= 0.0005
    true = np.stack([hand.qpos for hand in take.moving_hands()], axis=1)
    assert np.rad2deg(np.abs(poses - true)[..., 7:]).mean(axis=(0, 2)).max() <= 1.0
    steps = np.abs(np.diff(poses[:40, :, 7:], axis=0)).max(axis=-1)
    assert (steps > 0.0).all() and steps[1:].max() < 0.2  # the first frame may lack a finger tip
    left = tracked[-1].hand("left")
    assert left.side == "left" and list(left.angles.values()) == left.qpos[7:].tolist()
    assert left.angles["index_PIP_flexion"] == left.qpos[7 + JOINT_NAMES.index("index_PIP_flexion")]
    with error_names(ArgumentError, "hand 'middle' | right, left"):
        tracked[-1].hand("middle")


def test_velocities_are_those_of_the_tracked_motion(tracker, take):
    """They are smoothed, so over two seconds they add up to the motion."""
    poses, velocities = [], []
    for number in range(240):
        hand = tracker.step(take.points[number], take.ids[number], number / take.rate).hand("right")
        assert np.isfinite(hand.velocity).all() == (hand.status is Status.TRACKED)
        poses.append(hand.qpos)
        velocities.append(hand.velocity)
    moved, added = np.diff(poses, axis=0), np.array(velocities[1:]) / take.rate
    known = np.isfinite(added[:, 0])
    assert known.mean() > 0.9
    for ours, theirs in ((added[known, :3], moved[known, :3]), (added[known, 6:], moved[known, 7:])):
        total, error = np.abs(theirs).sum(axis=0), np.abs(ours - theirs).sum(axis=0)
        assert np.median(error / total) < 0.6 and np.abs(ours.sum(0) - theirs.sum(0)).max() < 0.2
    assert list(hand.angle_velocities) == list(hand.angles)


def test_the_rms_is_the_distance_from_the_given_hand_in_the_first_frames_too(take, labeler):
    """Biases are learned there, and a frame's own must not count as known before it."""
    tracker = Tracker([nominal_fit(hand.layout, "M", hand.side) for hand in take.hands], labeler)
    for number in range(12):
        points, ids, time, *_ = plain(take, number)
        frame = tracker.step(points, ids, time)
        for index, (fit, hand) in enumerate(zip(tracker.hands, frame.hands, strict=True)):
            own = (frame.labels >= 19 * index) & (frame.labels < 19 * (index + 1))
            markers = fit.markers(hand.qpos[None])[0][0][frame.labels[own] - 19 * index]
            distances = np.linalg.norm(points[own] - markers, axis=1)
            assert hand.rms == pytest.approx(np.sqrt((distances**2).mean()), abs=2e-5)


def test_what_is_given_and_said_is_the_callers_own(users, labeler, take):
    """A caller who spoils all arrays changes nothing of the frames after it."""
    poses = []
    for spoil in (False, True):
        tracker = Tracker(users, labeler)
        for frame in range(40):
            fed = plain(take, frame) if frame % 10 < 8 else nothing(frame, plain(take, frame))
            points, ids = fed.points.copy(), fed.ids.copy()
            tracked = tracker.step(points, ids, fed.time)
            np.testing.assert_array_equal(points, fed.points)
            np.testing.assert_array_equal(ids, fed.ids)
            poses.append(np.array([hand.qpos for hand in tracked.hands]))
            said = [array for hand in tracked.hands for array in (hand.markers, hand.qpos)]
            for array in (points, ids, tracked.labels, tracked.confidence, *said) if spoil else ():
                array[:] = 0
    np.testing.assert_array_equal(poses[:40], poses[40:])


@pytest.mark.parametrize("seed", [0, 2])
def test_gloves_with_few_markers_far_apart_are_tracked(seed):
    """Large hands in the sparse glove: stretched fingers are over 85 mm from the markers on the back."""
    kind = "single-hand" if seed == 0 else "hand-hand"
    take, right = simulate_take(kind=kind, num_frames=60, glove="sparse13", seed=seed), []
    tracker = Tracker(true_users(take), load_labeler("sparse13"))
    for number in range(60):
        points, ids, time, labels, _ = plain(take, number)
        right.append(np.array_equal(tracker.step(points, ids, time).labels, labels))
    assert np.mean(right) > 0.95


@pytest.mark.parametrize("name", ["BackHand1", "RingPIP"])
def test_a_marker_glued_on_8_mm_from_its_place_is_labeled_within_a_fifth_of_a_second(name):
    """All others fit within some tenths of a millimeter, so that the first fit leaves it out."""
    take = simulate_take(kind="single-hand", num_frames=30, glove="sparse13", hands=("right",)).without_body()
    (user,) = true_users(take)
    worn, marker = user.attachment, user.layout.names.index(name)
    points, way = worn.points.copy(), np.cross(worn.normals[marker], [1.0, 0.0, 0.0])
    points[marker] += 0.008 * way / np.linalg.norm(way)
    hand = GloveFit(user.model, dataclasses.replace(worn, points=points))
    tracker, missed = Tracker([hand], load_labeler("sparse13")), []
    for number in range(30):
        fed = plain(take, number)
        labels = tracker.step(fed.points, fed.ids, fed.time).labels
        assert np.isin(labels, [-1, *fed.labels]).all() and set(fed.labels) - set(labels) <= {marker}
        missed.append(marker in fed.labels and marker not in labels)
    assert missed[0] and not any(missed[24:])


def test_a_labeler_may_be_named_or_left_to_the_glove(take, users):
    points, ids, _, labels, _ = plain(take, 0)
    designed = [nominal_fit(load_layout("dense19"), "M", hand.side) for hand in take.hands]
    assert np.array_equal(Tracker(users, "dense19").step(points, ids, 0.0).labels, labels)
    named, left = (Tracker(designed, *name).step(points, ids, 0.0) for name in (("dense19",), ()))
    np.testing.assert_array_equal(named.labels, left.labels)


@pytest.mark.parametrize("kind", USELESS_IDS)
def test_ids_and_an_order_that_say_nothing(tracker, take, kind):
    fed, tracked = feed(tracker, take, range(60), USELESS_IDS[kind])
    assert np.mean(all_right(fed, tracked)) >= 0.95


def test_an_id_that_goes_over_while_its_marker_is_hidden_does_not_take_the_name_along(tracker, take):
    """To every other marker of the digit in turn; the marker's own point comes back under another ID."""
    feed(tracker, take, range(20))
    fed, tracked = [], []
    for round_, (hidden, heir) in enumerate([(4, 5), (4, 6), (10, 11), (23, 24), (29, 35), (4, 23)]):

        def change(number: int, fed: Fed, begin=20 + 12 * round_, hidden=hidden, heir=heir) -> Fed:
            own = fed.ids[fed.labels == hidden]
            ids = fed.ids + 1000 * (number >= begin + 8) * (fed.labels == hidden)
            if number < begin + 8:
                fed = only(fed._replace(ids=ids), fed.labels != hidden)
                return fed._replace(ids=np.where(fed.labels == heir, own.max(initial=-1), fed.ids))
            return fed._replace(ids=ids)

        part = feed(tracker, take, range(20 + 12 * round_, 32 + 12 * round_), change)
        fed, tracked = fed + part[0], tracked + part[1]
    assert np.mean(all_right(fed, tracked)) >= 0.95


def with_one_id(number: int, fed: Fed) -> Fed:
    """Two points with the IDs of two others."""
    ids = fed.ids.copy()
    ids[fed.labels == 5], ids[fed.labels == 30] = ids[fed.labels == 4].max(), ids[fed.labels == 11].max()
    return fed._replace(ids=ids)


def shuffled(share: float) -> Change:
    """A share of the IDs lies. Poses must not be stood by that follow from lies."""

    def change(number: int, fed: Fed) -> Fed:
        rng, ids = np.random.default_rng(number), fed.ids.copy()
        mixed = rng.permutation(len(ids))[: round(share * len(ids))]
        ids[mixed] = ids[rng.permutation(mixed)]
        return fed._replace(ids=ids)

    return change


def nowhere(place: float) -> Change:
    """Four points have a coordinate that is no place."""

    def change(number: int, fed: Fed) -> Fed:
        rng, points, labels = np.random.default_rng(number), fed.points.copy(), fed.labels.copy()
        gone = rng.choice(len(points), 4, replace=False)
        points[gone, rng.integers(0, 3, size=4)], labels[gone] = place, -1
        return fed._replace(points=points, labels=labels)

    return change


def strays(spread: float, *, lasting: bool) -> Change:
    """Five hundred strays around and among the hands, the same in all frames or new ones in each."""

    def change(number: int, fed: Fed) -> Fed:
        rng = np.random.default_rng(0 if lasting else number)
        center = fed.points[fed.labels >= 0].mean(axis=0)
        return fed._replace(
            points=np.concatenate([fed.points, center + rng.uniform(-spread, spread, size=(500, 3))]),
            ids=np.concatenate([fed.ids, 10**6 + 1000 * number * (not lasting) + np.arange(500)]),
            labels=np.append(fed.labels, np.full(500, -1)),
        )

    return change


SPOILT: dict[str, tuple[Change, float, str]] = {
    "two points with one ID": (with_one_id, 0.95, "several points"),
    **{f"{share:.0%} of the IDs shuffled": (shuffled(share), 0.8, "") for share in (0.1, 0.3, 1.0)},
    **{
        f"points at {place}": (nowhere(place), 0.9, "no position")
        for place in (np.nan, np.inf, -np.inf, 1e30)
    },
    **{f"lasting strays within {far} m": (strays(far, lasting=True), 0.95, "") for far in (0.1, 0.5, 2.0)},
    **{f"new strays within {far} m": (strays(far, lasting=False), 0.95, "") for far in (0.1, 0.5, 2.0)},
}
"""What spoils frames, the least share of them that is right nevertheless, and what is said of each."""


@pytest.mark.parametrize("kind", SPOILT)
def test_hands_are_followed_through_spoilt_frames_and_right_after_them(tracker, take, kind):
    change, least, note = SPOILT[kind]
    feed(tracker, take, range(20))
    fed, tracked = feed(tracker, take, range(20, 50), change)
    assert np.mean(all_right(fed, tracked)) >= least
    assert all(any(note in words for words in frame.notes) for frame in tracked if note)
    fed, tracked = feed(tracker, take, range(50, 65))
    assert all(all_right(fed[5:], tracked[5:])) and not any(frame.notes for frame in tracked)


DARK: dict[str, Change] = {
    "nothing": nothing,
    "all points nowhere": lambda number, fed: fed._replace(points=fed.points * np.nan),
    "one point": lambda number, fed: only(fed, [number % 30]),
}


@pytest.mark.parametrize("kind", DARK)
def test_hands_of_which_nothing_is_seen_are_lost_and_found_again(tracker, take, kind):
    _, tracked = feed(tracker, take, range(20), DARK[kind])
    assert statuses(tracked) == {Status.LOST}
    feed(tracker, take, range(20, 60))
    _, tracked = feed(tracker, take, range(60, 90), DARK[kind])
    assert not statuses(tracked) & set(SURE)
    assert statuses(tracked[-1:]) == {Status.LOST}
    fed, tracked = feed(tracker, take, range(90, 110))
    assert all(all_right(fed[3:], tracked[3:]))


def test_a_few_empty_frames_are_coasted_through(tracker, take):
    feed(tracker, take, range(60))
    _, dark = feed(tracker, take, range(60, 66), nothing)
    assert statuses(dark) == {Status.COASTING}
    fed, tracked = feed(tracker, take, range(66, 80))
    assert all(all_right(fed[2:], tracked[2:]))


def test_every_other_frame_is_empty(tracker, take):
    fed, tracked = feed(tracker, take, range(120), lambda n, fed: nothing(n, fed) if n % 2 else fed)
    assert all(all_right(fed[::2], tracked[::2]))
    assert statuses(tracked[1::2]) == {Status.COASTING}


def test_hands_that_come_up_amid_strays_are_not_made_up(tracker, take):
    """Hands may stay lost among five hundred strays, and are found at once when the strays are gone."""
    rng = np.random.default_rng(0)

    def change(number: int, fed: Fed) -> Fed:
        strays = fed.points.mean(axis=0) + rng.uniform(-0.3, 0.3, size=(500, 3))
        points = np.concatenate([fed.points, strays])
        return fed._replace(points=points, ids=np.arange(len(points)) + 1000 * number)

    feed(tracker, take, range(10), change)
    fed, tracked = feed(tracker, take, range(10, 20))
    assert all(all_right(fed, tracked))


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("jump", [(0.5, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_a_hand_that_jumps_half_a_meter_is_right_again_soon(tracker, take, jump, same):
    def change(number: int, fed: Fed) -> Fed:
        points, mine = fed.points.copy(), (fed.labels >= 0) & (fed.labels < 19)
        points[mine] += jump
        ids = fed.ids if same else fed.ids + 10**6 * mine
        return fed._replace(points=points, ids=ids, shift=np.array([jump, np.zeros(3)]))

    feed(tracker, take, range(60))
    fed, tracked = feed(tracker, take, range(60, 120), change)
    right = all_right(fed, tracked)
    assert all(right[3:])


def test_every_point_twice_at_one_place(tracker, take):
    def change(number: int, fed: Fed) -> Fed:
        points, ids = np.repeat(fed.points, 2, axis=0), np.repeat(2 * fed.ids, 2)
        ids[1::2] += 1
        return fed._replace(points=points, ids=ids)

    feed(tracker, take, range(20), change)


def test_a_hand_found_on_half_of_its_markers_is_right_once_all_are_there(tracker, take):
    """A point of something else passes for one of them; then nothing comes for 92 ms."""
    half = only(plain(take, 6), slice(None, None, 2))
    tracker.step(half.points, half.ids + 10**6, 6 / take.rate)
    fed, tracked = feed(tracker, take, range(17, 60))
    assert all(all_right(fed[20:], tracked[20:]))


@pytest.mark.parametrize("seed", [2, 3, 6])
def test_ghosts_of_the_first_ten_frames_are_got_over(tracker, take, seed):
    """Ten that stand 10 to 50 mm from markers when hands are found."""
    rng, first = np.random.default_rng(seed), plain(take, 0)
    markers = first.points[first.labels >= 0]
    way = rng.normal(size=(10, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ghosts = markers[rng.integers(0, len(markers), 10)] + way * rng.uniform(0.01, 0.05, size=(10, 1))
    for frame in range(10):
        points, ids, time, *_ = plain(take, frame)
        ids = np.concatenate([ids, 10**6 + np.arange(10)])
        tracker.step(np.concatenate([points, ghosts]), ids, time)
    fed, tracked = feed(tracker, take, range(10, 60))
    assert all(all_right(fed[30:], tracked[30:]))


@pytest.mark.parametrize(
    ("told", "note"),
    [
        pytest.param(lambda time: 1.0 - time, "went back", id="backwards"),
        pytest.param(lambda time: 0.25, "stood still", id="still"),
        pytest.param(lambda time: np.nan, "not a number", id="NaN"),
        pytest.param(lambda time: -np.inf, "not a number", id="-inf"),
        pytest.param(lambda time: np.inf, "not a number", id="inf"),
        pytest.param(lambda time: -1e9 * time, "went back", id="far back"),
        pytest.param(lambda time: 1e9 * time, "no frame for", id="far ahead"),
    ],
)
def test_times_that_are_none_do_not_stop_a_hand(tracker, take, told, note):
    feed(tracker, take, range(30))
    fed, tracked = feed(tracker, take, range(30, 60), lambda n, fed: fed._replace(time=told(fed.time)))
    assert all(any(note in words for words in frame.notes) for frame in tracked[1:])
    assert np.mean(all_right(fed[3:], tracked[3:])) >= 0.95, "a hand is followed by the frames that come"
    fed, tracked = feed(tracker, take, range(60, 80))
    assert all(all_right(fed[3:], tracked[3:]))
    assert not any(frame.notes for frame in tracked[1:])


@pytest.mark.parametrize("kind", CLOCKS)
def test_hands_are_followed_by_other_clocks(tracker, take, kind):
    frames, clock, least = CLOCKS[kind]
    fed, tracked = feed(tracker, take, frames, lambda n, fed: fed._replace(time=clock(n) / take.rate))
    assert np.mean(all_right(fed, tracked)) >= least


@pytest.mark.parametrize("again", [False, True])
def test_a_stream_that_is_silent_for_two_seconds_and_comes_back_elsewhere(tracker, take, again):
    """With the IDs that the points had (they are of other markers now), or with new ones."""
    feed(tracker, take, range(60))

    def change(number: int, fed: Fed) -> Fed:
        before = plain(take, 59).ids
        ids = fed.ids + 10**6
        if again:
            ids[: len(before)] = before[: len(ids)]
        return fed._replace(time=fed.time + 1.0, ids=ids)

    fed, tracked = feed(tracker, take, range(180, 240), change)
    assert "no frame for" in tracked[0].notes[0]
    assert all(all_right(fed[3:], tracked[3:]))


@pytest.mark.parametrize(
    ("points", "ids", "time", "sentence"),
    [
        ("cloud", None, 0.0, "points is 'cloud', expected an array of numbers"),
        (np.zeros((2, 3)), ["a", "b"], 0.0, "ids is ['a', 'b'], expected an array of numbers"),
        (np.zeros((2, 3)), 7, 0.0, "points have shape (2, 3), expected (1, 3) for 1 IDs"),
        (np.zeros(3), None, 0.0, "points have shape (3,), expected (3, 3) for 3 IDs"),
        (np.zeros((2, 3)), [1, 2], None, "time is None, expected the time of the frame in seconds"),
        (np.zeros((2, 3)), [1, 2], "now", "time is 'now', expected the time of the frame in seconds"),
    ],
)
def test_a_frame_of_another_type_is_refused_in_one_sentence(tracker, points, ids, time, sentence):
    with error_names(ArgumentError, sentence):
        tracker.step(points, ids, time)


def test_hands_labelers_and_settings_of_another_type_are_refused(users, labeler):
    for arguments, sentence in (
        ((3, labeler), "hands is 3, expected a User, hands in their gloves"),
        (("right", labeler), "right: cannot be read"),
        (([], labeler), "hands are [], expected a left hand"),
        (([users[0]] * 2, labeler), "expected a left hand, a right hand, or one of each"),
        ((users, 3), "labeler is 3, expected a MarkerLayout, the name or path of one, a Labeler"),
        ((users, labeler, (), {}), "config is {}, expected a TrackerConfig"),
    ):
        with error_names(HandSimError, sentence):
            Tracker(*arguments)


def test_bodies_are_given_by_name_too():
    tracker = Tracker([nominal_fit(load_layout("dense19"), "M", "right")], bodies=["mug"])
    assert [body.name for body in tracker.bodies] == ["mug"]


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


@pytest.mark.slow
def test_the_same_motion_again_and_again_is_tracked_as_before(labeler):
    """Biases of markers settle: what a pose fits as well does not pile up in them."""
    take = simulate_take(kind="single-hand", num_frames=240, seed=1).without_body()
    tracker = Tracker([nominal_fit(hand.layout, "M", hand.side) for hand in take.hands], labeler)
    there_and_back = [*range(take.num_frames), *range(take.num_frames - 1, -1, -1)]
    rms = []
    for number in range(15 * len(there_and_back)):
        lap, place = divmod(number, len(there_and_back))
        seen = seen_frame(take, there_and_back[place])
        frame = tracker.step(seen.points, seen.ids + lap * (int(take.ids.max()) + 1), number / take.rate)
        rms.append([hand.rms for hand in frame.hands])
    by_lap = np.nanmedian(np.reshape(rms, (15, len(there_and_back), -1)), axis=1)
    np.testing.assert_allclose(by_lap[14], by_lap[10], atol=2e-6)  # [m]


def test_the_same_hands_again_keep_their_standard_deviations(take, users, labeler):
    rng = np.random.default_rng(4)
    errors = HandErrors(0.01 * rng.normal(size=(SKELETON_NUMBERS, 3)), 0.001 * rng.normal(size=(19, 3, 3)))
    user = User(tuple(users), errors={hand.side: errors for hand in users})
    plain_tracker, resized = Tracker(user, labeler), Tracker(user, labeler)
    resized.resize(user)
    for number in range(10):
        fed = plain(take, number)
        mine, other = (one.step(fed.points, fed.ids, fed.time) for one in (plain_tracker, resized))
    for first, second in zip(mine.hands, other.hands, strict=True):
        assert np.isfinite(first.angle_spread).any()
        np.testing.assert_array_equal(first.angle_spread, second.angle_spread)
