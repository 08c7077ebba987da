"""Lenses of the formats against their makers' own formulas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handsim.errors import HandSimWarning
from handsim.space.rig_formats import load_cameras
from tests.handsim.space.rig_formats.known_rig import MCAL, QUALISYS, XCP

POINTS = np.random.default_rng(5).uniform([-1.2, 1.0, 0.3], [1.2, 2.0, 1.9], (50, 3))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('VICON_RADIAL="0 0"', 'VICON_RADIAL="4e-8 2e-14"'),
        ('VICON_RADIAL="0 0"', 'VICON_RADIAL2="ViconRadial2 510 390 -5e-8 1e-14 1e-20"'),
        ('VICON_RADIAL="0 0"', 'VICON_RADIAL2="ViconRadial2 510 390 6e-8 0 0"'),
    ],
)
def test_vicons_correction_takes_our_pixels_back_to_the_straight_ones(tmp_path, old, new):
    (tmp_path / "lab.xcp").write_text(XCP.replace(old, new).replace("1.0416666666666667", "1"))
    camera = load_cameras(tmp_path / "lab.xcp")[0]
    words = new.split('"')[1].split()
    k1, k2, k3 = (*map(float, words[3:] if words[0].startswith("V") else words), 0.0)[:3]
    measured = camera.project(POINTS) - [510.0, 390.0]
    inside = (np.abs(measured) < [490.0, 390.0]).all(axis=1)
    square = (measured**2).sum(axis=1, keepdims=True)
    corrected = measured * (1.0 + k1 * square + k2 * square**2 + k3 * square**3)
    ahead = POINTS[:, 1] + 3.0
    straight = np.stack([POINTS[:, 0] / ahead, -(POINTS[:, 2] - 1.0) / ahead], axis=1) * 1250.0
    assert inside.sum() > 20 and np.abs(corrected - measured)[inside].max() > 2.0
    np.testing.assert_allclose(corrected[inside], straight[inside], atol=0.05)


def test_a_lens_beyond_belief_is_told(tmp_path):
    (tmp_path / "lab.xcp").write_text(XCP.replace('VICON_RADIAL="0 0"', 'VICON_RADIAL="0.1 -0.2"'))
    with pytest.warns(HandSimWarning, match="move a corner by more than half its distance; it is left out"):
        camera = load_cameras(tmp_path / "lab.xcp")[0]
    assert camera.lens.kind == "pinhole"


def test_moving_cameras_are_told(tmp_path):
    frame = XCP[XCP.index("<KeyFrame ") : XCP.index("</KeyFrames>")]
    (tmp_path / "lab.xcp").write_text(XCP.replace("</KeyFrames>", frame + "</KeyFrames>", 1))
    with pytest.warns(HandSimWarning, match="has 2 key frames, of which the first is taken"):
        load_cameras(tmp_path / "lab.xcp")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "lab.xml",
            QUALISYS.replace('radialDistortion1="0"', 'radialDistortion1="-0.2"')
            .replace('radialDistortion2="0"', 'radialDistortion2="0.06"')
            .replace('tangentalDistortion1="0"', 'tangentalDistortion1="0.001"')
            .replace('tangentalDistortion2="0"', 'tangentalDistortion2="-0.002"'),
        ),
        (
            "lab.mcal",
            MCAL.replace('k1="0"', 'k1="-0.2"')
            .replace('k2="0"', 'k2="0.06"')
            .replace('TangentialX="0"', 'TangentialX="0.001"')
            .replace('TangentialY="0"', 'TangentialY="-0.002"'),
        ),
    ],
)
def test_lenses_as_opencv_projects(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    camera = load_cameras(tmp_path / name)[0]
    points = POINTS if name == "lab.xml" else POINTS[:, [0, 2, 1]] * [1, 1, -1]
    position = np.array([0.0, -3.0, 1.0]) if name == "lab.xml" else np.array([0.0, 1.0, 3.0])
    down, ahead = ([0, 0, -1], [0, 1, 0]) if name == "lab.xml" else ([0, -1, 0], [0, 0, -1])
    R = np.array([[1, 0, 0], down, ahead], dtype=float)
    K = np.array([[1250.0, 0, 510.0], [0, 1200.0, 390.0], [0, 0, 1]])
    D = np.array([-0.2, 0.06, 0.001, -0.002, 0.0])
    expected = cv2.projectPoints(points, cv2.Rodrigues(R)[0], -R @ position, K, D)[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-6)
