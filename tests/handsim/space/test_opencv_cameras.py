"""One camera, pairs and rectified pairs, stored and projected by OpenCV itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handsim.errors import RigError
from handsim.space.rig_formats import load_cameras
from tests.handsim.space.known_rig import POINTS, K, R, T, projected

D = np.array([[-0.2, 0.06, 0.001, -0.0015, 0.01]])


def stored(path, values):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path


SIZE = {"image_width": 640, "image_height": 480}


@pytest.mark.parametrize("ending", ["yml", "json"])
def test_opencv_calibration_of_one_camera(tmp_path, ending):
    values = {"camera_matrix": K, "distortion_coefficients": D.T, **SIZE}
    (camera,) = load_cameras(stored(tmp_path / f"camera.{ending}", values))
    assert camera.size == (640, 480)
    np.testing.assert_allclose(camera.project(POINTS), projected(np.eye(3), np.zeros(3), K, D), atol=1e-6)
    (placed,) = load_cameras(stored(tmp_path / f"placed.{ending}", values | {"R": R, "T": T}))
    np.testing.assert_allclose(placed.project(POINTS), projected(R, T, K, D), atol=1e-6)


@pytest.mark.parametrize("ending", ["yml", "json"])
@pytest.mark.parametrize("vector", [False, True])
def test_opencv_stereo(tmp_path, ending, vector):
    other = K + np.diag([5.0, 4.0, 0.0])
    values = {"M1": K, "D1": D, "M2": other, "D2": 0.5 * D, "R": cv2.Rodrigues(R)[0] if vector else R, "T": T}
    left, right = load_cameras(stored(tmp_path / f"pair.{ending}", values | SIZE))
    np.testing.assert_allclose(left.project(POINTS), projected(np.eye(3), np.zeros(3), K, D), atol=1e-6)
    np.testing.assert_allclose(right.project(POINTS), projected(R, T, other, 0.5 * D), atol=1e-6)


def test_the_two_files_of_opencvs_stereo_sample(tmp_path):
    inner = stored(tmp_path / "intrinsics.yml", {"M1": K, "D1": D, "M2": K, "D2": D} | SIZE)
    outer = stored(tmp_path / "extrinsics.yml", {"R": R, "T": T, "R1": np.eye(3), "P1": np.eye(3, 4)})
    for path in (inner, outer):
        _, right = load_cameras(path)
        np.testing.assert_allclose(right.project(POINTS), projected(R, T, K, D), atol=1e-6)


def test_a_rectified_pair(tmp_path):
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K, D, K, D, (640, 480), R, T)
    path = stored(tmp_path / "rectified.yml", {"R1": R1, "R2": R2, "P1": P1, "P2": P2} | SIZE)
    for camera, P in zip(load_cameras(path), (P1, P2), strict=True):
        homogeneous = np.c_[POINTS, np.ones(len(POINTS))] @ P.T
        np.testing.assert_allclose(camera.project(POINTS), homogeneous[:, :2] / homogeneous[:, 2:] + 0.5)


def test_fisheyes(tmp_path):
    k = np.array([0.02, -0.006, 0.001, 0.0])
    values = {"camera_matrix": K, "distortion_coefficients": k, "fisheye_model": 1, **SIZE}
    (camera,) = load_cameras(stored(tmp_path / "fish.yml", values))
    expected = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, k)[0][:, 0]
    np.testing.assert_allclose(camera.project(POINTS), expected + 0.5, atol=1e-6)


def test_a_calibration_without_opencvs_header(tmp_path):
    path = tmp_path / "head.yaml"
    rows = "  rows: {}\n  cols: {}\n  data: {}\n"
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: head\ncamera_matrix:\n"
        + rows.format(3, 3, K.ravel().tolist())
        + "distortion_model: plumb_bob\ndistortion_coefficients:\n"
        + rows.format(1, 5, D.ravel().tolist())
    )
    (camera,) = load_cameras(path)
    np.testing.assert_allclose(camera.project(POINTS), projected(np.eye(3), np.zeros(3), K, D), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_width": None}, "no size of the pictures"),
        ({"camera_matrix": None}, "no 'camera_matrix'"),
        ({"camera_matrix": np.eye(2)}, "has 4 numbers, expected 3 x 3"),
        ({"distortion_coefficients": np.full((1, 8), 0.1)}, "after the fifth are not 0"),
        ({"R": np.diag([1.0, 1.0, -1.0]), "T": T}, "R is not a rotation"),
        ({"R": R}, "no 'T'"),
        ({"R": R, "T": 1e5 * T}, "are these millimeters"),
        ({"M1": K, "M2": K, "R": R, "T": 1e3 * T}, "the cameras are 120.5 m apart"),
        ({"camera_matrix": np.array([[np.nan, 0, 1], [0, 2, 1], [0, 0, 1]])}, "camera_matrix is no list"),
    ],
)
def test_damaged_calibrations_are_told(tmp_path, changes, message):
    values = {"camera_matrix": K, "distortion_coefficients": D, **SIZE} | changes
    path = stored(tmp_path / "c.yml", {key: value for key, value in values.items() if value is not None})
    with pytest.raises(RigError, match=message):
        load_cameras(path)
