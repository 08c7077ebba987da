"""The paper's corruption, by its own statistics."""

from __future__ import annotations

import numpy as np
import pytest

from train import Corruption, corrupt


def markers(rng, count=20_000):
    return rng.uniform(-0.06, 0.06, size=(count, 19, 3))


def test_ratios_are_the_papers(rng):
    cloud = corrupt(markers(rng), Corruption(), rng=rng)
    named = (cloud.truth >= 0) & cloud.present
    ghosts = (cloud.truth < 0) & cloud.present
    assert 1 - named.sum() / (20_000 * 19) == pytest.approx(0.1224, abs=0.002)  # Table 4, O ratio
    assert ghosts.sum() / (20_000 * 19) == pytest.approx(0.0527, abs=0.002)  # Table 4, G ratio


def test_points_keep_their_truth_through_the_shuffle(rng):
    clean = markers(rng, 50)
    cloud = corrupt(clean, Corruption(), rng=rng)
    for row in range(50):
        for point, label in zip(cloud.points[row][cloud.present[row]], cloud.truth[row], strict=False):
            if label >= 0:
                np.testing.assert_array_equal(point, clean[row, label])
    orders = {tuple(truth) for truth in corrupt(clean, Corruption(0, 0), rng=rng).truth}
    assert len(orders) == 50


def test_what_was_not_found_is_not_there_and_rig_ghosts_are(rng):
    clean = markers(rng, 10)
    clean[:, 3] = np.nan
    clean[9] = np.nan
    ghosts = np.full((10, 4, 3), np.nan)
    ghosts[:, 1] = 0.5
    cloud = corrupt(clean, Corruption(0, 0), ghosts=ghosts, rng=rng)
    assert not (cloud.truth[cloud.present] == 3).any()
    assert (cloud.points[(cloud.truth < 0) & cloud.present] == 0.5).all()
    assert cloud.present.sum(axis=1).tolist() == [19] * 9 + [1]


def test_ghosts_lie_in_the_grown_box_and_jitter_is_bounded(rng):
    clean = markers(rng, 2000)
    cloud = corrupt(clean, Corruption(0, 2, jitter=0.003), rng=rng)
    ghosts = cloud.points[(cloud.truth < 0) & cloud.present]
    assert np.abs(ghosts).max() < 0.063 + 0.05 * 0.126
    row, place = np.nonzero((cloud.truth >= 0) & cloud.present)
    moved = cloud.points[row, place] - clean[row, cloud.truth[row, place]]
    assert 0.0029 < np.abs(moved).max() <= 0.003
