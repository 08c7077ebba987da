"""What becomes of a calibration's cameras in a rig: they are kept, axes turned, video cameras left out."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from handsim.errors import HandSimWarning, RigError
from handsim.space.rig_formats import LabCamera, import_cameras
from tests.rigs import mixed_rig

CAMERAS = mixed_rig().cameras


@pytest.fixture
def told(monkeypatch):
    """`import_cameras` of these cameras, and the warnings."""

    def read(found, up=None):
        monkeypatch.setattr("handsim.space.rig_formats.load_lab_cameras", lambda path: tuple(found))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            cameras = import_cameras("lab.xcp", up)
        assert all(issubclass(one.category, HandSimWarning) for one in caught)
        return cameras, [str(one.message) for one in caught]

    return read


def test_unlike_cameras_are_kept_as_they_are(told):
    assert told(LabCamera(one) for one in CAMERAS) == (CAMERAS, [])


def test_another_axis_up_is_told_and_turned(told):
    lying = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # (x, y, z) is (x, z, -y)
    turned = [LabCamera(one.at(lying @ one.T_world_camera)) for one in CAMERAS]
    _, (sentence,) = told(turned)
    assert "is another axis up? --up says which" in sentence
    cameras, sentences = told(turned, "y")
    assert sentences == []
    for one, expected in zip(cameras, CAMERAS, strict=True):
        np.testing.assert_allclose(one.T_world_camera, expected.T_world_camera, atol=1e-12)
        assert dataclasses.replace(one, T_world_camera=expected.T_world_camera) == expected
    assert told([one._replace(y_up=True) for one in turned]) == (cameras, [])


def test_video_cameras_see_no_markers(told):
    found = [*(LabCamera(one) for one in CAMERAS[:2]), LabCamera(CAMERAS[2], video=True)]
    cameras, (sentence,) = told(found)
    assert cameras == CAMERAS[:2] and "are left out: c2" in sentence
    assert len(told([one._replace(video=True) for one in found])[0]) == 3


def test_a_file_without_cameras_is_told(tmp_path):
    (tmp_path / "lab.xcp").write_text("<Cameras></Cameras>")
    with pytest.raises(RigError, match="0 cameras"):
        import_cameras(tmp_path / "lab.xcp")
