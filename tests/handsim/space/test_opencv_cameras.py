"""One camera, pairs and rectified pairs, stored and projected by OpenCV itself."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from handsim import load_rig
from handsim.errors import HandSimWarning, RigError
from handsim.space.rig_formats import load_cameras
from tests.handsim.space.known_rig import POINTS, K, R, T, projected

D = np.array([[-0.2, 0.06, 0.001, -0.0015, 0.01]])
SIZE = {"image_width": 640, "image_height": 480}
FISH = np.array([-0.012, 0.004, -0.006, 0.001])
POSE = np.vstack([np.c_[R, T], [[0.0, 0.0, 0.0, 1.0]]])
VECTOR = cv2.Rodrigues(R)[0]
LISTED = {"camera_matrix": K.tolist(), "dist_coeffs": D.ravel().tolist(), **SIZE}
ONE = {"K": K.tolist(), "dist": [D.ravel().tolist()], "image_size": [640, 480]}
PLACED = {"R": R.tolist(), "T": T.ravel().tolist()}


def stored(path, values):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path


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


def calibrated(path, lines):
    """The file of one camera with four coefficients, and further lines."""
    stored(path, {"camera_matrix": K, "distortion_coefficients": FISH, **SIZE})
    path.write_text(path.read_text() + lines)
    return path


def is_the_fisheye(camera):
    expected = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, FISH)[0][:, 0]
    np.testing.assert_allclose(camera.project(POINTS), expected + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    "key", ["distortion_model", "DistortionModel", "camera_model", "projection-type", "model"]
)
@pytest.mark.parametrize("name", ["Equidistant", "KANNALA-BRANDT4", "fisheye (equidistant)", "kb4  # four"])
def test_other_names_of_a_fisheye(tmp_path, key, name):
    is_the_fisheye(load_cameras(calibrated(tmp_path / "fish.yml", f"{key}: {name}\n"))[0])


@pytest.mark.parametrize(
    ("lines", "kind"),
    [
        ("fisheye: true\n", "fisheye"),
        ("is_fisheye: Yes\n", "fisheye"),
        ("distortion:\n  model: equidistant\n", "fisheye"),
        ("lens: fisheye of 180 degrees\n", "fisheye"),
        ("distortion_model: null\n", "brown"),
        ("camera_model: pinhole\ndistortion_model: equidistant\n", "fisheye"),
        ("fisheye: false\n", "brown"),
        ("distortion_model: PLUMB_BOB\n", "brown"),
        ("camera_model: pinhole\n", "brown"),
        ("model: Basler ace\n", "brown"),
    ],
)
def test_other_words_for_a_lens(tmp_path, lines, kind):
    (camera,) = load_cameras(calibrated(tmp_path / "lens.yml", lines))
    assert (camera.lens.kind, camera.lens.coefficients[:4]) == (kind, tuple(FISH))


def test_a_lens_that_is_named_for_all_cameras(tmp_path):
    one = {"K": K.tolist(), "D": FISH.tolist(), "R": R.tolist(), "T": T.ravel().tolist()}
    values = {"distortion_model": "fisheye", "cameras": [one, one | {"name": "b"}]} | SIZE
    (tmp_path / "many.json").write_text(json.dumps(values))
    assert [camera.lens.kind for camera in load_cameras(tmp_path / "many.json")] == ["fisheye", "fisheye"]


@pytest.mark.parametrize("key", ["distortion_model", "camera_model", "model"])
@pytest.mark.parametrize("name", ["mei", "Omni", "ds", "FOV"])
def test_unknown_lenses_are_refused(tmp_path, key, name):
    path = calibrated(tmp_path / "other.yml", f"{key}: {name}\n")
    with pytest.raises(RigError, match=f"{key}: unknown lens '{name}'.* valid names: .*fisheye"):
        load_cameras(path)


@pytest.mark.parametrize("name", ["thin_prism_fisheye", "omni-radtan", "5", "unknown"])
def test_lenses_that_are_partly_known_are_refused(tmp_path, name):
    with pytest.raises(RigError, match=f"distortion_model: unknown lens '{name}'"):
        load_cameras(calibrated(tmp_path / "other.yml", f"distortion_model: {name}\n"))


@pytest.mark.parametrize(
    "coefficients",
    [
        {"distortion_parameters": FISH.tolist()},
        {"DistCoeffs": FISH.tolist()},
        {"distortion": {"coefficients": FISH.tolist()}},
        dict(zip(("k1", "k2", "p1", "p2"), FISH, strict=True)),
        {"distortion": dict(zip(("k1", "k2", "p1", "p2"), FISH, strict=True))},
    ],
)
def test_coefficients_are_never_left_out(tmp_path, coefficients):
    """By whatever key they are there."""
    values = {"CameraMatrix": K.tolist(), "ImageWidth": 640, "ImageHeight": 480, **coefficients}
    (tmp_path / "c.json").write_text(json.dumps(values), "utf-16")
    (camera,) = load_cameras(tmp_path / "c.json")
    assert (camera.size, camera.lens.kind) == ((640, 480), "brown")
    np.testing.assert_allclose(camera.lens.coefficients, [*FISH, 0.0])


@pytest.mark.parametrize("none", ["[]", "", "null"])
def test_no_coefficients(tmp_path, none):
    lines = f"K: {K.ravel().tolist()}\nD: {none}\nwidth: 640\nheight: 480\n"
    (tmp_path / "c.yaml").write_text(lines)
    assert load_cameras(tmp_path / "c.yaml")[0].lens.kind == "pinhole"


@pytest.mark.parametrize(
    ("text", "program"),
    [
        ("cam0:\n  camera_model: omni\n  intrinsics: [1.6, 420, 421, 640, 400]\n", "Kalibr"),
        ("model_type: MEI\nprojection_parameters:\n   gamma1: 1.0\n", "VINS"),
        ('Camera.type: "KannalaBrandt8"\nCamera1.fx: 420.0\n', "ORB-SLAM"),
        ('{"width": 1280, "ppx": 640.0, "model": "kannala_brandt4"}', "RealSense"),
    ],
)
def test_calibrations_of_other_programs_are_named(tmp_path, text, program):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(RigError, match=f"this is a.* {program}.* OpenCV's camera_matrix"):
        load_cameras(tmp_path / "c.yaml")


def test_a_lens_of_two_kinds_is_refused(tmp_path):
    path = calibrated(tmp_path / "both.yml", "camera_model: fisheye\ndistortion_model: radtan\n")
    with pytest.raises(RigError, match="named both as Brown's and as a fisheye"):
        load_cameras(path)


@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("block", [False, True])
def test_camera_info_of_ros(tmp_path, lower, block):
    text = "header:\n  frame_id: head\nheight: 480\nwidth: 640\ndistortion_model: equidistant\n"
    values = {"D": FISH, "K": K.ravel(), "R": np.eye(3).ravel(), "P": np.c_[K, np.zeros(3)].ravel()}
    for name, numbers in values.items():
        listed = "\n" + "\n".join(f"- {n}" for n in numbers) if block else f" {numbers.tolist()}"
        text += f"{name.lower() if lower else name}:{listed}\n"
    message = text + "roi:\n  height: 0\n  width: 0\n  do_rectify: false\n---\n"
    (tmp_path / "info.yaml").write_text(2 * message)
    with pytest.warns(HandSimWarning, match="R beside P is ROS' rectification and no pose"):
        (camera,) = load_cameras(tmp_path / "info.yaml")
    assert camera.size == (640, 480)
    is_the_fisheye(camera)


def test_the_calibration_of_pose2sim(tmp_path):
    turn, shift = cv2.Rodrigues(R)[0].ravel().tolist(), T.ravel().tolist()
    pose = f"rotation = {turn}\ntranslation = {shift}\n"
    inner = f"name = 'a'\nsize = [640.0, 480.0]\nmatrix = {K.tolist()}\n"
    tables = f"[a]\n{inner}{pose}distortions = {D.ravel()[:4].tolist()}\nfisheye = false\n"
    tables += f"[b]\n{inner}{pose}distortions = {FISH.tolist()}\nfisheye = true\n"
    path = tmp_path / "Calib.toml"
    path.write_text(tables + "[metadata]\nadjusted = false\nerror = 0.0\n")
    brown, fish = load_cameras(path)
    assert [brown.name, fish.name, fish.lens.kind] == ["a", "b", "fisheye"]
    np.testing.assert_allclose(brown.project(POINTS), projected(R, T, K, D.ravel()[:4]), atol=1e-6)
    with pytest.raises(RigError, match=r"\[a\] .* Pose2Sim or anipose, .* handsim rig import"):
        load_rig(path)
    nested = tmp_path / "camera_array.toml"
    nested.write_text(path.read_text().replace("[a]", "[cameras.0]").replace("[b]", "[cameras.1]"))
    assert [camera.name for camera in load_cameras(nested)] == ["0", "1"]
    path.write_text(path.read_text().replace(str(shift[0]), "1e5"))
    with pytest.raises(RigError, match="are these millimeters"):
        load_cameras(path)


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
        (
            {"R": np.array([[90.0, 0.0, 45.0]]), "T": T},
            r"R is \[90.0, 0.0, 45.0\], .*3 of a vector \[rad\]",
        ),
        (
            {"camera_matrix": np.array([[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]])},
            "focal length 0.9 .*expected pixels",
        ),
        (
            {"camera_matrix": np.array([[500, 0, 240], [0, 500, 320], [0, 0, 1]])},
            "center 240, 320 for pictures of 640 x 480; .* the width before the height",
        ),
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


def test_a_list_of_cameras(tmp_path):
    one = {
        "name": "left",
        "K": K.tolist(),
        "R": np.eye(3).tolist(),
        "t": T.ravel().tolist(),
        "size": [640, 480],
    }
    (tmp_path / "c.json").write_text(json.dumps([one, {**one, "name": "right"}]))
    left, right = load_cameras(tmp_path / "c.json")
    assert (left.name, right.name, left.size) == ("left", "right", (640, 480))
    np.testing.assert_allclose(left.T_world_camera[:3, 3], -T.ravel())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([{"id": 0, "img_name": "a", "width": 8, "position": [0, 0, 1], "fx": 9.0}], "Gaussian Splatting"),
        ({"camera_angle_x": 0.7, "frames": [{"file_path": "a", "transform_matrix": []}]}, "NeRF"),
    ],
)
def test_cameras_of_unknown_scale_are_named(tmp_path, content, message):
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(RigError, match=f"c.json: this is the JSON of {message}.*; give the COLMAP"):
        load_cameras(tmp_path / "c.json")


@pytest.mark.parametrize(("name", "other"), [("intri", "extri"), ("extri", "intri")])
def test_half_of_a_calibration_asks_for_the_other(tmp_path, name, other):
    values = {"K_1": K, "dist_1": D} if name == "intri" else {"R_1": np.zeros((3, 1)), "T_1": T}
    with pytest.raises(RigError, match=rf"; {other}\.yml, which belongs to it, is not beside it"):
        load_cameras(stored(tmp_path / f"{name}.yml", values))


def dumped(path, values):
    """A file as json, yaml.dump or OpenCV writes it."""
    if path.suffix == ".yml":
        return stored(
            path, {key: np.array(one) if isinstance(one, list) else one for key, one in values.items()}
        )
    if path.suffix == ".yaml":
        path.write_text(pytest.importorskip("yaml").dump(values))
    else:
        path.write_text(json.dumps(values))
    return path


@pytest.mark.parametrize("ending", ["yml", "yaml", "json"])
@pytest.mark.parametrize(
    ("rotation", "translation", "value"),
    [
        ("rotation_matrix", "translation_vector", R),
        ("rotation_vector", "translation_vector", VECTOR),
        ("rotationMatrix", "translationVector", R),
        ("rvec", "tvec", VECTOR),
        ("R", "translation_vector", R),
    ],
)
def test_a_pose_under_any_name_that_says_its_direction(tmp_path, ending, rotation, translation, value):
    path = dumped(tmp_path / f"c.{ending}", LISTED | {rotation: value.tolist(), translation: T.tolist()})
    (camera,) = load_cameras(path)
    np.testing.assert_allclose(camera.project(POINTS), projected(R, T, K, D), atol=1e-6)


@pytest.mark.parametrize("ending", ["yaml", "json"])
@pytest.mark.parametrize(
    ("values", "keys"),
    [
        ({"extrinsic": POSE.tolist()}, "'extrinsic'"),
        ({"extrinsics": {"R": R.tolist(), "t": T.ravel().tolist()}}, "'extrinsics.R', 'extrinsics.t'"),
        ({"extrinsics": {"first": {"R": R.tolist()}}}, "'extrinsics.first'"),
        ({"T_cam_world": POSE.tolist()}, "'T_cam_world'"),
        ({"camera_pose": POSE[:3].tolist()}, "'camera_pose'"),
        ({"RT": POSE[:3].tolist()}, "'RT'"),
        ({"world2cam": POSE.tolist()}, "'world2cam'"),
        ({"anything": POSE.ravel().tolist()}, "'anything'"),
        ({"orientation": [1.0, 0.0, 0.0, 0.0], "position": [0.1, 0.2, 0.3]}, "'orientation', 'position'"),
        ({"position": {"x": 1.0, "y": 2.0, "z": 3.0}}, "'position.x', 'position.y', 'position.z'"),
        ({"quaternion": [1.0, 0.0, 0.0, 0.0], "t": [0.1, 0.2, 0.3]}, "'quaternion'"),
        ({"camera_poses": [POSE.tolist()] * 3}, "'camera_poses'"),
    ],
)
def test_a_pose_under_an_unknown_name_is_refused_by_name(tmp_path, ending, values, keys):
    path = dumped(tmp_path / f"c.{ending}", LISTED | values)
    with pytest.raises(RigError, match=f"unknown keys of a pose: {keys}; valid names: T_world_camera, or R"):
        load_cameras(path)


def test_opencvs_matrices_of_other_things_are_no_poses(tmp_path, recwarn):
    values = {"rectification_matrix": np.eye(3), "projection_matrix": np.eye(3, 4), "Q": np.eye(4), "fps": 30}
    values |= {"newCameraMatrix": K, "avg_reprojection_error": 0.2, "square_size": 0.03, "F": np.eye(3)}
    (camera,) = load_cameras(stored(tmp_path / "c.yml", {"camera_matrix": K, **SIZE, **values}))
    np.testing.assert_array_equal(camera.T_world_camera, np.eye(4))
    assert not recwarn.list


@pytest.mark.parametrize("key", ["rvecs", "tvecs", "extrinsic_parameters"])
def test_poses_of_the_board_are_told(tmp_path, key):
    path = dumped(tmp_path / "c.json", LISTED | {key: np.ones((9, 6)).tolist()})
    with pytest.warns(HandSimWarning, match=f"poses of the board, not of the camera: '{key}'"):
        (camera,) = load_cameras(path)
    np.testing.assert_array_equal(camera.T_world_camera, np.eye(4))


def test_a_second_pose_is_told(tmp_path):
    path = dumped(tmp_path / "c.yaml", LISTED | {"R": R.tolist(), "T": T.tolist(), "pose": POSE.tolist()})
    with pytest.warns(HandSimWarning, match="not read beside the pose: 'pose'"):
        (camera,) = load_cameras(path)
    np.testing.assert_allclose(camera.project(POINTS), projected(R, T, K, D), atol=1e-6)


@pytest.mark.parametrize("ending", ["yaml", "json"])
@pytest.mark.parametrize(
    ("lens", "keys"),
    [
        (
            {"radial_distortion": [-0.2, 0.1], "tangential_distortion": [0.0, 0.01]},
            "'radial_distortion', 'tang",
        ),
        ({"RadialDistortion": [-0.2, 0.1, 0.0]}, "'RadialDistortion'"),
        ({"kc": [-0.2, 0.1, 0.0, 0.0, 0.0]}, "'kc'"),
        ({"fisheye": [0.1, 0.2, 0.3, 0.4]}, "'fisheye'"),
        ({"lens": {"coeffs": [0.1, 0.2, 0.3, 0.4]}}, "'lens.coeffs'"),
    ],
)
def test_a_lens_under_an_unknown_name_is_refused_by_name(tmp_path, ending, lens, keys):
    bare = {key: value for key, value in LISTED.items() if key != "dist_coeffs"}
    with pytest.raises(RigError, match=f"unknown keys of a lens: {keys}.*; valid names: distortion_coeff"):
        load_cameras(dumped(tmp_path / f"c.{ending}", bare | lens))


@pytest.mark.parametrize("size", [{"img_shape": [480, 640]}, {"w": 640, "h": 480}, {"cols": 640}])
def test_a_size_under_an_unknown_name_is_told(tmp_path, size):
    values = {"camera_matrix": K.tolist(), **size}
    with pytest.raises(
        RigError, match=f"no size .* among 'camera_matrix', '{next(iter(size))}'.*image_width"
    ):
        load_cameras(dumped(tmp_path / "c.json", values))


@pytest.mark.parametrize(
    ("content", "keys"),
    [
        ({"nb_camera": 1, "camera_0": ONE | {"camera_pose_matrix": POSE.tolist()}}, "'camera_pose_matrix'"),
        (
            {"cameras": {"a": ONE, "b": ONE}, "camera_poses": {"a": PLACED, "b_to_a": PLACED}},
            "'camera_poses.a', ",
        ),
        ({"cameras": [ONE | {"extrinsic_r": R.tolist(), "extrinsic_t": [0, 0, 1]}]}, "'extrinsic_r', 'extr"),
    ],
)
def test_poses_of_several_cameras_under_unknown_names_are_told(tmp_path, content, keys):
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(RigError, match=f"no R and T; unknown keys of a pose: {keys}"):
        load_cameras(tmp_path / "c.json")
