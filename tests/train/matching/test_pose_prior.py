"""The density of labeled points against scipy's, wherever the hand is and whatever is missing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from handsim.errors import WeightsError
from train.matching.pose_prior import PosePrior

MARKERS, RANK = 7, 5


def prior(rng, components):
    return PosePrior(
        rng.normal(scale=0.05, size=(components, MARKERS, 3)).astype(np.float32),
        rng.normal(scale=0.003, size=(components, MARKERS, 3, RANK)).astype(np.float32),
        rng.uniform(0.001, 0.002, size=components).astype(np.float32),
        np.log(rng.dirichlet(np.ones(components))).astype(np.float32),
    )


def expected(prior, points, labels):
    """Logarithm of the mixture, by scipy's rotation and normal density."""
    terms = []
    for mean, directions, spread, weight in zip(
        prior.means, prior.directions, prior.spreads, prior.log_weights, strict=True
    ):
        there = mean[labels].astype(float)
        off, target = points - points.mean(axis=0), there - there.mean(axis=0)
        aligned = Rotation.align_vectors(target, off)[0].apply(off)
        rows = directions[labels].reshape(-1, RANK).astype(float)
        covariance = rows @ rows.T + float(spread) ** 2 * np.eye(len(rows))
        terms.append(weight + multivariate_normal.logpdf((aligned - target).ravel(), cov=covariance))
    return np.logaddexp.reduce(terms)


@given(
    seed=st.integers(0, 10_000),
    components=st.integers(1, 3),
    count=st.integers(4, MARKERS),
    left=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_density_is_that_of_the_mixture_wherever_the_hand_is(seed, components, count, left):
    rng = np.random.default_rng(seed)
    known = prior(rng, components)
    labels = rng.permutation(MARKERS)[:count]
    points = known.means[rng.integers(components)][labels] + rng.normal(scale=0.004, size=(count, 3))
    moved = Rotation.random(rng=rng).apply(points) + rng.normal(size=3)
    if left:
        moved = moved * [1.0, -1.0, 1.0]
    found = known.log_density(moved, labels, mirrored=left)
    assert found == pytest.approx(expected(known, points, labels), rel=1e-4, abs=1e-3)


def test_the_nearest_components_are_those_that_scipy_aligns_best(rng):
    many, labels = prior(rng, 30), np.arange(MARKERS)
    for left in (False, True):
        points = rng.normal(scale=0.05, size=(MARKERS, 3))
        seen = points * ([-1.0, 1.0, 1.0] if left else 1.0)
        off = seen - seen.mean(axis=0)
        misses = [
            Rotation.align_vectors(mean - mean.mean(axis=0), off)[1] for mean in many.means.astype(float)
        ]
        near = many.nearest(points, labels, mirrored=left, count=9)
        np.testing.assert_array_equal(near, np.argsort(misses)[:9])
        among = many.log_density(points, labels, mirrored=left, among=near)
        assert among == many.log_density(points, labels, mirrored=left)  # four of them count


def test_three_points_fit_any_hand(rng):
    assert prior(rng, 2).log_density(np.zeros((3, 3)), np.arange(3), mirrored=False) == -np.inf


def test_tables_survive_a_file(rng):
    known = prior(rng, 2)
    again = PosePrior.of_tensors(known.tensors())
    np.testing.assert_array_equal(again.means, known.means)
    np.testing.assert_allclose(again.directions, known.directions, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(
    "damage",
    [
        {"means": np.zeros((2, MARKERS, 2), np.float32)},
        {"means": np.full((2, MARKERS, 3), np.nan, np.float32)},
        {"spreads": np.zeros(2, np.float32)},
        {"directions": np.zeros((2, MARKERS, 3, 0), np.float32)},
        {"log_weights": np.zeros(3, np.float32)},
    ],
)
def test_damaged_tables_are_refused(damage, rng):
    with pytest.raises(WeightsError, match="pose prior is damaged"):
        dataclasses.replace(prior(rng, 2), **damage)


def test_missing_tables_are_refused(rng):
    tables = prior(rng, 2).tensors()
    del tables["means"]
    with pytest.raises(WeightsError, match="has the tables directions, log_weights, spreads"):
        PosePrior.of_tensors(tables)
