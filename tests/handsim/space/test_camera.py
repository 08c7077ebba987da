from __future__ import annotations

import warnings
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import Camera, Lens
from handsim.errors import ArgumentError

# A webcam, a wide lens with strong barrel distortion, a pincushion, and the fisheye of two headsets.
BROWN = (
    (0.09, -0.268, 0.0004, -0.0007, 0.095),
    (-0.30, 0.11, -0.001, 0.0015, -0.02),
    (0.25, 0.1, 0.0, 0.0, 0.0),
)
FISHEYE = ((0.02, -0.006, 0.0, 0.0), (-0.013, 0.021, -0.02, 0.005))


small = st.floats(-0.3, 0.3)
tiny = st.floats(-0.01, 0.01)


def directions(lens: Lens, count: int, *, most: float) -> np.ndarray:
    """Rays at most so far from the axis [rad], and before the lens's fold."""
    rng = np.random.default_rng(0)
    limit = np.arctan(lens._fold_radius()) if lens.kind == "brown" else lens._fold_radius()
    theta = rng.uniform(0.0, min(most, 0.97 * limit), count)
    phi = rng.uniform(-np.pi, np.pi, count)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


@pytest.mark.parametrize("coefficients", BROWN)
def test_brown_is_opencvs(coefficients):
    lens = Lens("brown", coefficients)
    rays = directions(lens, 500, most=0.6)
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    np.testing.assert_allclose(lens.distort(rays), theirs[:, 0], atol=1e-12)
    exact = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    back = cv2.undistortPoints(lens.distort(rays)[:, None], np.eye(3), np.array(coefficients), criteria=exact)
    ours = lens.undistort(lens.distort(rays))
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], back[:, 0], atol=1e-8)
    np.testing.assert_allclose(ours, rays, atol=1e-9)


@pytest.mark.parametrize("coefficients", FISHEYE)
def test_fisheye_is_opencvs(coefficients):
    lens = Lens("fisheye", coefficients)
    rays = directions(lens, 500, most=1.4)
    theirs, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients)
    )
    np.testing.assert_allclose(lens.distort(rays), theirs[:, 0], atol=1e-9)
    ours = lens.undistort(lens.distort(rays))
    np.testing.assert_allclose(ours, rays, atol=1e-9)
    back = cv2.fisheye.undistortPoints(lens.distort(rays)[:, None], np.eye(3), np.array(coefficients))[:, 0]
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], back, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.tuples(small, small, tiny, tiny, small), st.floats(0.0, 0.9), st.floats(-np.pi, np.pi))
def test_brown_round_trip(coefficients, share, phi):
    lens = Lens("brown", coefficients)
    slope = share * min(lens._fold_radius(), 2.0)
    rays = np.array([[slope * np.cos(phi), slope * np.sin(phi), 1.0]])
    places = lens.distort(rays)
    back = lens.undistort(places)
    if np.isfinite(back).all():  # near a fold the tangential terms may leave no ray
        np.testing.assert_allclose(lens.distort(back), places, atol=1e-9)
    if share < 0.7:
        np.testing.assert_allclose(back, rays / np.linalg.norm(rays), atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.tuples(small, tiny, tiny, tiny), st.floats(0.0, 0.99), st.floats(-np.pi, np.pi))
def test_fisheye_round_trip(coefficients, share, phi):
    lens = Lens("fisheye", coefficients)
    theta = share * lens._fold_radius()
    ray = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    np.testing.assert_allclose(lens.undistort(lens.distort(ray)), ray, atol=1e-7)


def test_a_fisheye_sees_behind_itself():
    lens = Lens("fisheye", (0.0, 0.0, 0.0, 0.0))
    ray = np.array([np.sin(2.5), 0.0, np.cos(2.5)])
    np.testing.assert_allclose(lens.distort(ray), [2.5, 0.0])
    np.testing.assert_allclose(lens.undistort(np.array([2.5, 0.0])), ray)


def test_nothing_is_seen_beyond_a_fold():
    lens = Lens("brown", (-0.3, 0.0, 0.0, 0.0, 0.0))  # r (1 - 0.3 r^2) turns at r = 1.054
    assert lens._fold_radius() == pytest.approx(np.sqrt(1.0 / 0.9))
    assert np.isnan(lens.distort(np.array([1.1, 0.0, 1.0]))).all()
    assert np.isfinite(lens.distort(np.array([1.05, 0.0, 1.0]))).all()
    assert np.isnan(lens.undistort(np.array([0.71, 0.0]))).all()  # the fold itself is at 0.703
    assert np.isfinite(lens.undistort(np.array([0.70, 0.0]))).all()
    along = lens.undistort(np.stack([np.linspace(0, 0.7, 50), np.zeros(50)], axis=-1))
    assert all(a < b for a, b in pairwise(along[:, 0] / along[:, 2]))


@pytest.mark.parametrize("tangential", [0.0, 0.004])
def test_the_inverse_is_quiet_far_outside_the_picture(tangential):
    lens = Lens("brown", (-0.4, 0.2, tangential, -tangential, -0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rays = lens.undistort(np.array([[0.1, 0.2], [50.0, -80.0], [1e6, 0.0], [0.0, 0.0]]))
    assert np.isfinite(rays[[0, 3]]).all() and np.isnan(rays[1:3]).all()
    np.testing.assert_allclose(rays[3], [0.0, 0.0, 1.0], atol=1e-12)


def test_rays_of_a_whole_picture_come_back_as_its_pixels():
    K = np.array([[500.0, 0.0, 322.0], [0.0, 505.0, 236.0], [0.0, 0.0, 1.0]])
    for lens in (Lens(), Lens("brown", BROWN[1]), Lens("fisheye", FISHEYE[1])):
        camera = Camera("test", (640, 480), K, lens=lens)
        pixels = camera.project(camera.rays())
        columns, rows = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
        np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-6)


def test_mistakes_are_told():
    with pytest.raises(ArgumentError, match="did you mean 'fisheye'"):
        Lens("fishey")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="expected 5 finite numbers"):
        Lens("brown", (0.1, 0.2))
