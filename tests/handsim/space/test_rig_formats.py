"""One rig in the words of every format: the same cameras, whose pixels were worked out by hand."""

from __future__ import annotations

import dataclasses
import struct
import warnings

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handsim import CameraRig, HandSimWarning
from handsim.errors import RigError
from handsim.space import rig_formats
from handsim.space.rig_formats import LabCamera, import_cameras, load_cameras, read_xml
from handsim.space.transforms import quaternion_matrix, rotation_quaternions
from tests.handsim.space.known_rig import (
    MCAL,
    PIXELS,
    POINT,
    POINTS,
    POSITIONS,
    QUALISYS,
    XCP,
    R,
    T,
    check,
    projected,
    written,
)
from tests.rigs import mixed_rig

KINDS = ("vicon", "qualisys", "server", "intri", "extri", "json", "nested")
NAMES = {
    "vicon": ("2100", "2101"),
    "qualisys": ("11503", "11504"),
    "server": ("11503", "11504"),
    "intri": ("01", "02"),
    "extri": ("01", "02"),
    "json": ("left_one", "right"),
    "nested": ("camera_0", "camera_1"),
}
BAD = [
    ("a.xcp", XCP, '"0.5 0.5 -0.5 0.5"', '"0 0 0 0"', "quaternion of length 0, expected 1"),
    ("a.xcp", XCP, "4000 1000 2000", "nan 1000 2000", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "4000 1000", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "1e300 0 0", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "4e6 0 0", "stands 4000 m from the origin"),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', "", 'camera "2100" lacks FOCAL_LENGTH'),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', 'FOCAL_LENGTH="0"', "with positive fx and fy"),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', 'FOCAL_LENGTH="long"', 'is "long", expected a finite number'),
    ("a.xcp", XCP, 'SENSOR_SIZE="1000 800"', 'SENSOR_SIZE="1000.5 800"', "whole numbers of pixels"),
    ("a.xcp", XCP, 'SENSOR_SIZE="1000 800"', 'SENSOR_SIZE="100000 800"', "1 to 8192 whole pixels"),
    ("a.xcp", XCP, 'RATIO="1.0416666666666667"', 'RATIO="0"', "PIXEL_ASPECT_RATIO is 0"),
    ("a.xcp", XCP, "ViconRadial2 510 390 0 0 0", "510 390 0 0 0", "a name and five numbers"),
    ("a.xcp", XCP, "</Cameras>", "", "it is no XML"),
    ("a.xcp", XCP, "Cameras", "cameras", "it is no XML"),
    ("a.xml", QUALISYS, 'r33="0"', 'r33="7"', "r11 to r33 is not a rotation matrix"),
    ("a.xml", QUALISYS, 'r11="1"', 'r11="-1"', "r11 to r33 is not a rotation matrix"),
    ("a.xml", QUALISYS, 'r23="1"', "", 'camera "11503" lacks r23'),
    ("a.xml", QUALISYS, 'focalLengthU="80000"', 'focalLengthU="-1"', "with positive fx and fy"),
    ("a.xml", QUALISYS, 'right="999" bottom="799"', 'right="0" bottom="799"', "<fov_marker> is empty"),
    ("a.xml", QUALISYS, "<transform x", "<transformed x", "lacks <transform>"),
    ("a.xml", QUALISYS, '<calibration source="by hand"', '<settings source="by hand"', "it is no XML"),
    ("a.mcal", MCAL, 'OrientMatrix4="1"', 'OrientMatrix4="-1"', "OrientMatrix is not a rotation matrix"),
    ("a.mcal", MCAL, 'PixelWidth="1000"', 'PixelWidth="inf"', "ImagerPixelWidth is .inf., expected"),
    ("a.mcal", MCAL, "<Attributes", "<Attribute", "lacks <Attributes>"),
]
CAMERAS = mixed_rig().cameras
POINTS_LENSES = np.random.default_rng(5).uniform([-1.2, 1.0, 0.3], [1.2, 2.0, 1.9], (50, 3))
BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY a "lol">{}]>
<Cameras>&j;</Cameras>""".format(
    "".join(f'<!ENTITY {chr(98 + n)} "{f"&{chr(97 + n)};" * 10}">' for n in range(9))
)
LOCAL = np.random.default_rng(2).uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 4.0], (20, 3))


@pytest.mark.parametrize("kind", [*KINDS, "motive"])
def test_the_known_rig(tmp_path, kind):
    path = written(tmp_path)[kind]
    if kind != "motive":  # whose y is up
        cameras = load_cameras(path)
        check(cameras)
        assert tuple(camera.name for camera in cameras) == NAMES[kind]
        assert {camera.lens.kind for camera in cameras} == {"pinhole"}
    rig = CameraRig("lab", import_cameras(path))
    np.testing.assert_allclose(rig.positions, POSITIONS, atol=1e-6)
    np.testing.assert_allclose(rig.project(POINT), PIXELS, atol=1e-3)


def damaged(path, text, old, new, encoding="utf-8"):
    assert text.count(old) >= 1, old
    path.write_bytes(text.replace(old, new, 1).encode(encoding))
    return path


@pytest.mark.parametrize(("name", "text", "old", "new", "message"), BAD)
def test_wrong_values_are_told(tmp_path, name, text, old, new, message):
    encoding = "utf-16" if name.endswith("mcal") else "utf-8"
    path = damaged(tmp_path / name, text, old, new, encoding)
    with pytest.raises(RigError, match=message) as caught:
        load_cameras(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("ending", "message"), [(".cal", "Motive 3.2"), (".qca", "export"), (".bin", "model_conv")]
)
def test_closed_formats_say_what_to_export(tmp_path, ending, message):
    (tmp_path / f"lab{ending}").write_bytes(b"\0\1\2")
    with pytest.raises(RigError, match=message):
        load_cameras(tmp_path / f"lab{ending}")


def test_cameras_that_are_not_calibrated_are_left_out(tmp_path):
    start = XCP.index("<KeyFrames>")
    path = tmp_path / "lab.xcp"
    path.write_text(XCP[:start] + "<KeyFrames>" + XCP[XCP.index("</KeyFrames>") :])
    with pytest.warns(HandSimWarning, match="1 of 2 cameras are left out: 2100 is not calibrated"):
        (left,) = load_cameras(path)
    assert left.name == "2101"
    path = damaged(tmp_path / "lab.xml", QUALISYS, 'active="1"', 'active="0"')
    with pytest.warns(HandSimWarning, match="11503 is switched off"):
        assert len(load_cameras(path)) == 1
    path = damaged(tmp_path / "lab.mcal", MCAL, "<Extrinsic", "<Nothing", "utf-16-le")
    with pytest.warns(HandSimWarning, match="M21614 is not calibrated"):
        assert len(load_cameras(path)) == 1
    path.write_text(MCAL.replace("Camera Serial", "Other Serial").replace("</Camera>", "</Other>"))
    with pytest.raises(RigError, match="0 cameras, expected 1"):
        load_cameras(path)


def test_two_cameras_of_one_name(tmp_path):
    path = damaged(tmp_path / "lab.xcp", XCP, 'DEVICEID="2101"', 'DEVICEID="2100"')
    assert [camera.name for camera in load_cameras(path)] == ["2100", "2100_2"]


def test_a_binned_sensor(tmp_path):
    """Two by two pixels of the sensor are one of the picture: half the focal length and principal point."""
    text = QUALISYS.replace('sensorMaxU="63999"', 'sensorMaxU="127999"').replace('"51199"', '"102399"')
    camera = load_cameras(damaged(tmp_path / "lab.xml", text, "80000", "160000"))[0]
    assert camera.K[0, 0] == pytest.approx(1250.0) and camera.K[1, 1] == pytest.approx(600.0)
    assert camera.K[0, 2] == pytest.approx(255.0) and camera.size == (1000, 800)


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


def test_colmap_in_binary(tmp_path):
    parameters = [600.0, 601.0, 320.0, 240.0, 0.02, -0.006, 0.001, 0.002]
    camera = f"7 OPENCV_FISHEYE 640 480 {' '.join(map(str, parameters))}"
    text = colmap(tmp_path, camera, "1 {0} 7 a b.png\n\n")
    expected = load_cameras(text)
    folder = tmp_path / "0"
    folder.mkdir()
    words = (text / "images.txt").read_text().split("\n")[1].split()
    pose = struct.pack("<Qi7di", 1, 1, *map(float, words[1:8]), 7)
    points = struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.0, 2.0, -1)
    contents = {
        "cameras.bin": struct.pack("<QiiQQ8d", 1, 7, 5, 640, 480, *parameters),
        "images.bin": pose + b"a b.png\0" + points,
    }
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    for path in (folder, folder / "cameras.bin", folder / "images.bin"):
        assert load_cameras(path) == expected
    for name, data in contents.items():
        for cut in (2, 8, 30, len(data) - 3):
            (folder / name).write_bytes(data[:cut])
            with pytest.raises(RigError, match=rf"{name}: cut or damaged.* model_converter writes text"):
                load_cameras(folder)
        (folder / name).write_bytes(data)


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


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(RigError, match="cannot be read"):
        load_cameras(tmp_path / "nothing.yml")


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
    stating = [one._replace(y_up=True) for one in turned]
    assert told(stating) == (cameras, [])
    on_side = np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    sideways = [one._replace(camera=one.camera.at(one.camera.T_world_camera @ on_side)) for one in stating]
    assert told(sideways)[1] == []  # pictures do not show what the file states
    assert len(told(sideways, "z")[1]) == 1


def test_video_cameras_see_no_markers(told):
    found = [*(LabCamera(one) for one in CAMERAS[:2]), LabCamera(CAMERAS[2], video=True)]
    cameras, (sentence,) = told(found)
    assert cameras == CAMERAS[:2] and "are left out: c2" in sentence
    assert len(told([one._replace(video=True) for one in found])[0]) == 3


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
    measured = camera.project(POINTS_LENSES) - [510.0, 390.0]
    inside = (np.abs(measured) < [490.0, 390.0]).all(axis=1)
    square = (measured**2).sum(axis=1, keepdims=True)
    corrected = measured * (1.0 + k1 * square + k2 * square**2 + k3 * square**3)
    ahead = POINTS_LENSES[:, 1] + 3.0
    straight = np.stack([POINTS_LENSES[:, 0] / ahead, -(POINTS_LENSES[:, 2] - 1.0) / ahead], axis=1) * 1250.0
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
    points = POINTS_LENSES if name == "lab.xml" else POINTS_LENSES[:, [0, 2, 1]] * [1, 1, -1]
    position = np.array([0.0, -3.0, 1.0]) if name == "lab.xml" else np.array([0.0, 1.0, 3.0])
    down, ahead = ([0, 0, -1], [0, 1, 0]) if name == "lab.xml" else ([0, -1, 0], [0, 0, -1])
    R = np.array([[1, 0, 0], down, ahead], dtype=float)
    K = np.array([[1250.0, 0, 510.0], [0, 1200.0, 390.0], [0, 0, 1]])
    D = np.array([-0.2, 0.06, 0.001, -0.002, 0.0])
    expected = cv2.projectPoints(points, cv2.Rodrigues(R)[0], -R @ position, K, D)[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "has a document type"),
        ('<!DOCTYPE c SYSTEM "file:///etc/passwd"><Cameras/>', "has a document type"),
        ('<!DOCTYPE c [<!ENTITY x SYSTEM "/etc/passwd">]><Cameras>&x;</Cameras>', "has a document type"),
        ("<Cameras>&x;</Cameras>", "it is no XML"),
        ("<a>" * 100_000, "nested deeper than 64"),
        ("<Cameras>" + "<a/>" * 300_000 + "</Cameras>", "more than 200000 elements"),
        ("", "it is no XML"),
        ("\0" * 1000, "it is no XML"),
        ("Cameras", "it is no XML"),
        ('<Cameras a="1" a="2"/>', "it is no XML"),
    ],
)
def test_hostile_xml(tmp_path, content, message):
    path = tmp_path / "lab.xcp"
    path.write_text(content)
    with pytest.raises(RigError, match=message):
        load_cameras(path)


def test_a_giant_file(tmp_path):
    path = tmp_path / "lab.xcp"
    with path.open("wb") as file:
        file.truncate(rig_formats._MAX_XML_BYTES + 1)
    with pytest.raises(RigError, match="bytes long, expected at most"):
        read_xml(path)


def test_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "lab.xcp"
    path.write_bytes(b"<Cameras NAME='\xe9'/>")
    with pytest.raises(RigError, match="it is no XML text"):
        read_xml(path)
    path.write_bytes(b"<?xml version='1.0' encoding='ISO-8859-1'?><Cameras NAME='\xe9'/>")
    assert read_xml(path).get("NAME") == "é"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(tmp_path, encoding):
    path = tmp_path / "lab.xcp"
    path.write_bytes(XCP.encode(encoding))
    check(load_cameras(path))


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
