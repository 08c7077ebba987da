"""Places on mounts: in the room, off its edges, out of the hands' reach."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim.errors import ArgumentError
from train.rig_advice.mounts import MOUNTS, places

CENTER, SIDES = np.array([0.3, -0.2, 1.1]), np.full(3, 0.6)


@given(st.sampled_from(MOUNTS), st.floats(2.2, 9.0), st.floats(2.2, 9.0), st.floats(2.0, 4.0))
def test_places_lie_on_their_mount(mount, width, depth, height):
    room = np.array([width, depth, height])
    found = places(room, (mount,), CENTER, SIDES)
    assert len(found.targets) <= 400
    away = found.T_world_camera[:, :3, 3] - [*CENTER[:2], 0.0]
    assert (np.abs(away[:, :2]) <= room[:2] / 2 + 1e-5).all()
    assert (away[:, 2] > 0.4).all() and (away[:, 2] < height).all()
    inset = {"walls": 0.1, "truss": 0.0}.get(mount)
    if inset is not None:
        edge = room[:2] / 2 - inset - np.abs(away[:, :2])
        assert np.abs(edge).min(axis=1) == pytest.approx(0.0, abs=1e-5)
    outside = found.T_world_camera[:, :3, 3] - np.clip(
        found.T_world_camera[:, :3, 3], CENTER - 0.3, CENTER + 0.3
    )
    assert (np.linalg.norm(outside, axis=1) >= 0.25).all()
    ahead = found.targets - found.T_world_camera[:, :3, 3]
    cosine = np.einsum("ki,ki->k", ahead, found.T_world_camera[:, :3, 2]) / np.linalg.norm(ahead, axis=1)
    assert cosine == pytest.approx(1.0)


def test_cameras_look_about_in_a_long_volume():
    room = np.array([6.0, 4.0, 3.0])
    narrow = places(room, ("walls",), CENTER, SIDES)
    wide = places(room, ("walls",), CENTER, np.array([3.0, 0.6, 0.6]))
    assert len(wide.targets) == 3 * len(narrow.targets)
    assert sorted(set(wide.targets[:, 0].round(6))) == pytest.approx([-0.6, 0.3, 1.2])


def test_a_room_that_hands_fill_is_refused():
    with pytest.raises(ArgumentError, match=r"no place on walls is 0.25 m or more from the volume of"):
        places(np.array([0.9, 0.9, 1.5]), ("walls",), CENTER, np.array([2.0, 2.0, 3.0]))
