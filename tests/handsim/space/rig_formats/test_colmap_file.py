"""COLMAP's reconstructions: OpenCV's projections are the oracle."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handsim.errors import RigError
from handsim.space.rig_formats import load_cameras
from handsim.space.transforms import quaternion_matrix, rotation_quaternions

R, T = cv2.Rodrigues(np.array([0.02, -0.08, 0.03]))[0], np.array([[-0.12], [0.003], [0.01]])
POINTS = np.random.default_rng(3).uniform([-0.15, -0.1, 0.4], [0.15, 0.1, 0.9], (40, 3))


def projected(rotation, translation, matrix, coefficients):
    """OpenCV's projection, with pixels counted from the corner."""
    vector = cv2.Rodrigues(np.asarray(rotation, dtype=float))[0]
    pixels = cv2.projectPoints(POINTS, vector, np.asarray(translation, dtype=float), matrix, coefficients)[0]
    return pixels[:, 0] + 0.5


def colmap(folder, camera, images="1 {} 1 hand one.jpg\n\n"):
    quaternion = rotation_quaternions(R[None])[0]
    pose = " ".join(map(repr, [*map(float, quaternion), *map(float, T[:, 0])]))
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    (folder / "images.txt").write_text("# Image list\n" + images.format(pose))
    return folder


@pytest.mark.parametrize(
    ("model", "parameters", "coefficients"),
    [
        ("SIMPLE_PINHOLE", "600 320 240", [0, 0, 0, 0, 0]),
        ("PINHOLE", "600 600 320 240", [0, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL", "600 320 240 -0.1", [-0.1, 0, 0, 0, 0]),
        ("RADIAL", "600 320 240 -0.1 0.02", [-0.1, 0.02, 0, 0, 0]),
        ("OPENCV", "600 600 320 240 -0.1 0.02 0.001 0.002", [-0.1, 0.02, 0.001, 0.002, 0]),
        ("FULL_OPENCV", "600 600 320 240 -0.1 0.02 0.001 0.002 .01 0 0 0", [-0.1, 0.02, 0.001, 0.002, 0.01]),
    ],
)
def test_colmap(tmp_path, model, parameters, coefficients):
    folder = colmap(tmp_path, f"1 {model} 640 480 {parameters}")
    matrix = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    expected = projected(R, T, matrix, np.array(coefficients, dtype=float)) - 0.5  # from the corner, as ours
    for path in (folder, folder / "cameras.txt", folder / "images.txt"):
        (camera,) = load_cameras(path)
        assert camera.name == "hand_one"
        np.testing.assert_allclose(camera.project(POINTS), expected, atol=1e-6)


def test_colmap_fisheyes_and_points_of_images(tmp_path):
    images = "1 {0} 7 a.png\n1.0 2.0 -1 3 4 5\n2 {0} 7 b.png\n\n"
    folder = colmap(tmp_path, "7 RADIAL_FISHEYE 640 480 600 320 240 0.02 -0.006", images)
    cameras = load_cameras(folder)
    assert [camera.name for camera in cameras] == ["a", "b"]
    assert cameras[0].lens.coefficients == (0.02, -0.006, 0.0, 0.0)
    matrix, k = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.array([0.02, -0.006, 0, 0])
    expected = cv2.fisheye.projectPoints(POINTS[:, None], cv2.Rodrigues(R)[0], T, matrix, k)[0][:, 0]
    np.testing.assert_allclose(cameras[1].project(POINTS), expected, atol=1e-6)
    np.testing.assert_allclose(quaternion_matrix(rotation_quaternions(R[None])[0]), R, atol=1e-12)


@pytest.mark.parametrize(
    ("camera", "images", "message"),
    [
        ("1 FOV 640 480 600 600 320 240 0.1", None, "unknown model 'FOV'"),
        ("1 PINHOLE 640 480 600 600 320", None, "expected whole numbers and 4 parameters"),
        ("1 PINHOLE 640 480 a 600 320 240", None, "'a' is no number"),
        ("1 FULL_OPENCV 640 480 600 600 320 240 0 0 0 0 0 1 0 0", None, "expected the model OPENCV"),
        ("1 PINHOLE 640 480 600 600 320 240", "1 {} 2 a.png\n\n", "unknown camera '2'"),
        ("1 PINHOLE 640 480 600 600 320 240", "1 1 1 0 0 0 0 0 1 a.png\n\n", "length 1.414, expected 1"),
        ("1 PINHOLE 640 480 600 600 320 240", "1 {0} 1 a.png\n\n2 {0} 1 a.jpg\n\n", "two cameras are called"),
        ("1 PINHOLE 640 480 600 600 320 240", "", "0 cameras, expected 1"),
    ],
)
def test_damaged_reconstructions_are_told(tmp_path, camera, images, message):
    folder = colmap(tmp_path, camera, "1 {} 1 a.png\n\n" if images is None else images)
    with pytest.raises(RigError, match=message):
        load_cameras(folder)


def test_other_files_are_told(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"\0")
    with pytest.raises(RigError, match="model_converter writes text"):
        load_cameras(tmp_path / "cameras.bin")
    with pytest.raises(RigError, match="cannot be read"):
        load_cameras(tmp_path / "nothing.yml")
