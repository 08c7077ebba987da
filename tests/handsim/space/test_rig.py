"""Rigs: the shipped ones to the last digit, anybody's from a file, and a sentence for every mistake."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import CameraRig, HandModel, Population, join_qpos, load_rig, look_at, sample_shape
from handsim.errors import ArgumentError, RigError
from handsim.space.rig import HAND_REACH, check_outside, check_outside_volume, list_rigs, rig_setting
from handsim.space.rig_formats import load_cameras
from tests.rigs import mixed_rig, square_rig
from tests.sentences import error_names

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden"
CENTER = np.array([0.0, 0.0, 1.1])

TOP = 'name = "mine"\nfield_of_view = 50.0\n'
FIRST = "[[camera]]\nposition = [1.0, 0.0, 2.0]\ntarget = [0.0, 0.0, 1.0]\n"
SECOND = "[[camera]]\nposition = [-1.0, 0.5, 2.0]\ntarget = [0.0, 0.0, 1.0]\n"
FILE = TOP + FIRST + SECOND
CROWD = "".join(FIRST.replace("1.0, 0.0, 2.0", f"1.0, {n}.0, 2.0") for n in range(1, 33))
POSE = "position = [-1.0, 0.5, 2.0]\ntarget = [0.0, 0.0, 1.0]\n"
MISTAKES = [  # what is exchanged for what, at its last place, and what is told
    (SECOND, "", "rig 'mine' | 1 cameras | 2 to 32"),
    (FIRST + SECOND, "", "rig 'mine' | 0 cameras | 2 to 32"),
    (SECOND, CROWD, "rig 'mine' | 33 cameras | 2 to 32"),
    (SECOND, SECOND + FIRST, "cameras 1 and 3 | 'mine' | one position"),
    ("0.5", '"half"', 'camera 2 | position is [-1.0, "half", 2.0] | three numbers'),
    ("0.5", "nan", "camera 2 | position is [-1.0, NaN, 2.0] | three numbers"),
    ("0.5, 2.0", "0.5", "camera 2 | position is [-1.0, 0.5] | three numbers"),
    ("-1.0, 0.5, 2.0", "0.0, 0.0, 1.0", "camera 2 | its own position | target"),
    ("-1.0, 0.5, 2.0", "-1000, 500, 2000", "camera 2 | 'mine' | 2291 m | at most 50 m | millimeters"),
    (SECOND, SECOND + "target = [0.0,", "not a TOML file | end of document"),
    ('"mine"', "3", "name is 3 | text in quotes"),
    ("field_of_view = 50.0\n", "", "camera 1 | focal, K, field_of_view, horizontal_field_of_view"),
    ("target", "targets", "camera 2 | 'targets' | 'target' | T_world_camera"),
    ("target = [0.0, 0.0, 1.0]\n", "", "camera 2 has position | position and target, or T_world_camera"),
    (POSE, POSE + "T_world_camera = [[1.0]]\n", "camera 2 has position and target and T_world_camera"),
    (POSE, "T_world_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]\n", "camera 2 | four rows"),
    (POSE, "T_world_camera = [[1, 0, 0, 0], [0, 1]]\n", "camera 2 | [[1, 0, 0, 0], [0, 1]] | four rows"),
    ("50.0", "0.87", "camera 1 | field_of_view is 0.87 degrees | 1 to 170"),
    (TOP, TOP + "resolution = 640.5\n", "camera 1 | resolution is 640.5 | whole number of pixels"),
    (TOP, TOP + "resolution = 0\n", "'camera1' | size is (0, 0) | 1 to 8192"),
    (FIRST + SECOND, "camera = 3\n", "camera | [[camera]] table"),
]  # fmt: skip
TWO = """
name = "desk"

[[camera]]
name = "left"
size = [640, 480]
focal = [610.5, 611.0]
center = [322.0, 238.5]
lens = "brown"
coefficients = [-0.2, 0.05, 0.001, -0.002, 0.01]
position = [0.5, -0.1, 0.4]
target = [0.0, 0.0, 0.1]

[[camera]]
name = "above"
size = [800, 600]
focal = [500, 500]
T_world_camera = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]
"""
SHARED = """
name = "lab"
size = [1280, 1024]
focal = 1100.0
center = [640.5, 511.0]
lens = "brown"
coefficients = [-0.2, 0.05, 0.0, 0.0, 0.0]
"""
PLACES = [f"[[camera]]\nposition = [{x}, 0, 2.2]\ntarget = [0, 0, 1.1]\n" for x in (1.2, -1.2, 0.3)]


distance = st.floats(-2.0, 2.0)


def test_shipped_rigs_hold_what_their_names_say():
    counts = {name: len(load_rig(name).positions) for name in list_rigs()}
    assert counts == {"eight": 8, "figure5": 16, "six": 6}
    for name in list_rigs():
        assert load_rig(name).name == name
        assert {one.size for one in load_rig(name).cameras} == {(1280, 1280)}


def test_figure5_stays_where_training_sets_were_made_with_it():
    saved, rig = json.loads((GOLDEN / "figure5.json").read_text()), load_rig("figure5")
    angle = saved["field_of_view"]  # of the round cone that its square pictures hold
    assert {one.focal_lengths for one in rig.cameras} == {(640 / np.tan(angle / 2),) * 2}
    np.testing.assert_array_equal(rig.positions, np.array(saved["T_world_camera"])[:, :3, 3])
    # another processor may round a norm otherwise in the last bit
    np.testing.assert_allclose(rig.T_world_camera, saved["T_world_camera"], rtol=0, atol=5e-16)


@pytest.mark.parametrize("name", list_rigs())
def test_every_place_of_the_volume_is_in_three_views(name, rng):
    rig = load_rig(name)
    check_outside_volume(rig, CENTER, 0.3)
    seen = rig.in_view(CENTER + rng.uniform(-0.3, 0.3, size=(5000, 3))).sum(axis=-1)
    assert (seen >= 3).all()


def test_a_file_of_ones_own(tmp_path):
    pose = look_at(np.array([-1.0, 0.5, 2.0]), np.array([0.0, 0.0, 1.0]))
    path = tmp_path / "mine.toml"
    path.write_text(f"{TOP}resolution = 2048\n{FIRST}[[camera]]\nT_world_camera = {pose.tolist()}\n")
    rig = load_rig(path)
    assert rig.name == "mine" and {one.size for one in rig.cameras} == {(2048, 2048)}
    assert rig.cameras[0].angles == pytest.approx(np.deg2rad([50.0, 50.0]))
    np.testing.assert_array_equal(rig.positions, [[1.0, 0.0, 2.0], [-1.0, 0.5, 2.0]])
    path.write_text(TOP + FIRST + SECOND)
    np.testing.assert_allclose(load_rig(str(path)).T_world_camera, rig.T_world_camera, atol=1e-15)
    assert load_rig(path).cameras[0].size == (1280, 1280)
    assert load_rig("six") == load_rig("six")


def test_whatever_stands_for_a_rig_gives_it(tmp_path):
    rig = mixed_rig()
    path = tmp_path / "mixed.toml"
    rig.save(path)
    record = json.loads(json.dumps(rig.record()))
    for source in (rig, path, str(path), record):
        assert load_rig(source) == rig
    for source in ("six", load_rig("six"), load_rig("six").record()):
        assert load_rig(source) == load_rig("six")
    assert load_rig(rig) is rig
    other = CameraRig("six", rig.cameras)  # a shipped name, but other cameras
    assert load_rig(rig_setting(other)) == other
    with pytest.raises(ArgumentError, match="rig is 3, expected a CameraRig, or the name or path of one"):
        load_rig(3)
    with pytest.raises(RigError, match="a damaged record of a rig"):
        load_rig({"name": "six"})


@pytest.mark.parametrize("given", [[np.eye(4)] * 2, "ab", 3])
def test_what_are_no_cameras_is_told(given):
    with pytest.raises(ArgumentError, match=r"rig 'mine' has .* as cameras, expected a sequence of Camera"):
        CameraRig("mine", given)


@given(st.tuples(distance, distance, distance), st.tuples(distance, distance, distance))
def test_a_camera_sees_its_target_in_the_middle_of_an_upright_picture(position, target):
    position, target = np.array(position), np.array(target)
    if np.linalg.norm(target - position) < 0.1:
        return
    pose = look_at(position, target)
    other = look_at(position + [5.0, 0.0, 0.0], target)
    rig = square_rig("two", [pose, other])
    np.testing.assert_allclose(rig.project(target)[0], 640.0, atol=1e-6)
    assert rig.in_view(target)[0]
    if abs(pose[2, 2]) < 0.99:
        above = rig.project(target + [0.0, 0.0, 1e-3])[0]
        assert above[1] < 640.0, "up in the world is up in the picture, where pixels count downwards"


def opencv_pixels(camera, points):
    """What OpenCV makes of world points; it counts pixels from the first one's center, we from the corner."""
    R, t = camera.T_world_camera[:3, :3].T, -camera.T_world_camera[:3, :3].T @ camera.T_world_camera[:3, 3]
    K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    coefficients = np.array(camera.lens.coefficients or [0.0] * 4)
    project = cv2.fisheye.projectPoints if camera.lens.kind == "fisheye" else cv2.projectPoints
    rvec = cv2.Rodrigues(R)[0]
    return project(points.reshape(-1, 1, 3), rvec, t, K, coefficients)[0].reshape(-1, 2) + 0.5


def test_pixels_of_unlike_cameras_are_opencvs(rng):
    rig = mixed_rig()
    points = CENTER + rng.uniform(-0.6, 0.6, (40, 5, 3))
    pixels = rig.project(points)
    assert pixels.shape == (40, 5, 6, 2)
    for number, camera in enumerate(rig.cameras):
        expected = opencv_pixels(camera, points).reshape(40, 5, 2)
        np.testing.assert_allclose(pixels[:, :, number], expected, atol=1e-6)
        rays = points - rig.positions[number]
        ours = camera.unproject(pixels[:, :, number]) @ camera.T_world_camera[:3, :3].T
        np.testing.assert_allclose(ours, rays / np.linalg.norm(rays, axis=-1, keepdims=True), atol=1e-7)


def test_in_view_is_inside_the_picture_and_in_front(rng):
    rig = mixed_rig()
    points = CENTER + rng.uniform(-3.5, 3.5, (20_000, 3))
    seen = rig.in_view(points)
    assert (0.02 < seen.mean(axis=0)).all() and (seen.mean(axis=0) < 0.5).all()
    for number, camera in enumerate(rig.cameras):
        ahead = (points - rig.positions[number]) @ camera.T_world_camera[:3, 2] > 1e-6
        pixels = camera.project(points)
        expected = ahead & ((pixels >= 0) & (pixels < camera.size)).all(axis=1)
        np.testing.assert_array_equal(seen[:, number], expected)
        np.testing.assert_array_equal(camera.in_view(points), expected)
        inside = expected & (np.linalg.norm(camera.local(points)[:, :2], axis=1) < camera.local(points)[:, 2])
        theirs = opencv_pixels(camera, points[inside])
        assert ((theirs > -1e-6) & (theirs < np.array(camera.size) + 1e-6)).all()
    assert not rig.in_view(np.full((3, 3), np.nan)).any()


def test_points_behind_a_camera_have_no_pixel():
    rig = square_rig("two", [np.eye(4), look_at(np.ones(3), np.zeros(3))], np.deg2rad(90.0), 1000)
    points = np.array([[[0.2, -0.1, 2.0], [2.0, 0.0, 2.0]], [[0.0, 0.0, 0.5], [0.1, 0.0, -1.0]]])
    pixels = rig.project(points)
    np.testing.assert_allclose(pixels[0, :, 0], [[550.0, 475.0], [1000.0, 500.0]])
    np.testing.assert_allclose(pixels[1, 0, 0], 500.0)
    assert np.isnan(pixels[1, 1, 0]).all()


@pytest.mark.parametrize(("old", "new", "words"), MISTAKES)
def test_mistakes_in_a_file_are_told(tmp_path, old, new, words):
    path = tmp_path / "rig.toml"
    assert old in FILE
    path.write_text(new.join(FILE.rsplit(old, 1)))
    with error_names(RigError, f"{path} | {words}"):
        load_rig(path)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("figure6", "'figure6' | 'figure5' | eight, figure5, six | path of a .toml file"),
        ("rigs/mine.json", "'rigs/mine.json' | eight, figure5, six | path of a .toml file"),
        ("missing.toml", "missing.toml | No such file"),
    ],
)
def test_unknown_rigs_are_told(name, words):
    with error_names(RigError, words):
        load_rig(name)


def test_binary_files_are_told(tmp_path):
    (tmp_path / "rig.toml").write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(RigError, match="not UTF-8 text"):
        load_rig(tmp_path / "rig.toml")


def test_cameras_in_the_hand_are_refused():
    rig, model = load_rig("six"), HandModel.named("M")
    far = model.skin(join_qpos(np.zeros((3, 20)), position=CENTER))
    check_outside(rig, far)
    check_outside(rig, np.full((4, 3), np.nan))
    near = model.skin(join_qpos(np.zeros((1, 20)), position=rig.positions[2] + [0.0, 0.0, 0.04]))
    with error_names(ArgumentError, "camera 3 of rig 'six' is 0.0 | m from the hand | at least 0.05 m"):
        check_outside(rig, np.concatenate([far, near]))


def test_cameras_in_the_volume_are_refused():
    rig = load_rig("six")
    check_outside_volume(rig, CENTER, 0.6)
    with error_names(ArgumentError, "camera 5 of rig 'six' is 0.14 m | wrists | at least 0.25 m"):
        check_outside_volume(rig, CENTER + [0.0, 0.44, 0.0], 0.5)
    with pytest.raises(ArgumentError, match=r"camera 1 of rig 'six' is 0 m from"):
        check_outside_volume(rig, CENTER, 2.0)


def test_no_hand_reaches_beyond_its_reach(rng):
    flat = join_qpos(np.zeros((1, 20)))
    for _ in range(20):
        skin = HandModel(sample_shape(Population(children=0.2), side="right", rng=rng)).skin(flat)
        assert np.linalg.norm(skin, axis=-1).max() < HAND_REACH
    assert np.linalg.norm(HandModel.named("XL").skin(flat), axis=-1).max() < HAND_REACH


def written(folder, text=TWO):
    path = folder / "cameras.toml"
    path.write_text(text)
    return path


def test_a_file_of_two_cameras(tmp_path):
    left, above = load_cameras(written(tmp_path))
    assert (left.name, left.size, left.lens.kind) == ("left", (640, 480), "brown")
    np.testing.assert_array_equal(left.K, [[610.5, 0, 322], [0, 611, 238.5], [0, 0, 1]])
    assert left.lens.coefficients == (-0.2, 0.05, 0.001, -0.002, 0.01)
    np.testing.assert_allclose(left.project(np.array([0.0, 0.0, 0.1])), [322.0, 238.5], atol=1e-9)
    np.testing.assert_array_equal(above.K[:2, 2], [400, 300])
    np.testing.assert_allclose(above.local(np.array([0.0, 0.0, 0.2])), [0, 0, 0.8])


def test_what_stands_at_the_top_holds_unless_a_camera_says_otherwise(tmp_path):
    own = (
        "",
        "size = [640, 480]\nhorizontal_field_of_view = 90\n",
        'focal = [1200, 1210]\nlens = "pinhole"\n',
    )
    path = written(tmp_path, SHARED + "".join(place + more for place, more in zip(PLACES, own, strict=True)))
    first, second, third = load_rig(path).cameras
    assert (first.name, first.size, first.focal_lengths) == ("camera1", (1280, 1024), (1100.0, 1100.0))
    np.testing.assert_array_equal(first.K[:2, 2], [640.5, 511.0])
    assert first.lens == second.lens and first.lens.kind == "brown"
    assert (second.size, second.focal_lengths) == ((640, 480), pytest.approx((320.0, 320.0)))
    np.testing.assert_array_equal(second.K[:2, 2], [320, 240])  # of its own size, not that at the top
    assert (third.focal_lengths, third.lens.kind) == ((1200.0, 1210.0), "pinhole")
    np.testing.assert_array_equal(third.K[:2, 2], [640.5, 511.0])


@pytest.mark.parametrize(
    ("keys", "size", "focal"),
    [
        ("field_of_view = 90", (1280, 1280), 640.0),
        ("field_of_view = 90\nresolution = 500", (500, 500), 250.0),
        ("field_of_view = 90\nsize = [800, 600]", (800, 600), 300.0),
        ("horizontal_field_of_view = 90\nsize = [800, 600]", (800, 600), 400.0),
        ("K = [[700, 0, 400], [0, 700, 300], [0, 0, 1]]\nsize = [800, 600]", (800, 600), 700.0),
    ],
)
def test_every_way_to_say_what_a_picture_is(tmp_path, keys, size, focal):
    rig = load_rig(written(tmp_path, f"{keys}\n{PLACES[0]}{PLACES[1]}"))
    assert rig.name == "cameras"  # the file's
    for camera in rig.cameras:
        assert camera.size == size and camera.focal_lengths == pytest.approx((focal, focal))
        np.testing.assert_array_equal(camera.K[:2, 2], np.array(size) / 2)


@pytest.mark.parametrize("rig", [mixed_rig(), square_rig("alike", mixed_rig().T_world_camera)])
def test_a_rig_comes_back_to_the_last_digit(tmp_path, rig):
    path = tmp_path / "rig.toml"
    rig.save(path)
    assert load_rig(path) == rig and load_cameras(path) == rig.cameras
    assert path.read_text().count("size = ") == (1 if rig.name == "alike" else 6)


@settings(max_examples=30, deadline=None)
@given(
    st.tuples(*[st.floats(-5, 5)] * 3),
    st.tuples(st.floats(10, 4000), st.floats(10, 4000)),
    st.lists(st.floats(-0.1, 0.1), min_size=4, max_size=4),
)
def test_what_is_written_is_read(tmp_path_factory, position, focal, coefficients):
    pose = look_at(np.array(position), np.array([9.0, 1.0, 2.0]))
    text = (
        '[[camera]]\nname = "one"\nsize = [320, 200]\n'
        f"focal = {list(focal)}\nlens = 'fisheye'\ncoefficients = {coefficients}\n"
        f"T_world_camera = {pose.tolist()}\n"
    )
    (camera,) = load_cameras(written(tmp_path_factory.mktemp("c"), text))
    np.testing.assert_array_equal(camera.T_world_camera, pose)
    assert (camera.K[0, 0], camera.K[1, 1]) == focal and camera.lens.coefficients == tuple(coefficients)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "above"', 'name = "left"', "two cameras are called 'left'"),
        ('name = "above"', 'name = "a/b"', "expected up to 64 letters"),
        ("size = [800, 600]", "size = [800.5, 600]", "camera 2: size is"),
        ("size = [800, 600]", "size = [80000, 600]", "expected width and height, 1 to 8192"),
        ('lens = "brown"', 'lens = "brow"', "did you mean 'brown'"),
        ("-0.002, 0.01]", "-0.002]", "expected 5 finite numbers"),
        ("focal = [500, 500]", "focal = [500]", "camera 2: focal is"),
        ("focal = [500, 500]", "focal = 500\nfield_of_view = 60", "camera 2 has focal and field_of_view"),
        ("focal = [500, 500]", "K = [[500, 0, 9], [0, 500, 9], [1, 0, 1]]", "K is not a matrix"),
        ("size = [800, 600]", "size = [800, 600]\nresolution = 800", "size and resolution are given"),
        ("[0, 0, -1, 1]", "[0, 0, -1, 1000]", "are these millimeters"),
        ("[0, 0, -1, 1]", "[0, 0, 1, 1]", "not a rigid transform"),
        ('name = "desk"', "name = 3\nfov = 2", "unknown key 'fov'"),
    ],
)
def test_mistakes_about_a_camera_are_told(tmp_path, old, new, words):
    assert old in TWO
    path = written(tmp_path, TWO.replace(old, new))
    with error_names(RigError, f"{path} | {words}"):
        load_cameras(path)
