"""A rig written by hand in the words of every format; points of it projected with pencil and paper.

Camera A stands at (0, -3, 1) m and looks along +y: its picture's right is +x, its picture's top is +z.
Camera B stands at (4, 1, 2) m and looks along -x: right is +y, top is +z. Both have 1000 x 800 pixels, focal
lengths of 1250 and 1200 pixels, and the principal point (510, 390) from the picture's corner.

The point P = (0.4, 1, 1.5) m lies 4 m before A, 0.4 m to the right and 0.5 m up: right of the principal
point by 1250 * 0.4 / 4 = 125 pixels and above it by 1200 * 0.5 / 4 = 150. It lies 3.6 m before B, in the
middle and 0.5 m down: below by 1200 * 0.5 / 3.6 = 166.667.
"""

from __future__ import annotations

import cv2
import numpy as np

POINT = np.array([0.4, 1.0, 1.5])
PIXELS = np.array([[510.0 + 125.0, 390.0 - 150.0], [510.0, 390.0 + 166.0 + 2.0 / 3.0]])
SIZE = (1000, 800)
POSITIONS = np.array([[0.0, -3.0, 1.0], [4.0, 1.0, 2.0]])
AHEAD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
RIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# Vicon: the quaternion xyzw turns the world into x right, y down, z ahead. For A that is a turn about x by
# +90 degrees (z up becomes -y, y ahead becomes z). B is A's after a turn of the world about z that takes
# -x to +y, by -90 degrees: (1, 0, 0, 1)/sqrt2 * (0, 0, -1, 1)/sqrt2 = (1, 1, -1, 1)/2 as xyzw.
H = "0.70710678118654757"
XCP = f"""<?xml version="1.0" encoding="UTF-8" standalone="no" ?>
<Cameras SOURCE="by hand" VERSION="2.0">
  <Camera DEVICEID="2100" DISPLAY_TYPE="Vantage" PIXEL_ASPECT_RATIO="1.0416666666666667"
      SENSOR_SIZE="1000 800" SKEW="0" SYSTEM="" TYPE="Vantage">
    <ThresholdGrid BIT_DEPTH="1" DATA=" r 36000 0" GRID_SIZE="240 150" TILE_SIZE="8 8"/>
    <KeyFrames>
      <KeyFrame FOCAL_LENGTH="1250" FRAME="0" ORIENTATION="{H} 0 0 {H}" POSITION="0 -3000 1000"
          PRINCIPAL_POINT="510 390" VICON_RADIAL="0 0" WORLD_ERROR="0.2"/>
    </KeyFrames>
  </Camera>
  <Camera DEVICEID="2101" DISPLAY_TYPE="Vantage" PIXEL_ASPECT_RATIO="1.0416666666666667"
      SENSOR_SIZE="1000 800" SKEW="0" SYSTEM="" TYPE="Vantage">
    <KeyFrames>
      <KeyFrame FOCAL_LENGTH="1250" FRAME="0" ORIENTATION="0.5 0.5 -0.5 0.5" POSITION="4000 1000 2000"
          PRINCIPAL_POINT="510 390" VICON_RADIAL2="ViconRadial2 510 390 0 0 0" WORLD_ERROR="0.2"/>
    </KeyFrames>
  </Camera>
</Cameras>
"""
# Qualisys: rows of the matrix are right, up, backward. 64ths: 1250 * 64 = 80000, 1200 * 64 = 76800,
# 510 * 64 = 32640, 390 * 64 = 24960. B uses a part of its sensor that begins at column 20 and row 10, and its
# principal point on the sensor is (530, 400): 33920 and 25600.
_INNER = (
    '<intrinsic focallength="12" sensorMinU="0" sensorMaxU="{}" sensorMinV="0" sensorMaxV="{}" '
    'focalLengthU="80000" focalLengthV="76800" centerPointU="{}" centerPointV="{}" skew="0" '
    'radialDistortion1="0" radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0" '
    'tangentalDistortion2="0"/>'
)
QUALISYS = f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<calibration source="by hand" type="regular" wandLength="600">
<results std-dev="0.5" min-max-diff="2"/>
<cameras>
<camera active="1" calibrated="true" serial="11503" model="Oqus 300" viewrotation="0">
<fov_marker left="0" top="0" right="999" bottom="799"/>
<fov_marker_max left="0" top="0" right="999" bottom="799"/>
<fov_video left="0" top="0" right="499" bottom="399"/>
<transform x="0" y="-3000" z="1000" r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"/>
{_INNER.format(63999, 51199, 32640, 24960)}
</camera>
<camera active="1" calibrated="true" serial="11504" model="Oqus 300" viewrotation="180">
<fov_marker left="20" top="10" right="1019" bottom="809"/>
<fov_marker_max left="0" top="0" right="1279" bottom="1023"/>
<fov_video left="0" top="0" right="1279" bottom="1023"/>
<transform x="4000" y="1000" z="2000" r11="0" r12="1" r13="0" r21="0" r22="0" r23="1"
    r31="1" r32="0" r33="0"/>
{_INNER.format(81919, 65535, 33920, 25600)}
</camera>
</cameras>
</calibration>
"""
# Motive: y up. What is x right, y ahead, z up here is x right, -z ahead, y up there: (x, y, z) becomes
# (x, z, -y). Columns of the matrix are right, up, backward.
_LENS = (
    'LensCenterX="510" LensCenterY="390" HorizontalFocalLength="1250" VerticalFocalLength="1200" '
    'k1="0" k2="0" k3="0" TangentialX="0" TangentialY="0"/>'
)
# OpenCV: rows of R are right, down, ahead, and T = -R position. Its pixels count from the first one's center.
# A: T = -(0, -1, -3) = (0, 1, 3). B: rows y, -z, -x: T = -(1, -2, -4) = (-1, 2, 4).
MATRIX = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [ {} ]\n"
_K = "1250., 0., 509.5, 0., 1200., 389.5, 0., 0., 1."
OPENCV_INTRI = (
    '%YAML:1.0\n---\nnames:\n   - "01"\n   - "02"\nimage_width: 1000\nimage_height: 800\n'
    + "".join(
        MATRIX.format(f"K_{name}", 3, 3, _K) + MATRIX.format(f"dist_{name}", 1, 5, "0., 0., 0., 0., 0.")
        for name in ("01", "02")
    )
)
OPENCV_EXTRI = (
    '%YAML:1.0\n---\nnames:\n   - "01"\n   - "02"\n'
    + MATRIX.format("R_01", 3, 1, "1.5707963267948966, 0., 0.")
    + MATRIX.format("T_01", 3, 1, "0., 1., 3.")
    + MATRIX.format("Rot_02", 3, 3, "0., 1., 0.,\n       0., 0., -1., -1., 0., 0.")
    + MATRIX.format("T_02", 3, 1, "-1., 2., 4.")
)
OPENCV_JSON = """{"cameras": [
{"name": "left one", "resolution": [1000, 800], "K": [[1250, 0, 509.5], [0, 1200, 389.5], [0, 0, 1]],
 "distCoef": [0, 0, 0, 0, 0], "R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "t": [[0], [1], [3]]},
{"name": "right", "resolution": [1000, 800], "K": [[1250, 0, 509.5], [0, 1200, 389.5], [0, 0, 1]],
 "R": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], "t": [-1, 2, 4]}
]}
"""
OPENCV_NESTED = "%YAML:1.0\n---\nnb_camera: 2\nimage_width: 1000\nimage_height: 800\n" + "".join(
    f"camera_{n}:\n   camera_matrix: !!opencv-matrix\n      rows: 3\n      cols: 3\n      dt: d\n"
    f"      data: [ {_K} ]\n   R: !!opencv-matrix\n      rows: 3\n      cols: 3\n      dt: d\n"
    f"      data: [ {R} ]\n   T: [ {T} ]\n"
    for n, R, T in (
        (0, "1., 0., 0., 0., 0., -1., 0., 1., 0.", "0., 1., 3."),
        (1, "0., 1., 0., 0., 0., -1.,\n          -1., 0., 0.", "-1., 2., 4."),
    )
)
K = np.array([[610.0, 0, 321.5], [0, 612.0, 238.25], [0, 0, 1]])
POINTS = np.random.default_rng(3).uniform([-0.15, -0.1, 0.4], [0.15, 0.1, 0.9], (40, 3))


def check(cameras, *, point=POINT, pixels=PIXELS):
    assert [camera.size for camera in cameras] == [SIZE, SIZE]
    for camera, expected in zip(cameras, pixels, strict=True):
        np.testing.assert_allclose(camera.project(point), expected, atol=1e-3)
    axes = np.array([camera.T_world_camera[:3, :3] for camera in cameras])
    np.testing.assert_allclose(axes[:, :, 0], RIGHT, atol=1e-6)
    np.testing.assert_allclose(axes[:, :, 1], [[0, 0, -1], [0, 0, -1]], atol=1e-6)
    np.testing.assert_allclose(axes[:, :, 2], AHEAD, atol=1e-6)
    np.testing.assert_allclose([camera.T_world_camera[:3, 3] for camera in cameras], POSITIONS, atol=1e-9)


def _extrinsic(position, columns):
    matrix = np.array(columns).T.ravel()
    numbers = " ".join(f'OrientMatrix{n}="{value}"' for n, value in enumerate(matrix))
    return '<Extrinsic X="{}" Y="{}" Z="{}" '.format(*position) + numbers + "/>"


MCAL = f"""<?xml version="1.0" encoding="UTF-16LE"?>
<calibrationProfile version="1">
<MotiveBuildInfo AppVersion="3.4.0.2"/>
<Calibration><Cameras Count="2">
<Camera Serial="M21614">
<Properties CameraID="1" ImagerIndex="00"/>
<Attributes ImagerPixelWidth="1000" ImagerPixelHeight="800"/>
<Intrinsic {_LENS.replace('k1="0"', 'k1="0.3"')}
<IntrinsicStandardCameraModel {_LENS}
{_extrinsic((0, 1, 3), [(1, 0, 0), (0, 1, 0), (0, 0, 1)])}
</Camera>
<Camera Serial="M21615">
<Properties CameraID="2" ImagerIndex="00"/>
<Attributes ImagerPixelWidth="1000" ImagerPixelHeight="800"/>
<IntrinsicStandardCameraModel {_LENS}
{_extrinsic((4, 2, -1), [(0, 0, -1), (0, 1, 0), (1, 0, 0)])}
</Camera>
</Cameras></Calibration>
</calibrationProfile>
"""


def written(folder):
    """Every format's files, by the name of the format; `extri.yml` has `intri.yml` beside it."""
    files = {
        "vicon": ("lab.xcp", XCP.encode()),
        "qualisys": ("lab.qca.txt", QUALISYS.encode("latin-1")),
        "server": ("lab.xml", f"<QTM_Parameters_Ver_1.25>{QUALISYS[44:]}</QTM_Parameters_Ver_1.25>".encode()),
        "motive": ("lab.mcal", b"\xff\xfe" + MCAL.encode("utf-16-le")),
        "intri": ("intri.yml", OPENCV_INTRI.encode()),
        "extri": ("extri.yml", OPENCV_EXTRI.encode()),
        "json": ("lab.json", OPENCV_JSON.encode()),
        "nested": ("lab.yaml", OPENCV_NESTED.encode()),
    }
    for name, content in files.values():
        (folder / name).write_bytes(content)
    return {kind: folder / name for kind, (name, _) in files.items()}


R, T = cv2.Rodrigues(np.array([0.02, -0.08, 0.03]))[0], np.array([[-0.12], [0.003], [0.01]])


def projected(rotation, translation, matrix, coefficients):
    """OpenCV's projection, with pixels counted from the corner."""
    vector = cv2.Rodrigues(np.asarray(rotation, dtype=float))[0]
    pixels = cv2.projectPoints(POINTS, vector, np.asarray(translation, dtype=float), matrix, coefficients)[0]
    return pixels[:, 0] + 0.5
