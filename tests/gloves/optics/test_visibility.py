"""Rays against MuJoCo's, and what more cameras or an empty room must do."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from gloves.fit import attach_markers
from gloves.layout import load_layout
from gloves.optics.visibility import (
    MAX_FACING,
    facing_cameras,
    free_rays,
    pack_cameras,
    visible_cameras,
)
from handsim.errors import ArgumentError, RigError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import sample_shape
from handsim.space.rig import CameraRig, named_rig
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles
from tests.rigs import mixed_rig


@pytest.fixture(params=["right", "left"])
def scene(request, rng):
    model = HandModel(sample_shape(side=request.param, rng=rng))
    qpos = join_qpos(
        sample_valid_angles(model, 60, rng=rng),
        position=np.array([0.0, 0.0, 1.1]) + rng.uniform(-0.3, 0.3, (60, 3)),
        quaternion=random_quaternions(60, rng=rng),
    )
    bones = model.forward_kinematics(qpos)
    markers, normals = attach_markers(load_layout("dense19"), model).markers(model, bones)
    return model, qpos, markers, normals, model.capsules.posed(bones)


def test_every_ray_agrees_with_mujoco(scene):
    model, qpos, markers, _, segments = scene
    cameras = named_rig("figure5").positions
    free = free_rays(markers, cameras, segments, model.capsules.radii)
    assert 0.2 < free.mean() < 0.95, "the test needs rays of both kinds"
    data = mujoco.MjData(model.mj_model)
    hits, distances = np.zeros(16, dtype=np.int32), np.zeros(16)
    for frame, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model.mj_model, data)
        for marker, place in enumerate(markers[frame]):
            rays = cameras - place
            lengths = np.linalg.norm(rays, axis=1)
            unit = (rays / lengths[:, None]).ravel()
            mujoco.mj_multiRay(
                model.mj_model, data, place, unit, None, 1, -1, hits, distances, None, 16, 10.0
            )
            blocked = (distances >= 0) & (distances < lengths)
            np.testing.assert_array_equal(free[frame, marker], ~blocked)


def test_a_camera_sees_alike_whatever_others_there_are(scene):
    model, _, markers, normals, segments = scene
    rig = named_rig("figure5")
    few = CameraRig("few", [rig.cameras[number] for number in (3, 7, 11)])
    everyone = visible_cameras(markers, normals, rig, segments, model.capsules.radii)
    np.testing.assert_array_equal(
        visible_cameras(markers, normals, few, segments, model.capsules.radii), everyone[..., [3, 7, 11]]
    )


def test_markers_that_face_away_or_lie_outside_the_view_are_not_seen(scene):
    model, _, markers, normals, segments = scene
    rig = named_rig("figure5")
    far = np.zeros((len(segments), 0, 2, 3))
    seen = visible_cameras(markers, normals, rig, far, np.zeros(0))
    behind = visible_cameras(markers, -normals, rig, far, np.zeros(0))
    assert not (seen & behind).all(axis=-1).any()
    assert visible_cameras(markers + [0.0, 0.0, 50.0], normals, rig, far, np.zeros(0)).sum() == 0
    assert not visible_cameras(markers, normals, rig, segments, model.capsules.radii)[~seen].any()


def test_facing_cameras_are_those_with_the_marker_in_their_picture_and_on_its_outward_side(scene):
    _, _, markers, normals, _ = scene
    rig = mixed_rig()
    to_camera = rig.positions - markers[..., None, :]
    cosines = np.einsum("tmci,tmi->tmc", to_camera, normals) / np.linalg.norm(to_camera, axis=-1)
    expected = rig.in_view(markers) & (cosines > np.cos(MAX_FACING))
    np.testing.assert_array_equal(facing_cameras(markers, normals, rig), expected)
    assert expected.any(axis=(0, 1)).all()


def test_packing_round_trip(rng):
    seen = rng.random((5, 7, 16)) < 0.5
    bits = (pack_cameras(seen)[..., None] >> np.arange(16)) & 1
    np.testing.assert_array_equal(bits, seen)


def test_bad_rigs_are_told():
    with pytest.raises(RigError, match="rig 'lonely' has 1 cameras, expected 2 to 32"):
        CameraRig("lonely", named_rig("six").cameras[:1])
    with pytest.raises(ArgumentError, match="unknown camera rig 'figure6'"):
        named_rig("figure6")
