"""Places on the skin: apart, on the hand, and the same on everybody."""

from __future__ import annotations

import numpy as np
import pytest

from train.any_layout.skin_bank import sample_places, sample_skin_bank


@pytest.fixture(scope="module")
def bank():
    return sample_skin_bank(70, 3, rng=np.random.default_rng(0))


def test_places_are_apart_and_many_bones_have_some(bank):
    apart = bank.mean_distances()
    assert (apart[~np.eye(70, dtype=bool)] > 0.002).all()
    assert len(set(bank.bones.tolist())) > 10
    assert len({place.name for place in bank.places}) == 70


def test_positions_are_those_of_hands(bank):
    assert bank.positions.shape[1:] == (70, 3)
    assert bank.positions.dtype == np.float16
    spans = np.ptp(bank.positions.astype(np.float64), axis=1).max(axis=1)
    assert (spans > 0.05).all() and (spans < 0.30).all()
    np.testing.assert_allclose(bank.positions.astype(np.float64).mean(axis=1), 0.0, atol=1e-3)


def test_mean_distances_are_those_of_the_positions(bank):
    positions = bank.positions.astype(np.float64)
    expected = np.linalg.norm(positions[:, 4] - positions[:, 9], axis=1).mean()
    assert bank.mean_distances(10_000)[4, 9] == pytest.approx(expected, abs=1e-5)


def test_the_palm_has_more_places_than_a_finger(rng):
    bones = [place.bone for place in sample_places(150, rng=rng)]
    assert bones.count("palm") > 2 * bones.count("index_middle")


def test_places_that_do_not_fit_are_left_out() -> None:
    places = sample_places(60, rng=np.random.default_rng(0), apart=0.03)
    assert 5 <= len(places) < 60
