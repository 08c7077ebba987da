from __future__ import annotations

import numpy as np

from handsim.motion_files.motion import changes, posed_bodies, posed_hands


def test_the_last_pose_is_held(motion):
    left = list(posed_hands(motion))[1]
    assert left.side == "left" and np.flatnonzero(~left.present).tolist() == [0, 1, 5, 6]
    np.testing.assert_array_equal(left.qpos[left.present], motion.qpos[left.present, 1])
    np.testing.assert_array_equal(left.qpos[[0, 1, 5, 6]], motion.qpos[[2, 2, 4, 4], 1])
    pen = next(posed_bodies(motion))
    assert pen.shape is not None and np.flatnonzero(~pen.present).tolist() == [7, 8]
    np.testing.assert_array_equal(pen.T_world_body[[7, 8]], pen.T_world_body[[6, 6]])


def test_changes_are_where_something_appears_or_goes(motion):
    left = list(posed_hands(motion))[1]
    assert changes(left.present).tolist() == [0, 2, 5, 7]
