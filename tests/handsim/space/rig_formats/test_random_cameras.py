"""Cameras anywhere, turned anyhow: what a format says of them, against OpenCV's projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handsim.space.rig_formats import load_cameras

LOCAL = np.random.default_rng(2).uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 4.0], (20, 3))


def vicon(R, position):
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    x_mm, y_mm, z_mm = 1e3 * position
    return (
        '<Cameras><Camera DEVICEID="7" SENSOR_SIZE="1000 800" PIXEL_ASPECT_RATIO="1.25"><KeyFrames>'
        f'<KeyFrame FOCAL_LENGTH="1250" ORIENTATION="{x} {y} {z} {w}" POSITION="{x_mm} {y_mm} {z_mm}" '
        'PRINCIPAL_POINT="510 390"/></KeyFrames></Camera></Cameras>'
    )


def qualisys(R, position):
    """Half a turn about the camera's x makes its y up and its z backward."""
    rows = Rotation.from_euler("x", 180, degrees=True).as_matrix() @ R
    matrix = " ".join(f'r{i + 1}{j + 1}="{rows[i, j]}"' for i in range(3) for j in range(3))
    x, y, z = 1e3 * position
    return (
        '<calibration><cameras><camera serial="7"><fov_marker left="0" top="0" right="999" bottom="799"/>'
        f'<transform x="{x}" y="{y}" z="{z}" {matrix}/><intrinsic focalLengthU="80000" focalLengthV="64000" '
        'centerPointU="32640" centerPointV="24960"/></camera></cameras></calibration>'
    )


def motive(R, position):
    columns = R.T @ Rotation.from_euler("x", 180, degrees=True).as_matrix()
    matrix = " ".join(f'OrientMatrix{n}="{value}"' for n, value in enumerate(columns.ravel()))
    x, y, z = position
    return (
        '<calibrationProfile><Camera Serial="7"><Attributes ImagerPixelWidth="1000" ImagerPixelHeight="800"/>'
        '<IntrinsicStandardCameraModel LensCenterX="510" LensCenterY="390" HorizontalFocalLength="1250" '
        f'VerticalFocalLength="1000"/><Extrinsic X="{x}" Y="{y}" Z="{z}" {matrix}/></Camera>'
        "</calibrationProfile>"
    )


@pytest.mark.parametrize(("ending", "words"), [(".xcp", vicon), (".xml", qualisys), (".mcal", motive)])
@settings(max_examples=40, deadline=None)
@given(vector=st.tuples(*[st.floats(-3.0, 3.0)] * 3), position=st.tuples(*[st.floats(-8.0, 8.0)] * 3))
def test_any_pose(tmp_path_factory, ending, words, vector, position):
    R, place = cv2.Rodrigues(np.array(vector))[0], np.array(position)
    path = tmp_path_factory.getbasetemp() / f"any{ending}"
    path.write_text(words(R, place))
    (camera,) = load_cameras(path)
    K = np.array([[1250.0, 0, 510], [0, 1000, 390], [0, 0, 1]])
    points = LOCAL @ R + place  # R takes the world to the camera
    expected = cv2.projectPoints(points, np.array(vector), -R @ place, K, np.zeros(5))[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-5)
