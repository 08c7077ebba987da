"""Wrist paths: inside their cube, smooth, unit quaternions, decided by the seed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim.space.transforms import quaternion_matrix
from poses.motion import WristConfig, wrist_path

RATE = 120.0


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 700),
    st.floats(0.0, 0.5),
    st.sampled_from([0.0, 0.5]),
)
def test_a_wrist_stays_in_its_cube_and_moves_smoothly(seed, frames, volume, turning):
    config = WristConfig(center=(0.2, -0.1, 1.0), volume=volume, turning=turning)
    position, quaternion = wrist_path(frames, RATE, config, rng=np.random.default_rng(seed))
    assert position.shape == (frames, 3) and quaternion.shape == (frames, 4)
    assert (np.abs(position - config.center) <= volume + 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-12)
    # Minimum-jerk ways: 1.875 times the mean speed of the longest way in the shortest time.
    fastest = 1.875 * 2.0 * volume / (config.times[0] - 1.0 / RATE)
    assert (np.abs(np.diff(position, axis=0)) * RATE <= fastest + 1e-9).all()
    if frames > 2:
        steps = np.abs(np.diff(position, n=2, axis=0)) * RATE**2
        assert (steps <= 5.8 * 2.0 * volume / (config.times[0] - 1.0 / RATE) ** 2 + 1e-6).all()
    dots = np.abs(np.einsum("ti,ti->t", quaternion[1:], quaternion[:-1]))
    turns = 2.0 * np.arccos(np.clip(dots, 0.0, 1.0)) * RATE
    assert (turns <= 1.875 * np.pi / (config.times[0] - 1.0 / RATE) + 1e-3).all()


def test_the_seed_decides_the_path():
    first, again, other = (
        np.concatenate(wrist_path(300, RATE, WristConfig(), rng=np.random.default_rng(seed)), axis=1)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_it_gets_around(rng):
    position, _ = wrist_path(12_000, RATE, WristConfig(), rng=rng)
    assert np.ptp(position, axis=0).min() > 0.45, "most of a cube of 0.6 m"


@pytest.mark.parametrize("turning", [0.0, 0.3])
def test_turning_spreads_around_fingers_ahead_and_palm_down(turning, rng):
    _, quaternion = wrist_path(24_000, RATE, WristConfig(turning=turning), rng=rng)
    axes = quaternion_matrix(quaternion)
    fingers, back = axes[:, :, 0].mean(axis=0), axes[:, :, 2].mean(axis=0)
    np.testing.assert_allclose(fingers / np.linalg.norm(fingers), [0.0, 1.0, 0.0], atol=0.15)
    np.testing.assert_allclose(back / np.linalg.norm(back), [0.0, 0.0, 1.0], atol=0.15)
    assert (axes.std(axis=0).max() < 1e-9) == (turning == 0.0)
