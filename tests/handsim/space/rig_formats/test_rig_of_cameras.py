"""What a rig keeps of real cameras, and what it tells of the rest."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from handsim.space.rig_formats.rig_of_cameras import (
    corner_distortion,
    field_of_view,
    marker_cameras,
    rig_of_cameras,
)

from handsim.errors import HandSimWarning, RigError
from handsim.space.camera import Camera, look_at, pinhole
from handsim.space.lens import Lens
from handsim.space.rig_formats.lab_camera import LabCamera

MIDDLE = np.array([0.0, 0.0, 1.1])


def around(*cameras, **facts):
    angles = np.arange(len(cameras)) * 2.0
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(len(cameras), 2.0)], axis=1)
    return [LabCamera(one.at(look_at(eye, MIDDLE)), **facts) for one, eye in zip(cameras, eyes, strict=True)]


def plain(number, size=(1000, 800), focal=1200.0, center=None):
    return pinhole(f"c{number}", size, focal, center)


def told(path, cameras, up=None):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rig = rig_of_cameras(path, cameras, up)
    assert all(issubclass(one.category, HandSimWarning) for one in caught)
    return rig, [str(one.message) for one in caught]


def test_a_rig_of_equal_cameras_is_exact_and_says_nothing(tmp_path):
    cameras = around(*(plain(n) for n in range(4)))
    rig, sentences = told(tmp_path / "lab.xcp", cameras)
    assert sentences == [] and rig.name == "lab" and rig.resolution == 800
    assert rig.field_of_view == pytest.approx(2 * np.arctan(400 / 1200))
    assert rig.focal_length == pytest.approx(1200.0)
    point = np.array([0.1, -0.2, 1.3])
    expected = [one.camera.project(point) - [500, 400] for one in cameras]
    np.testing.assert_allclose(rig.project(point), expected, atol=1e-9)


def test_unlike_cameras_become_their_medians(tmp_path):
    cameras = around(plain(1, focal=1200.0), plain(2, focal=1200.0), plain(3, focal=2400.0))
    rig, (sentence,) = told(tmp_path / "lab.xcp", cameras)
    assert rig.focal_length == pytest.approx(1200.0, rel=1e-3)
    assert "focal lengths 1200 to 2400 pixels; a rig has one of each, the medians 36.9 degrees" in sentence


def test_distortion_is_told_with_its_size(tmp_path):
    """A corner 500 and 400 pixels out at f = 1000 px, where x and y are 1 / 1.05 of the picture's."""
    straight = np.array([0.5, 0.4]) / 1.05
    k1 = 0.05 / (straight**2).sum()
    bent = Camera(
        "bent",
        (1000, 800),
        np.array([[1e3, 0, 500], [0, 1e3, 400], [0, 0, 1]]),
        lens=Lens("brown", (k1, 0, 0, 0, 0)),
    )
    expected = np.hypot(500, 400) * (1 - 1 / 1.05)
    assert corner_distortion(bent) == pytest.approx(expected, abs=1e-6)
    _, sentences = told(tmp_path / "lab.xcp", around(bent, bent))
    assert any(f"by up to {expected:.0f} pixels (camera 'bent')" in one for one in sentences)
    assert field_of_view(bent) < 2 * np.arctan(0.4)  # pincushion: its pictures show less


def test_a_principal_point_off_the_middle_is_told(tmp_path):
    _, sentences = told(tmp_path / "a.xcp", around(plain(1, center=(600, 400)), plain(2)))
    assert any(
        "camera 'c1' has its principal point 100 and 0 pixels from the middle" in one for one in sentences
    )


def test_another_axis_up_is_told_and_turned(tmp_path):
    lying = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # (x, y, z) is (x, z, -y)
    cameras = around(*(plain(n) for n in range(4)))
    turned = [one._replace(camera=one.camera.at(lying @ one.camera.T_world_camera)) for one in cameras]
    _, (sentence,) = told(tmp_path / "lab.xml", turned)
    assert "is another axis up? --up says which" in sentence
    rig, sentences = told(tmp_path / "lab.xml", turned, "y")
    assert sentences == []
    expected = [one.camera.T_world_camera for one in cameras]
    np.testing.assert_allclose(rig.T_world_camera, expected, atol=1e-12)
    told_so, _ = told(tmp_path / "lab.mcal", [one._replace(y_up=True) for one in turned])
    np.testing.assert_allclose(told_so.T_world_camera, expected, atol=1e-12)


def test_video_cameras_see_no_markers(tmp_path):
    cameras = [*around(plain(1), plain(2)), *around(plain(3), video=True)]
    with pytest.warns(HandSimWarning, match="are left out: c3"):
        assert marker_cameras(tmp_path, cameras) == tuple(cameras[:2])
    assert len(marker_cameras(tmp_path, around(plain(1), plain(2), video=True))) == 2


def test_what_no_rig_may_be(tmp_path):
    path = tmp_path / "lab.xcp"
    one = around(plain(1))
    with pytest.raises(RigError, match="no camera is calibrated"):
        rig_of_cameras(path, [])
    with pytest.raises(RigError, match=r"lab\.xcp: rig 'lab' has 1 cameras, expected 2 to 32"):
        rig_of_cameras(path, one)
    with pytest.raises(RigError, match="has 33 cameras"):
        rig_of_cameras(path, around(*(plain(n) for n in range(33))))
    with pytest.raises(RigError, match="stand at one position"):
        rig_of_cameras(path, one * 2)
