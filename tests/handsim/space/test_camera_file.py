"""Cameras of your own in TOML: what the file says is what the camera has, and mistakes are told."""

from __future__ import annotations

import numpy as np
import pytest
from handsim.space.camera_file import read_camera_file
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.errors import RigError
from handsim.space.camera import look_at
from handsim.space.cameras import load_rig, named_rig

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
    left, above = read_camera_file(written(tmp_path))
    assert (left.name, left.size, left.lens.kind) == ("left", (640, 480), "brown")
    np.testing.assert_array_equal(left.K, [[610.5, 0, 322], [0, 611, 238.5], [0, 0, 1]])
    assert left.lens.coefficients == (-0.2, 0.05, 0.001, -0.002, 0.01)
    np.testing.assert_allclose(left.project(np.array([0.0, 0.0, 0.1])), [322.0, 238.5], atol=1e-9)
    np.testing.assert_array_equal(above.K[:2, 2], [400, 300])
    np.testing.assert_allclose(above.local(np.array([0.0, 0.0, 0.2])), [0, 0, 0.8])


def test_a_rig_is_square_cameras(tmp_path):
    text = 'name = "r"\nfield_of_view = 60\nresolution = 500\n'
    for x in (1.2, -1.2):
        text += f"[[camera]]\nposition = [{x}, 0, 2.2]\ntarget = [0, 0, 1.1]\n"
    path = written(tmp_path, text)
    cameras, rig = read_camera_file(path), load_rig(path)
    point = np.array([0.1, 0.05, 1.2])
    assert [camera.size for camera in cameras] == [(500, 500)] * 2
    for camera, pixel in zip(cameras, rig.project(point), strict=True):
        np.testing.assert_allclose(camera.project(point) - 250.0, pixel, atol=1e-9)
    assert len(named_rig("six").T_world_camera) == 6


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
    (camera,) = read_camera_file(written(tmp_path_factory.mktemp("c"), text))
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
        ("focal = [500, 500]\n", "", "camera 2 lacks the key 'focal'"),
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
        read_camera_file(path)
    assert str(path) in str(error.value)


def test_a_capture_needs_a_rig(tmp_path):
    with pytest.raises(RigError, match="handsim render --cameras takes"):
        load_rig(written(tmp_path))
