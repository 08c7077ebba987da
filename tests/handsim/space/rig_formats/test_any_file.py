"""One rig in the words of every format: the same cameras, whose pixels were worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.errors import HandSimWarning, RigError
from handsim.space.rig import CameraRig
from handsim.space.rig_formats import import_cameras, load_cameras
from tests.handsim.space.rig_formats.known_rig import (
    MCAL,
    PIXELS,
    POINT,
    POSITIONS,
    QUALISYS,
    XCP,
    check,
    written,
)

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


@pytest.mark.parametrize("kind", KINDS)
def test_the_known_rig(tmp_path, kind):
    cameras = load_cameras(written(tmp_path)[kind])
    check(cameras)
    assert tuple(camera.name for camera in cameras) == NAMES[kind]
    assert {camera.lens.kind for camera in cameras} == {"pinhole"}


@pytest.mark.parametrize("kind", [*KINDS, "motive"])
def test_the_known_rig_as_a_rig(tmp_path, kind):
    path = written(tmp_path)[kind]
    rig = CameraRig("lab", import_cameras(path))
    np.testing.assert_allclose(rig.positions, POSITIONS, atol=1e-6)
    np.testing.assert_allclose(rig.project(POINT), PIXELS, atol=1e-3)


def damaged(path, text, old, new, encoding="utf-8"):
    assert text.count(old) >= 1, old
    path.write_bytes(text.replace(old, new, 1).encode(encoding))
    return path


BAD = [
    (
        "a.xcp",
        XCP,
        'ORIENTATION="0.5 0.5 -0.5 0.5"',
        'ORIENTATION="0 0 0 0"',
        "quaternion of length 0, expected 1",
    ),
    ("a.xcp", XCP, "4000 1000 2000", "nan 1000 2000", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "4000 1000", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "1e300 0 0", "POSITION is .*, expected 3 finite numbers"),
    ("a.xcp", XCP, "4000 1000 2000", "4e6 0 0", "stands 4000 m from the origin"),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', "", 'camera "2100" lacks FOCAL_LENGTH'),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', 'FOCAL_LENGTH="0"', "expected positive pixels"),
    ("a.xcp", XCP, 'FOCAL_LENGTH="1250"', 'FOCAL_LENGTH="long"', 'is "long", expected a finite number'),
    ("a.xcp", XCP, 'SENSOR_SIZE="1000 800"', 'SENSOR_SIZE="1000.5 800"', "whole numbers of pixels"),
    ("a.xcp", XCP, 'SENSOR_SIZE="1000 800"', 'SENSOR_SIZE="100000 800"', "expected 1 to 8192"),
    ("a.xcp", XCP, 'RATIO="1.0416666666666667"', 'RATIO="0"', "PIXEL_ASPECT_RATIO is 0"),
    ("a.xcp", XCP, "ViconRadial2 510 390 0 0 0", "510 390 0 0 0", "a name and five numbers"),
    ("a.xcp", XCP, "</Cameras>", "", "it is no XML"),
    ("a.xcp", XCP, "Cameras", "cameras", "it is no XML"),
    ("a.xml", QUALISYS, 'r33="0"', 'r33="7"', "r11 to r33 is not a rotation matrix"),
    ("a.xml", QUALISYS, 'r11="1"', 'r11="-1"', "r11 to r33 is not a rotation matrix"),
    ("a.xml", QUALISYS, 'r23="1"', "", 'camera "11503" lacks r23'),
    ("a.xml", QUALISYS, 'focalLengthU="80000"', 'focalLengthU="-1"', "expected positive pixels"),
    ("a.xml", QUALISYS, 'right="999" bottom="799"', 'right="0" bottom="799"', "<fov_marker> is empty"),
    ("a.xml", QUALISYS, "<transform x", "<transformed x", "lacks <transform>"),
    ("a.xml", QUALISYS, '<calibration source="by hand"', '<settings source="by hand"', "it is no XML"),
    ("a.mcal", MCAL, 'OrientMatrix4="1"', 'OrientMatrix4="-1"', "OrientMatrix is not a rotation matrix"),
    (
        "a.mcal",
        MCAL,
        'ImagerPixelWidth="1000"',
        'ImagerPixelWidth="inf"',
        "ImagerPixelWidth is .inf., expected",
    ),
    ("a.mcal", MCAL, "<Attributes", "<Attribute", "lacks <Attributes>"),
]


@pytest.mark.parametrize(("name", "text", "old", "new", "message"), BAD)
def test_wrong_values_are_told(tmp_path, name, text, old, new, message):
    encoding = "utf-16" if name.endswith("mcal") else "utf-8"
    path = damaged(tmp_path / name, text, old, new, encoding)
    with pytest.raises(RigError, match=message) as caught:
        load_cameras(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_other_xml_is_told(tmp_path):
    (tmp_path / "page.xml").write_text("<html><body/></html>")
    with pytest.raises(RigError, match="begins with <html>, expected <Cameras>, <calibration>"):
        load_cameras(tmp_path / "page.xml")


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
