"""The pose prior: what it says of hands and how it is learned; left and right hands."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from gloves import load_layout
from gloves.fit import attach_markers
from gloves.layout import list_layouts
from handsim import HandModel, join_qpos
from handsim.errors import WeightsError
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses.shapes import sample_valid_angles
from train.labelers.pose_prior import (
    NEAREST,
    PosePrior,
    SideClassifier,
    align_all,
    is_mirror_like,
    learn_pose_prior,
    log_density,
    procrustes_errors,
    seen_as_right,
    tables_of,
)

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


def density(known, points, labels, *, mirrored):
    """Log-density of labeled points, of a left hand if mirrored."""
    cloud, tables = seen_as_right(points, mirrored), tables_of(known)
    nearest = np.argsort(procrustes_errors(cloud, labels, tables.by_marker))[:NEAREST]
    return log_density(cloud, labels, nearest, tables)


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
    found = density(known, moved, labels, mirrored=left)
    assert found == pytest.approx(expected(known, points, labels), rel=1e-4, abs=1e-3)


def test_the_nearest_components_are_those_that_scipy_aligns_best(rng):
    many, labels = prior(rng, 30), np.arange(MARKERS)
    for left in (False, True):
        points = rng.normal(scale=0.05, size=(MARKERS, 3))
        off = seen_as_right(points, left)
        misses = [
            Rotation.align_vectors(mean - mean.mean(axis=0), off)[1] for mean in many.means.astype(float)
        ]
        errors = procrustes_errors(off, labels, tables_of(many).by_marker)
        np.testing.assert_array_equal(np.argsort(errors)[:9], np.argsort(misses)[:9])


def test_tables_survive_a_file(rng):
    known = prior(rng, 2)
    again = PosePrior.of_tensors(known.tensors(), known.num_markers)
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
        PosePrior.of_tensors(tables, 3)


def bent(rng, count):
    """Points of a chain that bends in one place by up to a right angle, anywhere [m]."""
    rest = np.array([[0, 0, 0], [2, 1, 0], [4, 0, 1], [6, 0, 0], [8, 1, 0], [10, 0, 0]]) / 100.0
    angles = rng.uniform(0.0, np.pi / 2, size=count)
    hands = np.tile(rest, (count, 1, 1))
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0])
    for marker in (3, 4, 5):
        hands[:, marker] = rest[2] + turns.apply(rest[marker] - rest[2])
    hands += rng.normal(scale=0.0005, size=hands.shape)
    anywhere = Rotation.random(count, rng=rng)
    return np.stack([anywhere.apply(hands[:, m]) for m in range(6)], axis=1) + rng.normal(size=(count, 1, 3))


def test_hands_are_likelier_than_what_is_none(rng):
    prior = learn_pose_prior(bent(rng, 6000), rng=rng)
    assert prior is not None and prior.num_markers == 6
    labels = np.arange(6)
    others = bent(rng, 200)
    exchanged = others[:, [0, 1, 2, 4, 3, 5]]
    right = [density(prior, hand, labels, mirrored=False) for hand in others]
    wrong = [density(prior, hand, labels, mirrored=False) for hand in exchanged]
    mirrored = [density(prior, hand, labels, mirrored=True) for hand in others]
    assert np.mean(np.array(right) > np.array(wrong) + 5.0) == 1.0
    assert np.mean(np.array(right) > np.array(mirrored)) > 0.95
    assert np.exp(prior.log_weights).sum() == np.float32(1.0)


def test_few_frames_or_markers_give_no_prior(rng):
    assert learn_pose_prior(bent(rng, 1000), rng=rng) is None
    assert learn_pose_prior(bent(rng, 6000)[:, :2], rng=rng) is None


def test_frames_with_missing_markers_are_left_out(rng):
    hands = bent(rng, 5500)
    gaps = np.concatenate([hands, np.full((10, 6, 3), np.nan)])
    whole, with_gaps = (learn_pose_prior(each, rng=np.random.default_rng(0)) for each in (hands, gaps))
    np.testing.assert_array_equal(whole.means, with_gaps.means)


@given(seed=st.integers(0, 10_000), flat=st.booleans())
@settings(max_examples=40, deadline=None)
def test_alignment_is_scipys(seed, flat):
    rng = np.random.default_rng(seed)
    hands, target = rng.normal(size=(4, 5, 3)), rng.normal(size=(5, 3))
    if flat:
        hands[..., 2] = 0.0
    aligned = align_all(hands, target)
    for hand, found in zip(hands, aligned, strict=True):
        centered, there = hand - hand.mean(axis=0), target - target.mean(axis=0)
        turned = Rotation.align_vectors(there, centered)[0].apply(centered) + target.mean(axis=0)
        np.testing.assert_allclose(
            np.linalg.norm(found - target), np.linalg.norm(turned - target), rtol=1e-6, atol=1e-9
        )
        np.testing.assert_allclose(
            np.linalg.norm(found[0] - found[1]), np.linalg.norm(hand[0] - hand[1]), rtol=1e-6
        )


@pytest.fixture(scope="module", params=["dense19", "sparse13"])
def classifier(request):
    layout = load_layout(request.param)
    return layout, SideClassifier(layout, rng=np.random.default_rng(0))


def hands(layout, side, rng, count=60):
    hand = HandModel.named("M", side=side)
    qpos = join_qpos(sample_valid_angles(hand, count, rng=rng), quaternion=random_quaternions(count, rng=rng))
    return attach_markers(layout, hand).markers(hand, hand.forward_kinematics(qpos))[0]


@pytest.mark.parametrize("side", ["left", "right"])
def test_unknown_poses_are_told_also_with_markers_missing(classifier, side, rng):
    layout, tells = classifier
    right = whole = 0
    for points in hands(layout, side, rng):
        whole += tells.classify(points, np.arange(len(points)))[0] == side
        here = rng.permutation(len(points))[3:]
        right += tells.classify(points[here], here)[0] == side
    assert whole >= 58
    assert right >= 55


def test_a_mirror_turns_the_answer_and_nothing_else_matters(classifier, rng):
    layout, tells = classifier
    (points,) = hands(layout, "right", rng, count=1)
    side, clear = tells.classify(points, np.arange(len(points)))
    moved = points @ quaternion_matrix(random_quaternions(1, rng=rng))[0].T + [1.0, -2.0, 0.5]
    order = rng.permutation(len(points))
    assert tells.classify(moved[order], order) == (side, pytest.approx(clear))
    mirrored, as_clear = tells.classify(points * (1.0, 1.0, -1.0), np.arange(len(points)))
    assert {side, mirrored} == {"left", "right"}
    assert as_clear == pytest.approx(clear)


def test_too_few_points_say_nothing(classifier, rng):
    _, tells = classifier
    points = rng.normal(size=(5, 3))
    for labels in ([0, 1, 2, -1, -1], [-1] * 5):
        assert tells.classify(points, np.array(labels)) == ("right", 0.0)
    assert tells.classify(np.zeros((0, 3)), np.zeros(0, dtype=int)) == ("right", 0.0)


@pytest.mark.parametrize("name", list_layouts())
def test_no_shipped_layout_is_like_its_mirror_image(name):
    assert not is_mirror_like(load_layout(name))
