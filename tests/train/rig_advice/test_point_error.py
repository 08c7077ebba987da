"""The error of triangulated points: its covariance against points that the optical system really puts out."""

from __future__ import annotations

import numpy as np
import pytest
from train.rig_advice.point_error import covariances, ellipsoid

from gloves.optics.reconstruction import OpticsConfig, reconstruct
from handsim.space.camera import look_at
from handsim.space.cameras import CameraRig, named_rig


@pytest.mark.parametrize("name", ["six", "figure5"])
def test_the_covariance_is_that_of_reconstructed_points(name):
    rig, frames = named_rig(name), 20_000
    point = np.array([0.15, -0.1, 1.2])
    optics = OpticsConfig(noise=0.5, blob_loss=0.0, dropout=0.0)
    seen = np.ones((frames, 1, len(rig.positions)), dtype=bool)
    sources = np.tile(point, (frames, 1, 1))
    found = reconstruct(sources, seen, rig, optics, continuous=False, rng=np.random.default_rng(0))
    measured = np.cov((found.positions[:, 0] - point).T)
    expected = covariances(point[None], seen[:1, 0], rig, np.array([0.5]))[0]
    assert np.linalg.norm(measured - expected) < 0.05 * np.linalg.norm(expected)


def test_two_cameras_side_by_side_know_depth_least():
    middle = np.array([0.0, 0.0, 1.1])
    poses = np.stack([look_at(np.array([x, -2.0, 1.1]), middle) for x in (-0.25, 0.25)])
    rig = CameraRig("pair", poses, np.deg2rad(60.0))
    spread = covariances(middle[None], np.ones((1, 2), dtype=bool), rig, np.array([0.12]))
    found = ellipsoid(spread)
    assert abs(found.directions[0, 1]) > 0.999
    # By hand: an error of s across either ray moves the point by s / (sqrt(2) sin a) in depth, where a is
    # half the angle between the rays, and by s / sqrt(2) upwards.
    distance = np.hypot(0.25, 2.0)
    across = 0.12 * distance / rig.focal_length
    assert found.axes[0] == pytest.approx(across / np.sqrt(2) / (0.25 / distance), rel=1e-6)
    assert found.axes[1:] == pytest.approx(
        [across / np.sqrt(2) / (2.0 / distance), across / np.sqrt(2)], rel=1e-6
    )
    assert found.mean == pytest.approx(np.linalg.norm(found.axes))


def test_no_points_have_no_error():
    assert np.isnan(ellipsoid(np.empty((0, 3, 3))).mean)
