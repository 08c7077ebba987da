"""What is suspicious about a rig: each sentence for the rig that deserves it, and none for a good one."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.space.camera import look_at
from handsim.space.rig import list_rigs, named_rig
from tests.rigs import square_rig
from train.rig_advice.rig_faults import faults, working_point


@pytest.mark.parametrize("name", list_rigs())
def test_shipped_rigs_look_at_the_hands_and_have_no_faults(name):
    assert working_point(named_rig(name)) == pytest.approx([0.0, 0.0, 1.1], abs=1e-6)
    assert faults(named_rig(name)) == []


def with_cameras(change, name="six"):
    rig = named_rig(name)
    poses = rig.T_world_camera.copy()
    change(poses)
    return square_rig(rig.name, poses)


def test_opengl_axes_are_told():
    def turn(poses):
        poses[:, :3, 1:3] *= -1.0

    (sentence, *_) = faults(with_cameras(turn))
    assert "OpenGL" in sentence


def test_a_camera_upside_down_is_told():
    def turn(poses):
        poses[2, :3, :2] *= -1.0

    (sentence,) = faults(with_cameras(turn))
    assert sentence.startswith("camera 3 is upside down")


def test_close_low_and_near_cameras_are_told():
    def move(poses):
        poses[0] = look_at(poses[1, :3, 3] + [0.03, 0.0, 0.0], np.array([0.0, 0.0, 1.1]))
        poses[2] = look_at(np.array([1.0, -1.0, -0.2]), np.array([0.0, 0.0, 1.1]))
        poses[3] = look_at(np.array([0.4, 0.0, 1.1]), np.array([0.0, 0.0, 1.1]))

    told = faults(with_cameras(move))
    assert any(one.startswith("cameras 1 and 2 are 3 cm apart") for one in told)
    assert any(one.startswith("camera 3 is 0.20 m below the floor") for one in told)
    assert any(one.startswith("camera 4 is 0.10 m from the cube") for one in told)


def test_a_narrow_far_and_shifted_rig_is_told():
    middle = np.array([4.0, 0.0, 1.1])
    poses = np.stack([look_at(middle + [9.0, side, 0.0], middle) for side in (-0.5, 0.5)])
    told = faults(square_rig("narrow", poses, resolution=320))
    assert any("no two cameras see the middle at more than 6 deg" in one for one in told)
    assert any("the cameras look at (4.00, 0.00, 1.10) m" in one for one in told)
    assert any(one.startswith("camera 1 sees a marker of 6.4 mm as 0.2 px") for one in told)
