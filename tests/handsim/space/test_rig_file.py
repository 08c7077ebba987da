"""Cameras in TOML: what the file says is what the camera has, and mistakes are told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import RigError
from handsim.space.camera import look_at
from handsim.space.rig import load_rig
from handsim.space.rig_formats import load_cameras
from tests.rigs import mixed_rig, square_rig

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


TOP = """
name = "lab"
size = [1280, 1024]
focal = 1100.0
center = [640.5, 511.0]
lens = "brown"
coefficients = [-0.2, 0.05, 0.0, 0.0, 0.0]
"""
PLACES = [f"[[camera]]\nposition = [{x}, 0, 2.2]\ntarget = [0, 0, 1.1]\n" for x in (1.2, -1.2, 0.3)]


def test_what_stands_at_the_top_holds_unless_a_camera_says_otherwise(tmp_path):
    own = (
        "",
        "size = [640, 480]\nhorizontal_field_of_view = 90\n",
        'focal = [1200, 1210]\nlens = "pinhole"\n',
    )
    path = written(tmp_path, TOP + "".join(place + more for place, more in zip(PLACES, own, strict=True)))
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
    ("old", "new", "message"),
    [
        ('name = "above"', 'name = "left"', "two cameras are called 'left'"),
        ('name = "above"', 'name = "a/b"', "expected up to 64 letters"),
        ("size = [800, 600]", "size = [800.5, 600]", "camera 2: size is"),
        ("size = [800, 600]", "size = [80000, 600]", "pictures of 80000 x 600 pixels"),
        ('lens = "brown"', 'lens = "brow"', "did you mean 'brown'"),
        ("-0.002, 0.01]", "-0.002]", "expected 5 finite numbers"),
        ("focal = [500, 500]", "focal = [500]", "camera 2: focal is"),
        ("focal = [500, 500]\n", "", "camera 2 has no focal length, expected one of focal, K, field_of_view"),
        ("focal = [500, 500]", "focal = 500\nfield_of_view = 60", "camera 2 has focal and field_of_view"),
        ("focal = [500, 500]", "K = [[500, 0, 9], [0, 500, 9], [1, 0, 1]]", "K is not a matrix"),
        ("size = [800, 600]", "size = [800, 600]\nresolution = 800", "size and resolution are given"),
        ("[0, 0, -1, 1]", "[0, 0, -1, 1000]", "are these millimeters"),
        ("[0, 0, -1, 1]", "[0, 0, 1, 1]", "not a rigid transform"),
        ("target = [0.0, 0.0, 0.1]", "target = [0.5, -0.1, 0.4]", "looks at its own position"),
        ('name = "desk"', "name = 3\nfov = 2", "unknown key 'fov'"),
    ],
)
def test_mistakes_are_told(tmp_path, old, new, message):
    assert old in TWO
    path = written(tmp_path, TWO.replace(old, new))
    with pytest.raises(RigError, match=message) as error:
        load_cameras(path)
    assert str(path) in str(error.value)
