"""Rigid bodies among hands and ghosts: right labels and poses, honest words where too little is seen."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gloves import Capture, Status, Take
from handsim.errors import ArgumentError, CalibrationError
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices, quaternion_matrix, random_quaternions, rigid_fit
from tests.sentences import error_names
from track import RigidTemplate
from track.bodies.rigid_body import (
    BodyError,
    BodyFrame,
    BodyTracker,
    learn_body,
    load_bodies,
    load_body,
    save_body,
)
from train import simulate_take

NAMES = ("controller", "ball", "box", "mug")
STEP = 1.0 / 120.0
NOISE = 0.0002  # [m]
FRAMES = 240
NUMBERS = st.sampled_from([0.0, 0.01, -0.02, 0.05, 1e-300, 999.0]) | st.floats(-1.0, 1.0)
TIMES = st.sampled_from([0.0, STEP, 2 * STEP, -1.0, 1e9, np.nan, np.inf])
FILE_NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8)


@functools.cache
def twin() -> Take:
    return simulate_take(kind="hand-controller", num_frames=FRAMES, seed=5)


def frames(take: Take):
    """Points, IDs and the body's true labels, frame by frame."""
    first = take.hand_labels[-1].stop
    for points, ids, labels in zip(take.points, take.ids, take.labels, strict=True):
        there = np.isfinite(points[:, 0])
        yield points[there], ids[there], np.where(labels >= first, labels - first, -1)[there]


def template(name: str) -> RigidTemplate:
    return RigidTemplate.of(named_object(name))


def transform(rng) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = quaternion_matrix(random_quaternions(1, rng=rng))[0]
    pose[:3, 3] = rng.uniform(-0.3, 0.3, 3)
    return pose


def seen(body: RigidTemplate, pose: np.ndarray, rng, *, without: tuple[int, ...] = (), strays: int = 40):
    """The body's markers and strays around them in any order, with what each is."""
    markers = body.positions @ pose[:3, :3].T + pose[:3, 3] + rng.normal(0.0, NOISE, body.positions.shape)
    labels = np.setdiff1d(np.arange(len(markers)), without)
    points = np.vstack([markers[labels], rng.uniform(-0.4, 0.4, (strays, 3))])
    labels = np.append(labels, np.full(strays, -1))
    order = rng.permutation(len(points))
    return points[order], labels[order]


def apart(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance [m] and turn [deg] between two poses."""
    cosine = (np.trace(pose[:3, :3] @ truth[:3, :3].T) - 1.0) / 2.0
    return float(np.linalg.norm(pose[:3, 3] - truth[:3, 3])), float(np.rad2deg(np.arccos(min(cosine, 1.0))))


def test_every_frame_of_a_twin_is_right():
    take = twin()
    tracker = BodyTracker(template("controller"))
    errors = []
    for number, (points, ids, labels) in enumerate(frames(take)):
        frame = tracker.step(points, ids, number / take.rate)
        assert frame.status == (Status.TRACKED if number else Status.INITIALIZED)
        np.testing.assert_array_equal(frame.labels, labels)
        assert frame.rms < 0.0015
        errors.append(apart(frame.T_world_body, pose_matrices(take.body_poses[number])[0]))
    away, turned = np.array(errors).T
    assert np.median(away) < 0.0005 and away.max() < 0.005
    assert np.median(turned) < 0.3 and turned.max() < 3.0


def test_the_same_without_ids():
    tracker = BodyTracker(template("controller"))
    for number, (points, ids, labels) in enumerate(frames(twin())):
        frame = tracker.step(points, np.full(len(ids), -1), number * STEP)
        assert not ((frame.labels >= 0) & (frame.labels != labels)).any()
        assert frame.status in (Status.INITIALIZED, Status.TRACKED)


@pytest.mark.parametrize("name", NAMES)
def test_a_body_is_not_found_among_hands_that_do_not_hold_it(name):
    tracker = BodyTracker(template(name))
    for number, (points, ids, labels) in enumerate(frames(twin())):
        frame = tracker.step(points[labels < 0], ids[labels < 0], number * STEP)
        assert frame.status == Status.LOST and frame.T_world_body is None
        assert (frame.labels == -1).all() and np.isnan(frame.rms)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1))
def test_bodies_are_found_at_once_in_any_pose_and_order(name, seed):
    rng = np.random.default_rng(seed)
    body, pose = template(name), transform(rng)
    points, labels = seen(body, pose, rng)
    frame = BodyTracker(body).step(points, np.arange(len(points)), 0.0)
    assert frame.status == Status.INITIALIZED
    np.testing.assert_array_equal(frame.labels[labels >= 0], labels[labels >= 0])
    assert (frame.labels[labels < 0] == -1).all()
    away, turned = apart(frame.T_world_body, pose)
    assert away < 0.002 and turned < 1.5


def test_three_of_more_markers_follow_a_body_but_do_not_find_it(rng):
    body, pose = template("mug"), transform(rng)
    tracker = BodyTracker(body)
    for number in range(30):
        points, _ = seen(body, pose, rng, without=(1,), strays=0)
        assert tracker.step(points, np.arange(3), number * STEP).status == Status.LOST
    points, labels = seen(body, pose, rng)
    assert tracker.step(points, labels, 30 * STEP).status == Status.INITIALIZED
    for number in range(31, 60):
        points, labels = seen(body, pose, rng, without=(1,))
        frame = tracker.step(points, labels, number * STEP)
        assert frame.status == Status.TRACKED
        np.testing.assert_array_equal(frame.labels, labels)


def test_markers_that_lie_like_others_are_not_enough(rng):
    body, pose = template("controller"), transform(rng)
    for number in range(5):  # four on a circle, two by two
        points, labels = seen(body, pose, rng, without=(2, 5), strays=0)
        tracker = BodyTracker(body)
        assert tracker.step(points, labels, number * STEP).status == Status.LOST


def test_a_body_of_three_markers_is_believed_after_a_while(rng):
    body = RigidTemplate("three", ("a", "b", "c"), np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.08, 0]]))
    tracker, pose = BodyTracker(body), transform(rng)
    words = []
    for number in range(12):
        points, labels = seen(body, pose, rng, strays=3)
        frame = tracker.step(points, np.arange(len(points)), number * STEP)
        words.append(frame.status)
    assert words == [Status.LOST] * 9 + [Status.INITIALIZED] + [Status.TRACKED] * 2
    np.testing.assert_array_equal(frame.labels, labels)


def test_a_body_coasts_a_little_and_is_found_again_where_it_was(rng):
    body, pose = template("box"), transform(rng)
    tracker = BodyTracker(body)
    words: list[BodyFrame] = []
    for number in range(40):
        pose[:3, 3] += (0.004, 0.0, 0.0)  # 0.48 m/s
        without = (0, 1, 2, 3) if 10 <= number < 20 else (0, 1) if 20 <= number < 30 else ()
        points, labels = seen(body, pose, rng, without=without)
        ids = np.where(labels >= 0, labels + (100 if number >= 20 else 0), -1)
        words.append(tracker.step(points, ids, number * STEP))
        if words[-1].T_world_body is not None:
            assert apart(words[-1].T_world_body, pose)[0] < 0.003
        assert not ((words[-1].labels >= 0) & (words[-1].labels != labels)).any()
    assert [frame.status for frame in words] == [
        Status.INITIALIZED, *[Status.TRACKED] * 9, *[Status.COASTING] * 3, *[Status.LOST] * 7,
        *[Status.LOST] * 10, Status.INITIALIZED, *[Status.TRACKED] * 9
    ]  # fmt: skip
    assert (words[10].labels >= 0).sum() == 1, "the marker that is left"


@pytest.mark.parametrize("has_moved", [False, True])
def test_two_of_three_markers_keep_labels_and_find_the_body_at_once(rng, has_moved):
    """The third is away for half a second, in which the body moves too far to be searched near its place."""
    body = RigidTemplate("three", ("a", "b", "c"), np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.08, 0]]))
    tracker, pose = BodyTracker(body), transform(rng)
    for number in range(90):
        pose[:3, 3] += (0.003, 0.0, 0.0)
        is_away = 20 <= number < 80
        points, labels = seen(body, pose, rng, without=(2,) if is_away else (), strays=0)
        if is_away and has_moved:  # An exchanged ID is no marker of the body.
            points[labels == 1] += (0.0, 0.2, 0.0)
        ids = np.where(labels == 2, 2 + number // 50, labels)
        frame = tracker.step(points, ids, number * STEP)
        assert not is_away or number < 24 or frame.status == Status.LOST
        if number >= 10 and not has_moved:
            np.testing.assert_array_equal(frame.labels, labels)
        elif number >= 24 and is_away:
            assert (frame.labels < 0).all()
        if number == 80:
            assert (frame.status == Status.INITIALIZED) != has_moved


@pytest.mark.parametrize("forearm", ["right", None])
def test_a_marker_amid_the_muscles_of_a_forearm_keeps_its_label(rng, forearm):
    places = np.array([[0, 0, 0], [0.06, 0, 0], [0.02, 0.05, 0], [0.15, 0.02, 0.03], [0.1, 0.04, 0.0]])
    tracker, pose = BodyTracker(RigidTemplate("arm", tuple("abcde"), places, None, forearm)), transform(rng)
    for number in range(60):
        away = 0.012 * min(number / 20, 1.0) if number < 50 else 0.03
        points, labels = seen(tracker.template, pose, rng, strays=0)
        points[labels == 3] += (0.0, away if number not in {40, 41} else 1.0, 0.0)
        ids = np.where(labels == 3, 30 + number // 40, labels)  # It is seen again as another point.
        frame = tracker.step(points, ids, number * STEP)
        np.testing.assert_array_equal(frame.labels[labels != 3], labels[labels != 3])
        if number >= 20:
            is_kept = forearm == "right" and number < 50 and number not in {40, 41}
            assert (frame.labels[labels == 3] == (3 if is_kept else -1)).all(), number


def test_three_markers_near_where_it_was_find_it_again(rng):
    body, pose = template("box"), transform(rng)
    tracker, words = BodyTracker(body), []
    for number in range(20):
        pose[:3, 3] += (0.0, 0.002, 0.0)
        without = tuple(range(5)) if 10 <= number < 14 else (0, 1) if number >= 14 else ()
        points, labels = seen(body, pose, rng, without=without)
        ids = np.where(labels >= 0, labels + (100 if number >= 14 else 0), -1)
        words.append(tracker.step(points, ids, number * STEP).status)
    assert words[13:16] == [Status.LOST, Status.INITIALIZED, Status.TRACKED]


def test_ids_that_change_places_or_are_used_again_do_not_mislead(rng):
    body, pose = template("controller"), transform(rng)
    tracker = BodyTracker(body)
    for number in range(40):
        pose[:3, 3] += (0.001, 0.001, 0.0)
        points, labels = seen(body, pose, rng, without=(3,) if number >= 20 else ())
        ids = labels.copy()
        if number >= 10:  # two markers are taken for each other
            ids[labels == 0], ids[labels == 1] = 1, 0
        if number >= 20:  # a stray takes the ID of a marker that is gone
            ids[np.flatnonzero(labels < 0)[0]] = 3
        frame = tracker.step(points, ids, number * STEP)
        assert frame.status != Status.LOST
        np.testing.assert_array_equal(frame.labels, labels)


@pytest.mark.parametrize("gone", [(5,), (4, 5)])
def test_ghosts_that_drift_off_where_markers_were_take_nothing_along(rng, gone):
    body, pose = template("controller"), transform(rng)
    tracker = BodyTracker(body)
    for number in range(30):
        points, labels = seen(body, pose, rng, without=gone if number >= 10 else ())
        ids = labels.copy()
        if number >= 10:  # one ghost a marker that is gone, one way all of them
            away = pose[:3, :3] @ [0.0, 0.0005 + 0.0007 * (number - 10), 0.0]
            ghosts = body.positions[list(gone)] @ pose[:3, :3].T + pose[:3, 3] + away
            points, labels = np.vstack([points, ghosts]), np.append(labels, np.full(len(gone), -1))
            ids = np.append(ids, 100 + np.arange(len(gone)))
        frame = tracker.step(points, ids, number * STEP)
        assert frame.status != Status.LOST and apart(frame.T_world_body, pose)[0] < 0.002
        np.testing.assert_array_equal(frame.labels[labels >= 0], labels[labels >= 0])
        if number >= 15:
            assert (frame.labels[labels < 0] == -1).all()


def test_two_markers_and_a_ghost_that_turns_about_them_are_no_body(rng):
    body, pose = template("controller"), transform(rng)
    tracker, places = BodyTracker(body), body.positions
    axis = (places[3] - places[0]) / np.linalg.norm(places[3] - places[0])
    arm = places[4] - places[0]
    arm -= (arm @ axis) * axis
    angle = 0.012 / np.linalg.norm(arm)  # 12 mm beside marker 4, as far from the two as it is
    ghost = places[4] + (np.cos(angle) - 1.0) * arm + np.sin(angle) * np.cross(axis, arm)
    for number in range(13):
        points, labels = seen(body, pose, rng, without=(1, 2, 4, 5) if number >= 10 else ())
        ids = labels.copy()
        if number >= 10:
            points = np.vstack([points, pose[:3, :3] @ ghost + pose[:3, 3]])
            labels, ids = np.append(labels, -1), np.append(ids, 100)
        frame = tracker.step(points, ids, number * STEP)
        assert not ((frame.labels >= 0) & (frame.labels != labels)).any()
    assert frame.status == Status.COASTING


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ([[0, 0, 0], [0.05, 0, 0]], "2 markers, expected at least 3, which determine a pose"),
        ([[0, 0, 0], [0.05, 0, 0], [0.12, 0.001, 0]], "lie on one line"),
        ([[0, 0, 0], [0.05, 0, 0], [0.05, 0.004, 0]], "m1 and m2 are 4.0 mm apart, expected at least 6 mm"),
        ([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]], "look the same from two sides (m1 at m2, m2 at m1)"),
        ([[0, 0, 0], [0.08, 0, 0], [0, 0.05, 0], [0.08, 0.05, 0]], "look the same from two sides"),
        ([[0, 0, 0], [0.05, 0, 0], [0, np.nan, 0]], "holds NaN"),
    ],
)  # fmt: skip
def test_constellations_that_tell_no_pose_are_refused(places, words):
    names = tuple(f"m{i}" for i in range(len(places)))
    with error_names(ArgumentError, words):
        RigidTemplate("thing", names, np.array(places, dtype=float))


def test_a_mirrored_constellation_is_another_one(rng):
    places = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.08, 0], [0.02, 0.03, 0.06]])
    body = RigidTemplate("thing", ("a", "b", "c", "d"), places)
    mirrored = RigidTemplate("mirrored", body.marker_names, places * (1, 1, -1))
    points, _ = seen(mirrored, transform(rng), rng, strays=0)
    assert BodyTracker(mirrored).step(points, np.arange(4), 0.0).status == Status.INITIALIZED
    assert BodyTracker(body).step(points, np.arange(4), 0.0).status == Status.LOST


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_stream_content_raises(data):
    rng = np.random.default_rng(0)
    body, pose = template("ball"), transform(rng)
    tracker = BodyTracker(body)
    for number in range(4):
        points, labels = seen(body, pose, rng, strays=5)
        if data.draw(st.booleans()):
            count = data.draw(st.integers(0, 12))
            points = data.draw(arrays.arrays(np.float64, (count, 3), elements=NUMBERS))
            labels = data.draw(arrays.arrays(np.int64, count, elements=st.integers(-2, 5)))
        frame = tracker.step(points, labels, data.draw(TIMES | st.just(number * STEP)))
        assert frame.labels.shape == (len(points),)
        given_out = frame.labels[frame.labels >= 0]
        assert len(np.unique(given_out)) == len(given_out) and (given_out < 4).all()
        assert (frame.T_world_body is None) == (frame.status == Status.LOST)
        if frame.T_world_body is not None:
            np.testing.assert_allclose(
                frame.T_world_body[:3, :3] @ frame.T_world_body[:3, :3].T, np.eye(3), atol=1e-9
            )
        if frame.status in (Status.INITIALIZED, Status.TRACKED):
            assert len(given_out) >= 3 and frame.rms <= 0.003


def test_a_crowd_of_points_is_not_searched_but_a_body_in_it_is_followed(rng):
    body, pose = template("ball"), transform(rng)
    tracker = BodyTracker(body)
    points, labels = seen(body, pose, rng, strays=2000)
    assert tracker.step(points, labels, 0.0).status == Status.LOST
    points, labels = seen(body, pose, rng)
    assert tracker.step(points, labels, STEP).status == Status.INITIALIZED
    points, labels = seen(body, pose, rng, strays=2000)
    assert tracker.step(points, labels, 2 * STEP).status == Status.TRACKED


@st.composite
def bodies(draw) -> RigidTemplate:
    names = draw(st.lists(FILE_NAMES, min_size=3, max_size=8, unique=True))
    places = draw(arrays.arrays(float, (len(names), 3), elements=st.floats(-0.3, 0.3)))
    try:
        return RigidTemplate(draw(FILE_NAMES), tuple(names), places)
    except ArgumentError:  # markers too near to each other, on a line, or alike from two sides
        assume(False)
        raise


@given(body=bodies())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, body: RigidTemplate) -> None:
    path = tmp_path_factory.mktemp("body") / "body.toml"
    save_body(path, body)
    again = load_body(path)
    assert (again.name, again.marker_names) == (body.name, body.marker_names)
    np.testing.assert_allclose(again.positions, body.positions, rtol=0.0, atol=1e-12)
    save_body(path.with_name("again.toml"), again)
    assert path.read_bytes() == path.with_name("again.toml").read_bytes()


def text(*, head: str = 'name = "wand"', count: int = 3, **keys: str) -> str:
    """A good file of `count` markers, of which the second has the given keys replaced (empty: left out)."""
    places = ["[0, 0, 0]", "[50.0, 0, 0]", "[0, 80, 0]", "[0, 0, 30]"]
    tables = []
    for number in range(count):
        values = {"name": f'"m{number}"', "place_mm": places[number]}
        if number == 1:
            values |= keys
        tables.append(
            "[[marker]]\n" + "\n".join(f"{key} = {value}" for key, value in values.items() if value)
        )
    return "\n".join([head, *tables])


def test_files_are_in_millimeters(tmp_path):
    path = tmp_path / "wand.toml"
    path.write_text(text(head='name = "wand"\ndescription = "three on a stick"'))
    body = load_body(path)
    assert (body.name, body.marker_names) == ("wand", ("m0", "m1", "m2"))
    np.testing.assert_allclose(body.positions, [[0, 0, 0], [0.05, 0, 0], [0, 0.08, 0]])


def test_objects_of_handsim_have_names():
    np.testing.assert_array_equal(load_body("mug").positions, named_object("mug").markers)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("name = ", "not a TOML file"),
        ("", "the file lacks the key 'name'"),
        ('name = "wand"', "wand: 0 markers, expected at least 3"),
        (text(head="name = 3"), "name is 3, expected text in quotes"),
        (text(head='name = " wand"'), "the body's name ' wand': expected printable characters"),
        (text(head='name = "wand"\ndescription = 3'), "description is 3, expected text in quotes"),
        (text(head='name = "wand"\nradius_mm = 3'), "the file has an unknown key 'radius_mm'"),
        ('name = "wand"\nmarker = [1, 2]', "marker is not a list of tables"),
        (text(name='"m0"'), "wand: a marker name is there twice: m0, m0, m2"),
        (text(name='"a\\tb"'), "marker name 'a\\tb': expected printable characters"),
        (text(name=""), "marker number 2 lacks the key 'name'"),
        (text(place_mm=""), "marker 'm1' lacks the key 'place_mm'"),
        (text(place="[1, 2, 3]"), "marker 'm1' has an unknown key 'place' (did you mean 'place_mm'?)"),
        (text(place_mm="[50, 0]"), "marker 'm1': place_mm is [50, 0], expected three numbers [x, y, z] in"),
        (text(place_mm="[50, 0, nan]"), "marker 'm1': place_mm is [50, 0, NaN], expected three numbers"),
        (text(place_mm='"50 0 0"'), "marker 'm1': place_mm is \"50 0 0\", expected three numbers"),
        (text(place_mm="[0.05, 0, 0]"), "m0 and m1 are 0.1 mm apart, expected at least 6 mm"),
    ],
)
def test_a_file_that_describes_no_body_is_told(content, words, tmp_path):
    path = tmp_path / "wand.toml"
    path.write_text(content)
    with pytest.raises(BodyError) as caught:
        load_body(path)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_bodies_are_told(tmp_path):
    with error_names(ArgumentError, "unknown body 'mugg' (did you mean 'mug'?); valid names: contr"):
        load_body("mugg")
    with pytest.raises(BodyError, match="cannot be written"):
        save_body(tmp_path, load_body("mug"))


def test_bodies_that_are_tracked_together_have_names_of_their_own(tmp_path):
    assert [body.name for body in load_bodies(["mug", "box"])] == ["mug", "box"]
    for name, other in (("mug", "mug"), ("left", "box")):
        path = tmp_path / "body.toml"
        path.write_text(text(head=f'name = "{name}"'))
        with error_names(ArgumentError, f"body.toml: a body is named '{name}', expected a name of its own"):
            load_bodies([other, path])


def capture_of(points: np.ndarray) -> Capture:
    points = points[:, np.isfinite(points[..., 0]).any(axis=0)]
    return Capture(tuple(f"*{number}" for number in range(points.shape[1])), points, 120.0)


def controller(rng, ghosts: float = 0.0) -> Capture:
    """The controller alone, as the room saw it in a hand: columns end where markers are hidden."""
    take = twin()
    body = np.where((take.labels >= take.hand_labels[-1].stop)[..., None], take.points, np.nan)
    false = rng.uniform(-0.2, 0.2, (FRAMES, 2, 3)) + np.nanmean(body, axis=(0, 1))
    false[rng.random((FRAMES, 2)) >= ghosts] = np.nan
    return capture_of(np.concatenate([body, false], axis=1))


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance from the true markers [m], in the order and place that suit best."""
    errors = []
    for order in itertools.permutations(range(len(true))):
        rotation, moved = rigid_fit(found, true[list(order)])
        errors.append(np.linalg.norm(found @ rotation.T + moved - true[list(order)], axis=1).max())
    return min(errors)


@pytest.mark.parametrize("ghosts", [0.0, 0.1])
def test_all_markers_are_where_they_are(ghosts, rng):
    capture = controller(rng, ghosts)
    body = learn_body(capture, "wand")
    assert body.name == "wand" and body.marker_names == tuple(f"Marker{n}" for n in range(1, 7))
    assert off(body.positions, named_object("controller").markers) < 0.00005
    np.testing.assert_allclose(body.positions.mean(axis=0), 0.0, atol=1e-12)


def test_captures_of_anything_else_are_told(rng):
    take = twin()
    hands = np.where(((take.labels >= 0) & (take.labels < 38))[..., None], take.points, np.nan)
    with error_names(CalibrationError, "points per frame, expected 3 to 20: one body and nothing else"):
        learn_body(capture_of(hands), "wand")
    fingers = np.where(np.isin(take.labels, (3, 6, 9, 12, 15))[..., None], take.points, np.nan)
    with error_names(CalibrationError, "% of the points keep their positions on one rigid body, expected"):
        learn_body(capture_of(fingers), "wand")
    with pytest.raises(CalibrationError, match="a capture of 0 points per frame"):
        learn_body(Capture(("a",), np.full((5, 1, 3), np.nan), 120.0), "wand")
    with pytest.raises(CalibrationError, match="2 markers of a body, expected at least 3"):
        learn_body(capture_of(hands), "wand", ("a", "b"))
    line = np.linspace(0, 0.1, 4)[:, None] * np.array([1.0, 0.0, 0.0]) + rng.normal(0, 1e-5, (9, 4, 3))
    with pytest.raises(CalibrationError, match="wand: its markers lie on one line"):
        learn_body(capture_of(line), "wand")
    with pytest.raises(ArgumentError, match="millimeters"):
        learn_body(capture_of(1e3 * controller(rng).positions), "wand")
