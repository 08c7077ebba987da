"""Cameras of a user's file must see the hands."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.errors import HandSimWarning, RigError
from handsim.space.camera import look_at, pinhole
from render.cameras.own_cameras import check_hands_in_view
from render.own_poses import PoseFile, load_poses


def test_cameras_must_look_at_the_hands(tmp_path):
    qpos = np.zeros((3, 27))
    qpos[:, 3] = 1.0
    np.savez(tmp_path / "poses.npz", qpos=qpos)
    take = load_poses(PoseFile(tmp_path / "poses.npz"))
    eye = np.array([0.0, -0.6, 0.0])
    seeing = pinhole("seeing", (640, 480), 600.0).at(look_at(eye, np.zeros(3)))
    blind = pinhole("blind", (640, 480), 600.0).at(look_at(eye, 2 * eye))
    check_hands_in_view("c.toml", [seeing], take)
    with pytest.warns(HandSimWarning, match="camera 'blind' has no hand"):
        check_hands_in_view("c.toml", [seeing, blind], take)
    with pytest.raises(RigError, match="no camera has a hand in its picture in any of 3 frames"):
        check_hands_in_view("c.toml", [blind], take)
