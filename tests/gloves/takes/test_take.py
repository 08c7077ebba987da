"""Takes: what fits together and what follows; files are exact, refused in a sentence, and never unpickled."""

from __future__ import annotations

import dataclasses
import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gloves import GloveFit, RigidBody, Take, attach, load_layout, load_take
from gloves.fit import nominal_fit
from gloves.takes.archives import SCHEMA
from gloves.takes.motion_formats import MOTION_FORMATS
from gloves.takes.points import FRAMES as COLUMNS_OF_FRAMES
from gloves.takes.take import INITIALIZED, LOST, STATUSES, TRACKED, TRUTH_SUFFIX, usual_rate
from gloves.takes.worn import FormerHands
from handsim import HandModel, join_qpos, sample_shape
from handsim.errors import ArgumentError, CaptureError, HandSimWarning
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints, is_steady
from handsim.space.transforms import random_quaternions
from tests.sentences import error_names

FRAMES, COLUMNS, MARKERS = 9, 47, 19
PEN = RigidBody("pen", ("Pen1", "Pen2", "Pen3"), 0.05 * np.eye(3))
DAMAGED = "not a take, or a damaged one"
NUM_FRAMES = 13
HANDS = tuple(nominal_fit(load_layout("dense19"), "M", side) for side in ("right", "left"))
WAND = RigidBody("wand", (), np.empty((0, 3)))


@pytest.fixture
def take(rng) -> Take:
    """A tracked take of two hands and a pen; column c has label c - 6, the first columns ghosts."""
    hands = []
    for side in ("left", "right"):
        shape = sample_shape(side=side, rng=rng)
        hands.append(attach(load_layout("dense19"), HandModel(shape)))
    status = rng.integers(len(STATUSES), size=(FRAMES, 2)).astype(np.int8)
    status[[0, 4]], status[5] = TRACKED, LOST
    qpos = rng.normal(size=(FRAMES, 2, 27))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    qpos[status == LOST] = np.nan
    points = rng.normal(size=(FRAMES, COLUMNS, 3))
    labels = np.tile(np.maximum(np.arange(COLUMNS) - 6, -1), (FRAMES, 1))
    for number in range(2):  # a lost hand has no labels
        labels[(status[:, [number]] == LOST) & (labels // MARKERS == number) & (labels >= 0)] = -1
    gone = rng.random((FRAMES, COLUMNS)) < 0.2
    points[gone], labels[gone] = np.nan, -1
    body_status = rng.integers(len(STATUSES), size=(FRAMES, 1)).astype(np.int8)
    body_poses = np.where((body_status == LOST)[..., None], np.nan, rng.normal(size=(FRAMES, 1, 7)))
    body_poses[..., 3:7] /= np.linalg.norm(body_poses[..., 3:7], axis=-1, keepdims=True)
    return Take(
        rate=120.0,
        times=np.cumsum(rng.uniform(0.005, 0.02, size=FRAMES)),
        hands=tuple(hands),
        qpos=qpos,
        status=status,
        rms=np.where(status == TRACKED, 1e-3 * rng.random((FRAMES, 2)), np.nan),
        points=points,
        ids=np.where(gone, -1, rng.integers(100_000, size=gone.shape)),
        labels=labels,
        confidence=np.where(gone, np.nan, rng.random(gone.shape)),
        bodies=(PEN,),
        body_poses=body_poses,
        body_status=body_status,
        body_rms=rng.random((FRAMES, 1)),
        settings={"glove": "dense19"},
    )


@pytest.fixture
def truth(take, rng) -> Take:
    """The truth of a simulated take of a hand with a glove of its own, and a smaller one."""
    hands = (nominal_fit(load_layout("sparse13"), "XS", "left"), take.hands[1])
    qpos = np.stack([join_qpos(0.3 * rng.random((FRAMES, 20))) for _ in range(2)], axis=1)
    labels = np.where(take.labels < 32, take.labels, -1)
    return Take.of_truth(hands, qpos, take.points, take.ids, labels, rate=90.0, settings={"seed": 3})


def altered(path, **arrays) -> None:
    """Write the take anew with some arrays replaced, None taking one away."""
    with np.load(path) as stored:
        old = {name: stored[name] for name in stored.files}
    kept = {name: array for name, array in (old | arrays).items() if array is not None}
    with path.open("wb") as file:
        np.savez_compressed(file, **kept)


def header_of(path) -> dict:
    with np.load(path) as stored:
        return json.loads(str(stored["header"]))


def assert_refused(path, *words: str) -> None:
    with error_names(CaptureError, " | ".join([f"{path}: ", *words])):
        load_take(path)


def test_what_is_saved_is_what_is_read(take, truth, tmp_path):
    streamed = dataclasses.replace(take, numbers=np.arange(FRAMES) + 5)
    for number, original in enumerate((take, truth, take.without_body(), streamed)):
        path = tmp_path / f"{number}.npz"
        original.save(path)
        again = load_take(path)
        assert (again.rate, again.settings) == (original.rate, original.settings)
        for field in dataclasses.fields(Take):
            ours, theirs = getattr(original, field.name), getattr(again, field.name)
            if isinstance(ours, np.ndarray):
                assert ours.dtype == theirs.dtype
                np.testing.assert_array_equal(ours, theirs)
        assert (again.numbers is None) == (original.numbers is None)
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


def test_arrays_become_those_of_the_table(take):
    lists = {column.name: getattr(take, column.name).tolist() for column in COLUMNS_OF_FRAMES}
    again = dataclasses.replace(take, **lists)
    for column in COLUMNS_OF_FRAMES:
        assert getattr(again, column.name).dtype == column.dtype
        np.testing.assert_array_equal(getattr(again, column.name), getattr(take, column.name))


def test_a_truth_is_tracked_and_sure(truth):
    assert (truth.status == TRACKED).all() and np.isnan(truth.rms).all()
    assert (truth.confidence[np.isfinite(truth.points[..., 0])] == 1.0).all()
    np.testing.assert_allclose(truth.times, np.arange(FRAMES) / 90.0)
    assert truth.hand_labels == (range(13), range(13, 32))
    left = truth.hands[0].markers(truth.qpos[:, 0])[0]
    filled = truth.filled("left")
    np.testing.assert_allclose(truth.markers("left")[filled], left[filled], atol=1e-12)


def test_poses_alone_are_a_take(take, rng):
    qpos = join_qpos(rng.random((4, 20)))[:, None]
    qpos[2] = np.nan
    mine = Take.of_poses(take.hands[:1], qpos, rate=30.0, bodies=[PEN])
    assert mine.status[:, 0].tolist() == [TRACKED, TRACKED, LOST, TRACKED]
    assert mine.points.shape == (4, 0, 3) and (mine.body_status == LOST).all()
    with pytest.raises(ArgumentError, match=r"rate \[Hz\] is 0"):
        Take.of_poses(take.hands[:1], qpos, rate=0.0)
    with pytest.raises(ArgumentError, match=r"qpos has shape \(4, 1, 27\), expected \(4, 2, 27\)"):
        Take.of_poses(take.hands, qpos, rate=30.0)
    with pytest.raises(ArgumentError, match="hands is a GloveFit, expected a list of GloveFits"):
        Take.of_poses(take.hands[0], qpos, rate=30.0)
    with pytest.raises(ArgumentError, match="a hand is a HandModel, expected a GloveFit"):
        Take.of_poses([take.hands[0].model], qpos, rate=30.0)
    with pytest.raises(ArgumentError, match="are these degrees"):
        Take.of_poses(
            take.hands[:1], np.concatenate([qpos[..., :7], np.rad2deg(qpos[..., 7:])], -1), rate=30.0
        )
    with pytest.raises(ArgumentError, match="are these millimeters"):
        Take.of_poses(take.hands[:1], qpos + 300.0 * np.eye(27)[2], rate=30.0)


def test_a_folder_is_no_take(tmp_path):
    with pytest.raises(CaptureError, match=r"this is a folder, expected a take \(.npz\)"):
        load_take(tmp_path)


@pytest.mark.parametrize("rate", [30, np.int64(30), np.float32(30.0)])
def test_rates_may_be_whole_numbers_and_numpys(take, rng, tmp_path, rate):
    mine = Take.of_poses(take.hands[:1], join_qpos(rng.random((4, 20)))[:, None], rate=rate)
    mine.save(tmp_path / "mine.npz")
    assert load_take(tmp_path / "mine.npz").rate == 30.0
    for wrong in (0.0, -1.0, 1e-15, np.nan, np.inf):
        with pytest.raises(ArgumentError, match="number is not from 1e-12"):
            dataclasses.replace(mine, rate=wrong)


def test_an_arch_comes_back_and_a_file_without_one_lacks_it(take, rng, tmp_path):
    hand = take.hands[0]
    arched = GloveFit(HandModel(dataclasses.replace(hand.shape, arch=[0.1, 0.4])), hand.attachment)
    poses = join_qpos(rng.random((4, 20)))[:, None]
    for first, last in ((hand, hand), (hand, arched), (arched, hand)):
        mine = Take.of_poses([last], poses, rate=30.0)
        dataclasses.replace(mine, former=(FormerHands(2, (first,), "M"),)).save(tmp_path / "mine.npz")
        again = load_take(tmp_path / "mine.npz")
        np.testing.assert_array_equal(again.hands[0].shape.arch, last.shape.arch)
        np.testing.assert_array_equal(again.former[0].hands[0].shape.arch, first.shape.arch)
        with np.load(tmp_path / "mine.npz") as file:
            assert ("arch" in file) == (last is arched)
            assert ("arch" in file["former_hands"].dtype.names) == (first is arched)


def test_labels_count_through_hands_and_bodies(take):
    names = take.label_names
    assert (names[0], names[MARKERS], names[-1]) == ("left:ThumbCMC", "right:ThumbCMC", "pen:Pen3")
    assert len(names) == 2 * MARKERS + 3
    for of, labels in (("left", range(19)), ("right", range(19, 38)), ("pen", range(38, 41))):
        observed = take.observed(of)
        np.testing.assert_array_equal(observed, take.observed(labels))
        for marker, label in enumerate(labels):  # the fixture has label c - 6 in column c
            seen = take.labels[:, label + 6] == label
            np.testing.assert_array_equal(observed[seen, marker], take.points[seen, label + 6])
            assert np.isnan(observed[~seen, marker]).all()
    with pytest.raises(ArgumentError, match="unknown hand or body 'middle'"):
        take.observed("middle")


def test_labeled_points_become_columns_and_lose_none(take):
    capture = take.labeled_capture()
    assert capture.names[: len(take.label_names)] == take.label_names
    assert np.isfinite(capture.positions).sum() == np.isfinite(take.points).sum()
    frame, column = np.argwhere(take.labels >= 0)[-1]
    np.testing.assert_array_equal(
        capture.positions[frame, take.labels[frame, column]], take.points[frame, column]
    )


def test_hands_with_other_gloves_keep_their_own_columns(truth):
    names = truth.labeled_capture().names
    assert names[: len(truth.label_names)] == truth.label_names
    right = truth.hand_labels[1]
    seen = truth.point_list.without(truth.point_list.labels < right.start)
    alone = dataclasses.replace(truth, point_list=seen)
    assert alone.labeled_capture().names[: len(right)] == truth.label_names[right.start : right.stop]


def test_points_of_a_body_have_no_names_of_a_hand(take):
    bodies = take.point_list.without(take.point_list.labels < take.hand_labels[-1].stop)
    capture = dataclasses.replace(take, point_list=bodies).labeled_capture(sides=False)
    assert capture.names[:MARKERS] == take.hands[0].layout.names
    assert np.isnan(capture.positions[:, :MARKERS]).all() and np.isfinite(capture.positions).any()


@pytest.mark.parametrize("rate", ["x", None])
def test_rates_are_numbers(take, truth, rate):
    poses = truth.qpos
    for make in (
        lambda: Take.of_poses(truth.hands, poses, rate=rate),
        lambda: dataclasses.replace(take, rate=rate),
        lambda: take.export("never.csv", rate="x"),
    ):
        with pytest.raises(ArgumentError, match=r"the rate \[Hz\] is ('x'|None)"):
            make()
    with pytest.raises(ArgumentError, match="not a take: qpos"):
        Take.of_poses(truth.hands, None, rate=60.0)


def test_paths_are_paths(take):
    with pytest.raises(ArgumentError, match=r"path is 3, expected the path of a \.npz file"):
        take.save(3)
    with pytest.raises(ArgumentError, match="path is 3"):
        take.export(3)


def test_what_was_seen_is_told_from_what_is_filled_in(take):
    for number, side in enumerate(take.sides):
        seen, filled, markers = take.observed(side), take.filled(side), take.markers(side)
        there = take.status[:, number] != LOST
        np.testing.assert_array_equal(filled, np.isnan(seen[..., 0]) & there[:, None])
        np.testing.assert_array_equal(markers[np.isfinite(seen)], seen[np.isfinite(seen)])
        expected = take.hands[number].markers(take.qpos[there, number])[0]
        np.testing.assert_allclose(markers[there][filled[there]], expected[filled[there]], atol=1e-12)
        assert np.isnan(markers[~there]).all()


def test_filled_markers_are_shifted_as_the_glove_has_slipped(take, rng):
    worn, frames = take.hands[0], 60
    qpos = join_qpos(0.5 * rng.random((frames, 20)), position=rng.normal(size=(frames, 3)))
    bones = worn.model.forward_kinematics(qpos)[:, worn.attachment.main_bones, :3, :3]
    slipped = rng.normal(scale=0.004, size=(MARKERS, 3))
    points = worn.markers(qpos)[0] - np.einsum("tmij,mj->tmi", bones, slipped)
    labels, ids = np.tile(np.arange(MARKERS), (frames, 1)), np.zeros((frames, MARKERS), dtype=int)
    labels[50:, 3] = -1
    truth = Take.of_truth([worn], qpos[:, None], points, ids, labels, rate=60.0)
    assert not truth.marker_bias("left").any(), "of true poses nothing is learned"
    fitted = dataclasses.replace(truth, rms=np.full((frames, 1), 1e-3))
    np.testing.assert_allclose(fitted.marker_bias("left"), slipped, atol=1e-9)
    np.testing.assert_allclose(fitted.markers("left"), points, atol=1e-9)
    few = fitted.cut(0, 20)
    assert not few.marker_bias("left").any() and few.num_frames == 20


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


def test_parts_keep_their_times_and_numbers(take):
    part = dataclasses.replace(take, numbers=np.arange(FRAMES)).cut(2, 5)
    assert part.numbers.tolist() == [2, 3, 4] and part.num_frames == 3
    for column in COLUMNS_OF_FRAMES:
        np.testing.assert_array_equal(getattr(part, column.name), getattr(take, column.name)[2:5])
    for first, last in ((-1, 3), (3, 3), (0, FRAMES + 1)):
        with pytest.raises(ArgumentError, match="expected a part"):
            take.cut(first, last)


def test_angles_have_names_and_frames_a_status(take):
    spread = np.linspace(0.0, 1.0, FRAMES * 40).reshape(FRAMES, 2, 20)
    angles = take.angles("right")
    assert tuple(angles) == take.joint_names and len(take.joint_names) == 20
    np.testing.assert_array_equal(angles["index_PIP_flexion"], take.qpos[:, 1, 7 + 6])
    assert np.isnan(take.angle_spreads("left")["thumb_metacarpal_flexion"]).all(), "not known"
    known = dataclasses.replace(take, angle_spread=spread).angle_spreads("left")
    np.testing.assert_allclose(known["thumb_metacarpal_flexion"], spread[:, 0, 1], rtol=1e-6)
    np.testing.assert_array_equal(take.is_tracked("left"), take.status[:, 0] >= INITIALIZED)
    assert not take.made_by_tracker
    with pytest.raises(ArgumentError, match="unknown hand 'middle'"):
        take.angles("middle")
    for named in (angles, known, take.angles("right", convention="isb")):
        with pytest.raises(
            ArgumentError, match=r"unknown angle 'index_PIP_flex' \(did you mean 'index_PIP_flexion'"
        ):
            named["index_PIP_flex"]
        assert named.get("index_PIP_flex") is None


def test_angles_may_be_the_isbs_and_begin_at_a_neutral_pose(take):
    found = take.angles("right", convention="isb")
    assert len(found) == 25 and not any("CMC" in name for name in (*found, *take.joint_names))
    there = np.isfinite(take.qpos[:, 1, 0])
    assert np.isfinite(found["little_MCP_ulnar_deviation"]).tolist() == there.tolist()
    still = dataclasses.replace(take, qpos=np.where(np.isfinite(take.qpos), take.qpos[there, 1][0], np.nan))
    between = (take.times[0], take.times[-1])
    for convention in ("model", "isb"):
        for values in still.angles("right", convention=convention, neutral=between).values():
            np.testing.assert_allclose(values[there], 0.0, atol=1e-9)
    with pytest.raises(
        ArgumentError, match=r"unknown convention 'ISB' \(did you mean 'isb'\?\); valid names: model, isb"
    ):
        take.angles("right", convention="ISB")
    with pytest.raises(ArgumentError, match="neutral is 900 to 901 s, where the right hand has no pose"):
        take.angles("right", neutral=(900.0, 901.0))
    moving = still.qpos.copy()
    moving[:, 1, 7 + 6] += np.linspace(0.0, 0.5, FRAMES)
    with pytest.warns(
        HandSimWarning, match="the right hand moves from .* index_PIP_flexion by .*; expected a"
    ):
        dataclasses.replace(still, qpos=moving).angles("right", neutral=between)


def test_frames_that_a_stream_lacks_count_in_its_rate_and_have_their_place_in_a_file(take):
    numbers = 40 + np.array([0, 1, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30])[:FRAMES]
    times = 1e5 + numbers / 120.0
    assert usual_rate(times, numbers) == 120.0 == usual_rate(times, 2 * numbers)
    live = dataclasses.replace(take, numbers=numbers, times=times, rate=120.0)
    assert live.duration == pytest.approx((numbers[-1] - numbers[0] + 1) / 120.0)
    for written, dense in (
        (live.labeled_capture(), take.labeled_capture()),
        (live.capture(), take.capture()),
    ):
        assert written.num_frames == numbers[-1] - numbers[0] + 1 and written.rate == 120.0
        np.testing.assert_array_equal(written.positions[numbers - 40], dense.positions)
        assert np.isnan(np.delete(written.positions, numbers - 40, axis=0)).all()


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
        {"labels": take.labels.astype(float)},
        {"ids": take.ids.astype(np.int64) + (1 << 32)},
        {"confidence": take.confidence[:, 1:]},
        {"bodies": ()},
        {"numbers": np.arange(FRAMES - 1)},
        {"confidence": np.where(take.confidence > 0.5, 1.5, take.confidence)},
        {"rms": -take.rms},
        {"points": np.where(take.points > 0.0, np.inf, take.points)},
        {"points": take.points[0]},
        {"body_poses": -np.inf * np.abs(take.body_poses)},
    ):
        with pytest.raises(ArgumentError, match="not a take: "):
            dataclasses.replace(take, **change)


def test_names_of_bodies_are_text():
    with pytest.raises(ArgumentError, match="a name is no text"):
        RigidBody("pen", ("Pen1", 5, "Pen3"), PEN.positions)


def test_foreign_files_are_refused_in_a_sentence(tmp_path):
    contents = {
        "empty": b"",
        "text": b"Frame#\tTime\n",
        "zip that is none": b"PK\x03\x04" + 60 * b"\x00",
        "pickle": b"\x80\x04K\x01.",
    }
    path = tmp_path / f"foreign{TRUTH_SUFFIX}"
    assert_refused(path, "No such file")
    for content in contents.values():
        path.write_bytes(content)
        assert_refused(path, "not a take")
    with path.open("wb") as file:
        np.savez(file, something=np.zeros(3))
    assert_refused(path, "not a take")
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    assert_refused(path, "not a take")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "hello")
    assert_refused(path, "not a take")
    assert_refused(tmp_path)


def test_another_schema_is_named(take, tmp_path):
    path = tmp_path / f"take{TRUTH_SUFFIX}"
    take.save(path)
    header = header_of(path)
    altered(path, header=np.array(json.dumps(header | {"schema": SCHEMA + 1})))
    assert_refused(path, f"a take of schema {SCHEMA + 1}, expected a take of schema {SCHEMA}")
    altered(path, header=np.array(json.dumps(header | {"kind": "tracked take", "schema": 2})))
    assert_refused(path, f"a tracked take of schema 2, expected a take of schema {SCHEMA}", "track it again")
    altered(path, header=np.array(json.dumps(header | {"kind": "picture"})))
    assert_refused(path, "a picture, expected a take")


@pytest.mark.parametrize("name", ["take.npz", "take.npz.part"])
def test_files_of_schema_3_are_read(name, tmp_path, recwarn):
    """Their points were tables with a row per frame; the files were written by the version before."""
    old = load_take(Path(__file__).parent / "schema3" / name)
    assert (old.points.shape, old.label_names[-1]) == ((4, 24, 3), "pen:Pen3")
    there = np.isfinite(old.points[..., 0])
    np.testing.assert_array_equal(old.ids, np.where(there, np.arange(24), -1))
    np.testing.assert_array_equal(old.labels, old.ids)
    assert (old.point_list.counts.tolist() == [24, 23, 4, 24]) == (name == "take.npz")
    old.save(tmp_path / "new.npz")
    new = load_take(tmp_path / "new.npz")
    assert header_of(tmp_path / "new.npz")["schema"] == SCHEMA
    for table in ("points", "ids", "labels", "confidence", "qpos", "times"):
        np.testing.assert_array_equal(getattr(new, table), getattr(old, table))


def test_damage_is_told_wherever_it_is(take, tmp_path, rng):
    path = tmp_path / f"take{TRUTH_SUFFIX}"
    take.save(path)
    whole = path.read_bytes()
    for place in rng.integers(len(whole) - 1, size=60):  # cut
        path.write_bytes(whole[:place])
        assert_refused(path, DAMAGED)
    refused = 0
    for place in rng.integers(len(whole), size=150):  # one byte wrong: some bytes of a zip mean nothing
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            load_take(path).save(tmp_path / "copy.npz")
        except CaptureError as error:
            refused += 1
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
        else:
            assert (tmp_path / "copy.npz").read_bytes() == whole
    assert refused > 100


def test_arrays_that_do_not_fit_together_are_refused(take, tmp_path):
    path = tmp_path / "take.npz"
    dataclasses.replace(take, numbers=np.arange(FRAMES)).save(path)
    whole, header = path.read_bytes(), header_of(path)
    with np.load(path) as stored:
        names = set(stored.files) - {"numbers"}
        wrong = {
            "points": stored["points"][:, :2],
            "point_counts": stored["point_counts"] + np.uint32(1),
            "point_columns": stored["point_columns"][::-1],
            "ids": stored["ids"][1:],
            "qpos": stored["qpos"][1:],
            "keypoints": stored["keypoints"][:, :, 1:],
            "labels": np.full_like(stored["labels"], 44),
            "confidence": stored["confidence"].astype("f4"),
            "numbers": np.arange(FRAMES, dtype=float),
            "hands": np.zeros(2),
            "attachment_bone_indices": stored["attachment_bone_indices"] + 16,
            "attachment_points": stored["attachment_points"].astype("f4"),
            "attachment_normals": stored["attachment_normals"][1:],
            "body_markers": stored["body_markers"][1:],
            "header": np.array(json.dumps(header | {"layouts": header["layouts"][:1]})),
        }
    for name, array in (*wrong.items(), *dict.fromkeys(names).items()):
        path.write_bytes(whole)
        altered(path, **{name: array})
        assert_refused(path, DAMAGED)
    for change in (
        {"rate": "fast"},
        {"rate": -1.0},
        {"layouts": [{"name": "x"}] * 2},
        {"layouts": None},
        {"statuses": []},
    ):
        path.write_bytes(whole)
        altered(path, header=np.array(json.dumps(header | change)))
        assert_refused(path, DAMAGED)
    for text in ("[]", "3", "{", '{"kind": "take"}', f'{{"schema": {SCHEMA}}}'):
        altered(path, header=np.array(text))
        assert_refused(path, DAMAGED)


class Trap:
    """Whoever unpickles it leaves a mark."""

    def __reduce__(self):
        return exec, ("import sys; sys.modules['test_take_sprung'] = True",)


def test_nothing_is_ever_unpickled(take, tmp_path):
    path = tmp_path / f"take{TRUTH_SUFFIX}"
    take.save(path)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    sys.modules.pop("test_take_sprung", None)
    for name in ("header", "points", "qpos", "more"):
        with path.open("wb") as file:
            np.savez(file, **arrays | {name: np.array([Trap()], dtype=object)})
        assert_refused(path, DAMAGED)
        assert "test_take_sprung" not in sys.modules
    with np.load(path, allow_pickle=True) as stored:  # the trap works
        _ = stored["more"]
    assert sys.modules.pop("test_take_sprung")


def test_files_hold_the_joint_positions(take, tmp_path):
    take.save(tmp_path / "take.npz")
    with np.load(tmp_path / "take.npz") as stored:
        header, keypoints = json.loads(str(stored["header"])), stored["keypoints"]
    assert header["schema"] == SCHEMA and tuple(header["keypoint_names"]) == KEYPOINT_NAMES
    assert keypoints.shape == (FRAMES, 2, 21, 3)
    np.testing.assert_array_equal(keypoints, take.keypoints())
    for index, hand in enumerate(take.hands):
        there = take.status[:, index] != LOST
        expected = hand_keypoints(hand.model, take.qpos[there, index])
        np.testing.assert_allclose(keypoints[there, index], expected)
        assert np.isnan(keypoints[~there, index]).all()
    assert INITIALIZED == STATUSES.index("found")


@pytest.fixture
def moving(rng) -> Take:
    qpos = join_qpos(0.5 * rng.random((2 * NUM_FRAMES, 20)), position=rng.normal(size=(2 * NUM_FRAMES, 3)))
    qpos[:, 3:7] = random_quaternions(2 * NUM_FRAMES, rng=rng)
    qpos = qpos.reshape(NUM_FRAMES, 2, 27)
    qpos[[0, 1, 5, 6], 1] = np.nan
    poses = np.concatenate(
        [rng.normal(size=(NUM_FRAMES, 3)), random_quaternions(NUM_FRAMES, rng=rng)], axis=1
    )
    return Take.of_poses(HANDS, qpos, rate=60.0, bodies=[WAND], body_poses=poses[:, None])


def present(moving: Take) -> np.ndarray:
    return moving.status != LOST


def test_the_old_rate_changes_nothing(moving):
    again = moving.poses_alone(moving.rate)
    np.testing.assert_array_equal(present(moving), present(again))
    np.testing.assert_allclose(moving.qpos[..., 7:], again.qpos[..., 7:], atol=1e-12)
    for ours, others in ((moving.qpos, again.qpos), (moving.body_poses, again.body_poses)):
        np.testing.assert_allclose(ours[..., :3], others[..., :3], atol=1e-12)
        same = np.abs((ours[..., 3:7] * others[..., 3:7]).sum(axis=-1))
        np.testing.assert_allclose(same[np.isfinite(same)], 1.0)


def test_frames_beside_a_missing_one_are_missing(moving):
    twice, old = present(moving.poses_alone(2 * moving.rate))[:, 1], present(moving)[:, 1]
    assert len(twice) == 2 * len(old) - 1
    np.testing.assert_array_equal(twice[::2], old)
    np.testing.assert_array_equal(twice[1::2], old[1:] & old[:-1])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_between_frames_everything_is_straight(seed, share):
    rng = np.random.default_rng(seed)
    qpos = join_qpos(rng.normal(size=(2, 20)), position=rng.normal(size=(2, 3)))
    qpos[:, 3:7] = random_quaternions(2, rng=rng)
    moving = Take.of_poses(HANDS[:1], qpos[:, None], rate=20.0)
    middle = moving.poses_alone(1.0 / (0.05 * share)).qpos[1, 0]
    straight = qpos[0] + share * (qpos[1] - qpos[0])
    np.testing.assert_allclose(middle[[*range(3), *range(7, 27)]], straight[[*range(3), *range(7, 27)]])
    first, last, found = (Rotation.from_quat(q[3:7], scalar_first=True) for q in (*qpos, middle))
    whole = (first.inv() * last).magnitude()
    assert (first.inv() * found).magnitude() == pytest.approx(share * whole, abs=1e-7)
    assert (found.inv() * last).magnitude() == pytest.approx((1 - share) * whole, abs=1e-7)


def test_a_hole_in_a_stream_is_held_in_formats_without_times(rng, tmp_path):
    times = np.concatenate([np.arange(10) / 100, 1.0 + np.arange(10) / 100])
    qpos = join_qpos(rng.normal(size=(20, 20)), position=np.ones(3))
    moving = Take.of_poses(HANDS[:1], qpos[:, None], rate=100.0, times=times)
    assert not is_steady(moving.times, moving.rate)
    moving.export(tmp_path / "hands.trc")
    rows = (tmp_path / "hands.trc").read_text().split("\tX1\t")[1].splitlines()[1:]
    found = np.array([row.split("\t")[26:29] for row in rows if row], dtype=float)
    assert found.shape == (110, 3) and (found[9:100] == found[9]).all() and (found[100] != found[9]).any()
    moving.export(tmp_path / "hands.csv")
    assert len((tmp_path / "hands.csv").read_text().splitlines()) == 21


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e12])
def test_rates_that_cannot_be(moving, rate):
    with pytest.raises(ArgumentError, match="expected"):
        moving.poses_alone(rate)


def test_what_has_no_pose_is_left_out(moving):
    qpos, poses = moving.qpos.copy(), np.full_like(moving.body_poses, np.nan)
    qpos[:, 0] = np.nan
    alone = Take.of_poses(HANDS, qpos, rate=60.0, bodies=[WAND], body_poses=poses).poses_alone()
    assert alone.sides == ("left",) and alone.bodies == () and alone.body_poses.shape == (NUM_FRAMES, 0, 7)
    nobody = dataclasses.replace(moving, qpos=np.full_like(qpos, np.nan), status=np.zeros_like(moving.status))
    with pytest.raises(ArgumentError, match="no hand has a pose"):
        nobody.export("hands.bvh")


def test_a_rate_may_be_a_whole_number_and_an_axis_is_y_or_z(moving, tmp_path):
    moving.export(tmp_path / "hands.bvh", rate=30)
    with pytest.raises(ArgumentError, match="'Y-axis'; valid names: y, z"):
        moving.export(tmp_path / "other.bvh", up="Y-axis")
    assert [path.name for path in tmp_path.iterdir()] == ["hands.bvh"]
    assert len(moving.keypoint_names) == moving.keypoints().shape[2]


def test_other_endings_are_refused_with_the_valid_ones(moving, tmp_path):
    with error_names(ArgumentError, " | ".join(MOTION_FORMATS)):
        moving.export(tmp_path / "hands.fbx")
    assert not list(tmp_path.iterdir())


def test_a_take_whose_arrays_were_changed_is_not_saved(take, tmp_path):
    take.qpos[0, 0, 3:7] = 0.0
    with pytest.raises(ArgumentError, match="not a take: "):
        take.save(tmp_path / "changed.npz")
    assert not list(tmp_path.iterdir())
