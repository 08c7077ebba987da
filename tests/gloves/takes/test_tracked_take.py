"""Tracked takes: exact when read again, one sentence when they cannot be, and motion without holes."""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
import pytest

from gloves.fit import GlovedHand, attach
from gloves.layout import load_layout
from gloves.takes.archives import KINDS
from gloves.takes.take import SUFFIX, Take, load_take
from gloves.takes.tracked_take import (
    LOST,
    SCHEMA,
    STATUSES,
    TRACKED,
    MarkedBody,
    TrackedTake,
    load_tracked_take,
)
from handsim.errors import ArgumentError, CaptureError
from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.model import HandModel
from handsim.hand.shape import sample_shape

FRAMES, COLUMNS, MARKERS = 9, 47, 19
PEN = MarkedBody("pen", ("Pen1", "Pen2", "Pen3"), 0.05 * np.eye(3))


@pytest.fixture
def take(rng) -> TrackedTake:
    hands = []
    for side in ("left", "right"):
        shape = sample_shape(side=side, rng=rng)
        hands.append(attach(load_layout("dense19"), HandModel(shape)))
    status = rng.integers(len(STATUSES), size=(FRAMES, 2)).astype(np.int8)
    status[[0, 4]], status[5] = TRACKED, LOST
    qpos = rng.normal(size=(FRAMES, 2, 27))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    markers = rng.normal(size=(FRAMES, 2, MARKERS, 3))
    qpos[status == LOST], markers[status == LOST] = np.nan, np.nan
    points = rng.normal(size=(FRAMES, COLUMNS, 3))
    gone = rng.random((FRAMES, COLUMNS)) < 0.2
    points[gone] = np.nan
    labels = np.where(gone, -1, np.arange(COLUMNS) - 6)
    body_status = rng.integers(len(STATUSES), size=(FRAMES, 1)).astype(np.int8)
    return TrackedTake(
        rate=120.0,
        times=np.cumsum(rng.uniform(0.005, 0.02, size=FRAMES)),
        hands=tuple(hands),
        qpos=qpos,
        status=status,
        rms=np.where(status == TRACKED, 1e-3 * rng.random((FRAMES, 2)), np.nan),
        markers=markers,
        filled=rng.random((FRAMES, 2, MARKERS)) < 0.1,
        points=points,
        ids=np.where(gone, -1, rng.integers(100_000, size=gone.shape)).astype(np.int32),
        labels=np.maximum(labels, -1).astype(np.int16),
        confidence=np.where(gone, np.nan, rng.random(gone.shape)),
        bodies=(PEN,),
        body_poses=np.where((body_status == LOST)[..., None], np.nan, rng.normal(size=(FRAMES, 1, 7))),
        body_status=body_status,
        body_rms=rng.random((FRAMES, 1)),
        settings={"glove": "dense19"},
    )


def without_body(take: TrackedTake) -> TrackedTake:
    nothing = {name: getattr(take, name)[:, :0] for name in ("body_poses", "body_status", "body_rms")}
    labels = np.where(take.labels < 2 * MARKERS, take.labels, -1)
    return dataclasses.replace(take, bodies=(), labels=labels, **nothing)


def test_what_is_saved_is_what_is_read(take, tmp_path):
    for number, original in enumerate((take, without_body(take))):
        path = tmp_path / f"{number}.npz"
        original.save(path)
        again = load_tracked_take(path)
        assert (again.rate, again.settings, again.sides) == (120.0, original.settings, ("left", "right"))
        for field in dataclasses.fields(TrackedTake):
            ours, theirs = getattr(original, field.name), getattr(again, field.name)
            if isinstance(ours, np.ndarray):
                assert ours.dtype == theirs.dtype
                np.testing.assert_array_equal(ours, theirs)
        for ours, theirs in zip(original.hands, again.hands, strict=True):
            assert ours.layout == theirs.layout
            for one, two in ((ours.shape, theirs.shape), (ours.attachment, theirs.attachment)):
                for field in dataclasses.fields(one):
                    if field.name != "layout":
                        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
        assert [(body.name, body.marker_names) for body in again.bodies] == [
            (body.name, body.marker_names) for body in original.bodies
        ]
        for body in again.bodies:
            np.testing.assert_array_equal(body.positions, PEN.positions)
        assert [path.name for path in tmp_path.glob(".*")] == []


def test_labels_are_called_by_hand_and_body(take):
    names = take.label_names
    assert (names[0], names[MARKERS], names[-1]) == ("left:ThumbCMC", "right:ThumbCMC", "pen:Pen3")
    assert len(names) == 2 * MARKERS + 3


def test_what_was_seen_is_told_from_what_was_filled_in(take):
    seen = take.observed("right")
    np.testing.assert_array_equal(
        np.isfinite(seen[..., 0]), ~take.filled[:, 1] & (take.status[:, 1] != LOST)[:, None]
    )
    there = np.isfinite(seen)
    np.testing.assert_array_equal(seen[there], take.markers[:, 1][there])
    with pytest.raises(ArgumentError, match="unknown hand 'middle'"):
        take.observed("middle")


def test_motion_keeps_poses_and_goes_straight_where_there_is_none(take):
    motion = take.motion("left")
    assert motion.qpos.shape == (FRAMES, 27) and motion.rate == take.rate
    there = take.status[:, 0] != LOST
    np.testing.assert_array_equal(motion.qpos[there], take.qpos[there, 0])
    np.testing.assert_allclose(np.linalg.norm(motion.qpos[:, 3:7], axis=1), 1.0, atol=1e-12)
    before, after = np.flatnonzero(there & (np.arange(FRAMES) < 5))[-1], np.flatnonzero(there[5:])
    if len(after):
        ends = np.array([before, 5 + after[0]])
        share = (take.times[5] - take.times[ends[0]]) / np.ptp(take.times[ends])
        low, high = take.qpos[ends, 0]
        np.testing.assert_allclose(motion.qpos[5, :3], low[:3] + share * (high - low)[:3])
    alone = dataclasses.replace(
        take,
        qpos=np.where(np.arange(FRAMES)[:, None, None] == 4, take.qpos, np.nan),
        status=np.where(np.arange(FRAMES)[:, None] == 4, take.status, LOST),
    )
    np.testing.assert_array_equal(alone.motion("right").qpos, np.tile(take.qpos[4, 1], (FRAMES, 1)))
    never = dataclasses.replace(take, qpos=np.full_like(take.qpos, np.nan), status=np.zeros_like(take.status))
    with pytest.raises(ArgumentError, match="left hand has no pose"):
        never.motion("left")


def test_what_does_not_fit_together_is_no_take(take):
    for change in (
        {"rate": 0.0},
        {"times": take.times[::-1]},
        {"times": take.times[:-1]},
        {"hands": take.hands[:1]},
        {"hands": take.hands[:1] * 2},
        {"status": take.status + 4},
        {"status": np.full_like(take.status, TRACKED)},
        {"labels": take.labels + 20},
        {"confidence": take.confidence[:, 1:]},
        {"bodies": ()},
        {"numbers": np.arange(FRAMES - 1)},
        {"confidence": np.where(take.confidence > 0.5, 1.5, take.confidence)},
        {"rms": -take.rms},
        {"points": np.where(take.points > 0.0, np.inf, take.points)},
        {"markers": 1e30 * take.markers},
        {"body_poses": -np.inf * np.abs(take.body_poses)},
    ):
        with pytest.raises(ArgumentError, match="not a tracked take: "):
            dataclasses.replace(take, **change)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("body_places", "S8"), ("attachment_points", "f4"), ("numbers", "f8"), ("hands", "f8")],
)
def test_numbers_of_another_type_are_refused(name, dtype, take, tmp_path):
    path = tmp_path / "take.npz"
    dataclasses.replace(take, numbers=np.arange(FRAMES)).save(path)
    with np.load(path) as stored:
        before = stored[name] if name != "hands" else np.zeros(2)
    altered(path, **{name: before.astype(dtype)})
    assert_refused(path, "not a tracked take, or a damaged one")


def test_names_of_bodies_are_text():
    with pytest.raises(ArgumentError, match="a name is no text"):
        MarkedBody("pen", ("Pen1", 5, "Pen3"), PEN.positions)


def altered(path, **arrays) -> None:
    """Write the take anew with some arrays replaced, None taking one away."""
    with np.load(path) as stored:
        old = {name: stored[name] for name in stored.files}
    kept = {name: array for name, array in (old | arrays).items() if array is not None}
    with path.open("wb") as file:
        np.savez_compressed(file, **kept)


def assert_refused(path, *words: str) -> None:
    with pytest.raises(CaptureError) as caught:
        load_tracked_take(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ") and "\n" not in sentence
    for word in words:
        assert word in sentence


def test_takes_are_told_from_tracked_takes(take, tmp_path):
    hands = tuple(GlovedHand(hand, np.zeros((FRAMES, 27))) for hand in take.hands)
    labels = np.where(take.labels < 2 * MARKERS, take.labels, -1)
    truth = Take(120.0, take.points, take.ids, labels, hands, None, {})
    true, tracked = tmp_path / f"one{SUFFIX}", tmp_path / "one.npz"
    truth.save(true)
    take.save(tracked)
    assert_refused(true, "the truth of a simulated capture, expected a tracked take")
    with pytest.raises(CaptureError, match="a tracked take, expected the truth of a simulated capture"):
        load_take(tracked)
    with np.load(true) as stored:
        header = json.loads(str(stored["header"]))
    assert header.pop("kind") in KINDS
    altered(true, header=np.array(json.dumps(header)))  # as it was before there were two kinds
    assert load_take(true).num_frames == FRAMES
    assert_refused(true, "the truth of a simulated capture, expected a tracked take")


def test_foreign_and_other_files_are_refused_in_a_sentence(take, tmp_path):
    path = tmp_path / "take.npz"
    assert_refused(path, "No such file")
    for content in (b"", b"Frame#\tTime\n", b"PK\x03\x04" + 60 * b"\x00", b"\x80\x04K\x01."):
        path.write_bytes(content)
        assert_refused(path, "not a tracked take, or a damaged one")
    take.save(path)
    with np.load(path) as stored:
        header = json.loads(str(stored["header"]))
    altered(path, header=np.array(json.dumps(header | {"schema": SCHEMA + 1})))
    assert_refused(path, f"a tracked take of schema {SCHEMA + 1}, expected 1 or {SCHEMA}")


def test_damage_is_told_wherever_it_is(take, tmp_path, rng):
    path = tmp_path / "take.npz"
    take.save(path)
    whole = path.read_bytes()
    for place in rng.integers(len(whole) - 1, size=20):
        path.write_bytes(whole[:place])
        assert_refused(path, "not a tracked take, or a damaged one")
    for place in rng.integers(len(whole), size=60):  # some bytes of a zip mean nothing
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            np.testing.assert_array_equal(load_tracked_take(path).qpos, take.qpos)
        except CaptureError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
    path.write_bytes(whole)
    with np.load(path) as stored:
        names = set(stored.files)
        wrong = {
            "labels": stored["labels"].astype(float),
            "attachment_bone_indices": stored["attachment_bone_indices"] + 16,
            "attachment_points": stored["attachment_points"][:, 1:],
            "body_places": stored["body_places"][1:],
            "qpos": stored["qpos"][1:],
        }
    for name, array in (wrong | dict.fromkeys(names)).items():
        path.write_bytes(whole)
        altered(path, **{name: array})
        assert_refused(path, "not a tracked take, or a damaged one")


class Trap:
    """Whoever unpickles it leaves a mark."""

    def __reduce__(self):
        return exec, ("import sys; sys.modules['test_tracked_take_sprung'] = True",)


def test_nothing_is_ever_unpickled(take, tmp_path):
    path = tmp_path / "take.npz"
    take.save(path)
    trap = np.empty(1, dtype=object)
    trap[0] = Trap()
    altered(path, qpos=trap)
    assert_refused(path, "not a tracked take")
    assert "test_tracked_take_sprung" not in sys.modules


def test_files_hold_the_joint_positions(take, tmp_path):
    take.save(tmp_path / "take.npz")
    with np.load(tmp_path / "take.npz") as stored:
        header, keypoints = json.loads(str(stored["header"])), stored["keypoints"]
    assert header["schema"] == 2 and tuple(header["keypoint_names"]) == KEYPOINT_NAMES
    assert keypoints.shape == (FRAMES, 2, 21, 3)
    for index, hand in enumerate(take.hands):
        there = take.status[:, index] != LOST
        expected = hand_keypoints(hand.model, take.qpos[there, index])
        np.testing.assert_allclose(keypoints[there, index], expected)
        assert np.isnan(keypoints[~there, index]).all()


def test_takes_of_schema_one_still_open(take, tmp_path):
    """Files from before had no joint positions."""
    path = tmp_path / "take.npz"
    take.save(path)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name != "keypoints"}
    header = json.loads(str(arrays.pop("header")))
    del header["keypoint_names"]
    np.savez(path, header=np.array(json.dumps(header | {"schema": 1})), **arrays)
    np.testing.assert_array_equal(load_tracked_take(path).qpos, take.qpos)
    np.testing.assert_array_equal(load_tracked_take(path).keypoints(), take.keypoints())
