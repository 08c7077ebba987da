"""The OpenSim model against MuJoCo's hand: by a reading of the XML of its own, and by OpenSim where it is."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gloves import RigidBody, Take, attach, read_capture
from gloves.hand_files import first_forearm, write_hand
from handsim import HandModel, join_qpos, sample_shape
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.model_files import (
    coordinate_names,
    coordinate_values,
    forearm_names,
    hand_osim,
    hand_urdf,
)
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES

FRAMES = 12


PAGE = Path(__file__).parents[3] / "docs" / "motion_files.md"


def test_mujoco_reads_it_and_bones_are_where_ours_are(model, rng):
    opened = mujoco.MjModel.from_xml_string(hand_urdf(model))
    data = mujoco.MjData(opened)
    ranges = model.skeleton.ranges
    found = np.array([opened.joint(name).range for name in JOINT_NAMES])
    np.testing.assert_allclose(found, ranges, atol=1e-9)
    for angles in ranges[:, 0] + rng.random((10, 20)) * np.ptp(ranges, axis=1):
        for name, angle in zip(JOINT_NAMES, angles, strict=True):
            data.joint(name).qpos[:] = angle
        mujoco.mj_kinematics(opened, data)
        ours = model.forward_kinematics(join_qpos(angles[None]))[0]
        for name, pose in zip(BONE_NAMES[1:], ours[1:], strict=True):
            np.testing.assert_allclose(data.body(name).xpos, pose[:3, 3], atol=1e-9)
            np.testing.assert_allclose(data.body(name).xmat.reshape(3, 3), pose[:3, :3], atol=1e-9)


def test_masses_and_inertias_are_those_of_the_model(model):
    root = ET.fromstring(hand_urdf(model))
    masses = {}
    for link in root.iter("link"):
        inertia = link.find("inertial/inertia").attrib
        rows = [["ixx", "ixy", "ixz"], ["ixy", "iyy", "iyz"], ["ixz", "iyz", "izz"]]
        moments = np.linalg.eigvalsh([[float(inertia[key]) for key in row] for row in rows])
        assert moments[0] > 0 and moments[2] < moments[0] + moments[1]  # of a body that there can be
        masses[link.get("name")] = float(link.find("inertial/mass").get("value"))
    assert min(masses.values()) > 0
    assert sum(masses.values()) == pytest.approx(model.mj_model.body_mass.sum())


def test_cylinders_lie_along_the_capsules(model):
    """Both ends of each cylinder are the centers of the spheres that follow it."""
    for link in ET.fromstring(hand_urdf(model)).iter("link"):
        parts = list(link.iter("collision"))
        for cylinder, start, end in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
            origin = cylinder.find("origin")
            center, (_, pitch, yaw) = (np.array(origin.get(key).split(), float) for key in ("xyz", "rpy"))
            length = float(cylinder.find("geometry/cylinder").get("length"))
            axis = np.array([np.cos(yaw) * np.sin(pitch), np.sin(yaw) * np.sin(pitch), np.cos(pitch)])
            for sphere, sign in ((start, -0.5), (end, 0.5)):
                at = np.array(sphere.find("origin").get("xyz").split(), float)
                np.testing.assert_allclose(center + sign * length * axis, at, atol=1e-9)


@pytest.fixture(params=["right", "left"])
def fit(request, rng):
    return attach("dense19", HandModel(sample_shape(side=request.param, rng=rng)))


@pytest.fixture
def model(fit):
    return fit.model


@pytest.fixture
def qpos(fit, rng):
    """A hand on its way from one random pose to another."""
    ranges, share = fit.model.skeleton.ranges, np.linspace(0.0, 1.0, FRAMES)[:, None]
    ends = ranges[:, 0] + (0.1 + 0.8 * rng.random((2, 20))) * np.ptp(ranges, axis=1)
    turns = Rotation.from_euler("XYZ", rng.uniform(-1.0, 1.0, 3) * (1.0 + share))
    places = rng.normal(scale=0.3, size=3) + share * rng.normal(scale=0.1, size=3)
    quaternions = turns.as_quat(scalar_first=True)
    return join_qpos((1.0 - share) * ends[0] + share * ends[1], position=places, quaternion=quaternions)


@pytest.fixture
def take(fit, qpos, rng):
    """The hand and its forearm, which slides by a centimeter against it as skin does."""
    turns = Rotation.from_euler("YZX", np.linspace([0.4, -0.2, 0.1], [-0.6, 0.3, -0.1], FRAMES))
    forearm = Rotation.from_quat(qpos[:, 3:7], scalar_first=True) * turns
    places = qpos[:, :3] + np.linspace([0.01, 0.0, 0.0], [0.0, -0.01, 0.005], FRAMES)
    poses = np.concatenate([places, forearm.as_quat(scalar_first=True)], axis=1)[:, None]
    places = np.array([[-0.06, 0.02, 0.03], [-0.10, -0.025, 0.028], [-0.14, 0.022, 0.033]])
    body = RigidBody("arm", ("A", "B", "C"), places, None, fit.side, has_axes=True)
    return Take.of_poses([fit], qpos[:, None], rate=60.0, bodies=[body], body_poses=poses)


def numbers(element, tag):
    return np.array(element.findtext(tag).split(), dtype=float)


def values_of(fit, qpos):
    """Coordinates by name, lengths in meters and angles in radians."""
    turn = Rotation.from_quat(qpos[3:7], scalar_first=True).as_euler("XYZ")
    return dict(zip(coordinate_names(fit.side), [*qpos[:3], *turn, *qpos[7:]], strict=True))


def bodies_of(root, values):
    """`T_ground_body` of every body, by the definition of OpenSim's custom joint."""
    placed = {"/ground": np.eye(4)}
    for joint in root.iterfind("Model/JointSet/objects/CustomJoint"):
        (frame,) = joint.iterfind("frames/PhysicalOffsetFrame")
        assert joint.findtext("socket_parent_frame") == frame.get("name")
        T_parent_frame, T_frame_child = np.eye(4), np.eye(4)
        T_parent_frame[:3, 3] = numbers(frame, "translation")
        T_parent_frame[:3, :3] = Rotation.from_euler("XYZ", numbers(frame, "orientation")).as_matrix()
        turn, move = np.eye(3), np.zeros(3)
        axes = list(joint.iterfind("SpatialTransform/TransformAxis"))
        kinds = [f"{kind}{number}" for kind in ("rotation", "translation") for number in (1, 2, 3)]
        assert [axis.get("name") for axis in axes] == kinds
        for number, axis in enumerate(axes):
            value = 0.0
            if axis.findtext("coordinates"):
                assert numbers(axis, "LinearFunction/coefficients").tolist() == [1.0, 0.0]
                value = values[axis.findtext("coordinates")]
            along = numbers(axis, "axis")
            if number < 3:
                turn = turn @ Rotation.from_rotvec(value * along).as_matrix()
            else:
                move = move + value * along
        T_frame_child[:3, :3], T_frame_child[:3, 3] = turn, move
        parent = placed[frame.findtext("socket_parent")]
        placed[joint.findtext("socket_child_frame")] = parent @ T_parent_frame @ T_frame_child
    return placed


def markers_of(root, placed):
    markers = {}
    for marker in root.iterfind("Model/MarkerSet/objects/Marker"):
        pose = placed[marker.findtext("socket_parent_frame")]
        markers[marker.get("name")] = pose[:3, :3] @ numbers(marker, "location") + pose[:3, 3]
    return markers


def test_bodies_and_markers_are_where_ours_are(fit, qpos):
    sites = fit.attachment.sites(fit.model)
    root = ET.fromstring(hand_osim(fit.model, sites))
    for pose in qpos:
        placed = bodies_of(root, values_of(fit, pose))
        bones = fit.model.forward_kinematics(pose[None])[0]
        for name, bone in zip(BONE_NAMES, bones, strict=True):
            np.testing.assert_allclose(placed[f"/bodyset/{fit.side}_{name}"], bone, atol=1e-6)
        markers = markers_of(root, placed)
        for site in sites:
            expected = bones[site.bone, :3, :3] @ site.position + bones[site.bone, :3, 3]
            np.testing.assert_allclose(markers[site.name], expected, atol=1e-6)
            np.testing.assert_allclose(markers[f"{fit.side}:{site.name}"], expected, atol=1e-6)
        for name, expected in zip(KEYPOINT_NAMES, hand_keypoints(fit.model, pose[None])[0], strict=True):
            np.testing.assert_allclose(markers[f"{fit.side}_{name}"], expected, atol=1e-6)


def read_mot(path):
    """Columns by name [m, rad]."""
    lines = path.read_text().splitlines()
    names, *rows = (line.split("\t") for line in lines[lines.index("endheader") + 1 :])
    columns = dict(zip(names, np.array(rows, dtype=float).T, strict=True))
    is_length = {name: name.rpartition("_")[2] in {"tx", "ty", "tz", "time"} for name in names}
    return {name: column if is_length[name] else np.deg2rad(column) for name, column in columns.items()}


def test_a_forearm_has_the_wrists_angles_as_coordinates_and_its_own_markers(fit, take, tmp_path):
    take.export(tmp_path / "angles.mot")
    take.export(tmp_path / "joints.trc")
    columns, trc = read_mot(tmp_path / "angles.mot"), read_capture(tmp_path / "joints.trc")
    angles = take.angles(fit.side, convention="isb")
    for name in ("wrist_flexion", "wrist_radial_deviation"):
        np.testing.assert_allclose(columns[f"{fit.side}_{name}"], angles[name], atol=1e-8)
    root = ET.fromstring(hand_osim(fit.model, (), take.qpos[0, 0], forearm=first_forearm(take, fit.side)))
    for name in forearm_names(fit.side):
        (coordinate,) = (one for one in root.iter("Coordinate") if one.get("name") == name)
        assert numbers(coordinate, "default_value")[0] == pytest.approx(columns[name][0], abs=1e-8)
    for frame in (0, FRAMES - 1):
        values = {name: column[frame] for name, column in columns.items() if name != "time"}
        markers = markers_of(root, bodies_of(root, values))
        for name, place in zip(trc.names, trc.positions[frame], strict=True):
            np.testing.assert_allclose(markers[name], place, atol=2e-6)
        np.testing.assert_array_equal(markers["A"], markers["arm:A"])
    body = next(one for one in root.iter("Body") if one.get("name") == f"{fit.side}_forearm")
    moments = numbers(body, "inertia")[:3]
    assert 0.1 < numbers(body, "mass")[0] < 2.0 and 0.0 < moments.max() < moments.sum() - moments.max()


def test_a_forearm_without_axes_is_in_no_model(fit, take, tmp_path):
    plain = dataclasses.replace(take, bodies=[dataclasses.replace(take.bodies[0], has_axes=False)])
    plain.export(tmp_path / "angles.mot")
    assert first_forearm(plain, fit.side) is None
    assert set(read_mot(tmp_path / "angles.mot")) == {"time", *coordinate_names(fit.side)}


def test_coordinates_are_those_of_the_mot(fit, qpos, tmp_path):
    Take.of_poses([fit], qpos[:, None], rate=60.0).export(tmp_path / "angles.mot")
    named = set(read_mot(tmp_path / "angles.mot")) - {"time"}
    root = ET.fromstring(hand_osim(fit.model))
    coordinates = {one.get("name"): one for one in root.iter("Coordinate")}
    assert set(coordinates) == named
    ranges = [numbers(coordinates[name], "range") for name in coordinate_names(fit.side)[6:]]
    np.testing.assert_allclose(ranges, fit.model.skeleton.ranges, atol=1e-9)


def test_the_model_begins_with_the_back_up_or_in_the_pose_of_the_mots_first_row(fit, qpos, tmp_path):
    Take.of_poses([fit], qpos[:, None], rate=60.0).export(tmp_path / "angles.mot")
    lines = (tmp_path / "angles.mot").read_text().splitlines()
    names, row = (line.split("\t")[1:] for line in lines[lines.index("endheader") + 1 :][:2])
    for start in (qpos[0], None):
        root = ET.fromstring(hand_osim(fit.model, (), start))
        found = {one.get("name"): numbers(one, "default_value")[0] for one in root.iter("Coordinate")}
        if start is None:
            assert found.pop(f"{fit.side}_wrist_rx") == pytest.approx(-0.5 * np.pi) and not any(
                found.values()
            )
            continue
        for name, value in zip(names, np.array(row, dtype=float), strict=True):
            shown = np.rad2deg(found[name]) if "_wrist_t" not in name else found[name]
            assert shown == pytest.approx(value, abs=1e-6)
    assert root.findtext("Model/gravity") == "0 -9.80665 0"


def test_masses_are_those_of_the_model(fit):
    compiled = fit.model.mj_model
    for number, body in enumerate(ET.fromstring(hand_osim(fit.model)).iter("Body"), 1):
        xx, yy, zz, xy, xz, yz = numbers(body, "inertia")
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert float(body.findtext("mass")) == pytest.approx(compiled.body_mass[number])
        np.testing.assert_allclose(numbers(body, "mass_center"), compiled.body_ipos[number], atol=1e-9)
        np.testing.assert_allclose(moments, np.sort(compiled.body_inertia[number]), rtol=1e-6)


def test_cylinders_lie_along_the_capsules_osim(fit):
    """The spheres stand at the ends of the capsule; the cylinder, along its y, reaches them."""
    capsules, count = fit.model.capsules, 0
    for bone, body in enumerate(ET.fromstring(hand_osim(fit.model)).iter("Body")):
        frames = list(body.iterfind("components/PhysicalOffsetFrame"))
        ours = np.flatnonzero(capsules.bones == bone)
        for index, middle, start, end in zip(ours, frames[::3], frames[1::3], frames[2::3], strict=True):
            np.testing.assert_allclose(numbers(start, "translation"), capsules.starts[index], atol=1e-9)
            np.testing.assert_allclose(numbers(end, "translation"), capsules.ends[index], atol=1e-9)
            half = numbers(middle, "attached_geometry/Cylinder/half_height")[0]
            turn = Rotation.from_euler("XYZ", numbers(middle, "orientation"))
            reached = numbers(middle, "translation") + half * turn.apply([0.0, 1.0, 0.0])
            np.testing.assert_allclose(reached, capsules.ends[index], atol=1e-9)
            count += 1
    assert count == len(capsules.bones)


def test_inverse_kinematics_by_the_osim_alone_finds_our_angles(fit, qpos, tmp_path):
    """The joints of our .trc, fitted with axes, order and frames as the .osim states them, by scipy alone."""
    Take.of_poses([fit], qpos[:, None], rate=60.0).export(tmp_path / "joints.trc")
    trc, names = read_capture(tmp_path / "joints.trc"), coordinate_names(fit.side)
    root = ET.fromstring(hand_osim(fit.model))
    for frame in (0, FRAMES - 1):
        expected = np.array([*coordinate_values(qpos[frame : frame + 1], "z")[0]])

        def residuals(values, wanted=trc.positions[frame]):
            markers = markers_of(root, bodies_of(root, dict(zip(names, values, strict=True))))
            return np.ravel([markers[name] for name in trc.names] - wanted)

        start = expected + np.deg2rad(10.0) * np.sin(np.arange(len(names)))
        found = least_squares(residuals, start, x_scale="jac").x
        np.testing.assert_allclose(np.rad2deg(found - expected)[3:], 0.0, atol=0.5)


def test_opensim_has_bodies_and_markers_where_mujoco_has_them(fit, qpos, tmp_path):
    opensim = pytest.importorskip("opensim")
    write_hand(tmp_path / "hand.osim", fit)
    write_hand(tmp_path / "hand.xml", fit)
    model, ours = (
        opensim.Model(str(tmp_path / "hand.osim")),
        mujoco.MjModel.from_xml_path(str(tmp_path / "hand.xml")),
    )
    state, data = model.initSystem(), mujoco.MjData(ours)
    for pose in qpos:
        for name, value in values_of(fit, pose).items():
            model.getCoordinateSet().get(name).setValue(state, value, False)
        model.realizePosition(state)
        data.qpos[:] = pose
        mujoco.mj_kinematics(ours, data)
        for name in BONE_NAMES:
            at = model.getBodySet().get(f"{fit.side}_{name}").getPositionInGround(state)
            np.testing.assert_allclose([at[axis] for axis in range(3)], data.body(name).xpos, atol=1e-5)
        for name in fit.layout.names:
            at = model.getMarkerSet().get(name).getLocationInGround(state)
            np.testing.assert_allclose([at[axis] for axis in range(3)], data.site(name).xpos, atol=1e-5)


def test_inverse_kinematics_of_opensim_on_our_trc_finds_our_angles(fit, qpos, take, tmp_path, monkeypatch):
    """The program of docs/motion_files.md, as it stands there."""
    opensim = pytest.importorskip("opensim")
    monkeypatch.chdir(tmp_path)
    qpos = qpos.copy()
    qpos[3:5] = np.nan  # the hand is lost for a while, in which files hold its pose
    take = Take.of_poses([fit], qpos[:, None], rate=60.0, bodies=take.bodies, body_poses=take.body_poses)
    take.export("joints.trc")
    take.export("angles.mot")
    write_hand(tmp_path / "hand.osim", fit, start=qpos[0], forearm=first_forearm(take, fit.side))
    assert opensim.Storage("angles.mot").getSize() == FRAMES
    exec(PAGE.read_text("utf-8").split("```py\n")[1].split("```")[0], {})
    found, exported = (opensim.TimeSeriesTable(f"{name}.mot") for name in ("found", "angles"))
    for name in (*coordinate_names(fit.side), *forearm_names(fit.side)):
        pair = [np.array(table.getDependentColumn(name).to_numpy()) for table in (found, exported)]
        assert len(pair[0]) == FRAMES
        is_length = name.rpartition("_")[2] in {"tx", "ty", "tz"}
        np.testing.assert_allclose(*pair, atol=1e-4 if is_length else 0.05)  # [m], [deg]
