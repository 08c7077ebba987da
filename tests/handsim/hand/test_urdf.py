from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.model_files import hand_urdf
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES, sample_shape


@pytest.fixture(params=["right", "left"])
def model(request, rng):
    return HandModel(sample_shape(side=request.param, rng=rng))


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
