"""From scores to labels, alone and verified by a pose."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from gloves import attach, load_layout
from handsim import HandModel, sample_shape
from poses import sample_poses
from train import load_labeler
from train.labelers.matching import GHOST, SINKHORN, assign, assignment_costs, balance, match_scores

LAYOUT = load_layout("dense19")
TIP, PIP = LAYOUT.names.index("RingTip"), LAYOUT.names.index("PinkyTip")


def log_softmax(raw):
    return raw - np.log(np.exp(raw).sum(axis=1, keepdims=True))


def scores(seed, count, num_labels, sharp=2.0):
    rng = np.random.default_rng(seed)
    by_point = log_softmax(sharp * rng.normal(size=(count, num_labels + 1)))
    return by_point, log_softmax(sharp * rng.normal(size=(num_labels, count + 1)))


def pair_probabilities(by_point, by_label):
    return balance(by_point, by_label, SINKHORN["score_weight"], SINKHORN["sinkhorn_rounds"])


def product(labels, probabilities):
    """Of a labeling: pairs count for the point and for the label."""
    value = 1.0
    for point, label in enumerate(labels):
        value *= probabilities[point, label] ** (1 if label == GHOST else 2)
    for label in set(range(probabilities.shape[1] - 1)) - set(labels):
        value *= probabilities[-1, label]
    return value


def one_to_one(count, num_labels):
    for choice in itertools.product(range(-1, num_labels), repeat=count):
        named = [label for label in choice if label != GHOST]
        if len(set(named)) == len(named):
            yield choice


@given(seed=st.integers(0, 10_000), count=st.integers(0, 4), num_labels=st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_no_labeling_is_likelier(seed, count, num_labels):
    probabilities = pair_probabilities(*scores(seed, count, num_labels))
    _, labels = assign(*assignment_costs(probabilities))
    best = max(product(choice, probabilities) for choice in one_to_one(count, num_labels))
    assert np.isclose(product(labels.tolist(), probabilities), best)
    named = labels[labels != GHOST]
    assert len(set(named.tolist())) == len(named)


@given(seed=st.integers(0, 10_000), count=st.integers(0, 30), num_labels=st.integers(1, 25))
@settings(max_examples=60, deadline=None)
def test_every_point_and_every_label_is_spent_once(seed, count, num_labels):
    by_point, by_label = scores(seed, count, num_labels)
    probabilities = pair_probabilities(by_point, by_label)
    assert (probabilities >= 0).all()
    np.testing.assert_allclose(probabilities[:-1].sum(axis=1), 1.0)
    np.testing.assert_allclose(probabilities[:, :-1].sum(axis=0), 1.0, atol=0.2)  # nearly, after 20 rounds
    labels, confidence = match_scores(np.zeros((len(by_point), 3)), by_point, by_label, None)
    assert ((confidence >= 0) & (confidence <= 1)).all()
    assert labels.shape == confidence.shape == (count,)


def test_order_of_points_and_labels_does_not_matter(rng):
    by_point, by_label = scores(0, 9, 7)
    points, labels = rng.permutation(9), rng.permutation(7)
    turned = pair_probabilities(
        by_point[np.ix_(points, [*labels, 7])], by_label[np.ix_(labels, [*points, 9])]
    )
    straight = pair_probabilities(by_point, by_label)
    np.testing.assert_allclose(turned, straight[np.ix_([*points, 9], [*labels, 7])])


def test_transposed_scores_compile_no_kernel_of_their_own(rng):
    by_point, by_label = rng.normal(size=(5, 8)), rng.normal(size=(7, 6))
    expected = match_scores(np.zeros((5, 3)), by_point, by_label, None)
    compiled = len(balance.overloads)
    found = match_scores(np.zeros((5, 3)), by_point, np.asfortranarray(by_label), None)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
    assert len(balance.overloads) == compiled


def test_two_points_that_both_look_like_one_marker_share_it():
    """Alone each would be sure; together one of the two must be a ghost, and neither is sure any more."""
    by_point = np.log([[0.98, 0.02], [0.98, 0.02]])
    by_label = np.log([[0.49, 0.49, 0.02]])
    labels, confidence = match_scores(np.zeros((len(by_point), 3)), by_point, by_label, None)
    assert sorted(labels.tolist()) == [GHOST, 0]
    assert (confidence < 0.6).all()


def test_scores_that_rule_something_out_altogether():
    by_point, by_label = np.array([[0.0, -1e4], [-1e4, 0.0]]), np.array([[0.0, -1e4, -1e4]])
    labels, confidence = match_scores(np.zeros((len(by_point), 3)), by_point, by_label, None)
    assert labels.tolist() == [0, GHOST]
    np.testing.assert_allclose(confidence, 1.0)


@given(seed=st.integers(0, 10_000), count=st.integers(0, 30), num_labels=st.integers(1, 25))
@settings(max_examples=100, deadline=None)
def test_an_assignment_is_that_of_scipy(seed, count, num_labels):
    """A column of its own stands for each point's reject there."""
    rng = np.random.default_rng(seed)
    costs, reject = rng.normal(0.0, 3.0, (count, num_labels)), rng.normal(2.0, 3.0, count)
    table = np.full((count, num_labels + count), 1e6)
    table[:, :num_labels] = costs
    table[np.arange(count), num_labels + np.arange(count)] = reject
    rows, columns = linear_sum_assignment(table)
    total, labels = assign(costs, reject)
    assert np.isclose(total, table[rows, columns].sum())
    assert labels.tolist() == np.where(columns < num_labels, columns, GHOST).tolist()


@pytest.fixture(scope="module")
def prior():
    return load_labeler("dense19").prior


def hand(rng):
    """Markers of somebody's hand in some pose (M, 3) [m]."""
    model = HandModel(sample_shape(rng=rng))
    return attach(LAYOUT, model).markers(sample_poses(model, 1, rng=rng))[0][0]


def unsure(num_points, labels, doubtful, other, rng):
    """Scores that are sure of all labels but one: that point is a little rather the other marker."""
    by_point = np.full((num_points, LAYOUT.num_markers + 1), -8.0)
    by_point[np.arange(num_points), labels] = -0.01
    by_point[doubtful, labels[doubtful]] = np.log(0.4)
    by_point[doubtful, other] = np.log(0.6)
    by_label = np.full((LAYOUT.num_markers, num_points + 1), -8.0)
    named = labels[labels >= 0]
    by_label[named, np.flatnonzero(labels >= 0)] = -0.01
    by_label[np.setdiff1d(np.arange(LAYOUT.num_markers), named), -1] = -0.01
    by_label[labels[doubtful]] = -8.0
    by_label[labels[doubtful], [doubtful, -1]] = np.log(0.5)
    by_label[other] = -8.0
    by_label[other, [doubtful, -1]] = np.log(0.5)
    return by_point, by_label


def test_a_neighbors_marker_in_an_occluded_place_is_named_rightly(prior, rng):
    right = scored = 0
    for _ in range(40):
        markers = hand(rng)
        labels = np.delete(np.arange(LAYOUT.num_markers), PIP)  # the little finger's tip is hidden
        points = markers[labels] + rng.normal(scale=0.0005, size=(len(labels), 3))
        doubtful = int(np.flatnonzero(labels == TIP)[0])
        scores = unsure(len(points), labels, doubtful, PIP, rng)
        assert match_scores(points, *scores, None)[0][doubtful] == PIP, "the scores alone are wrong"
        found, confidence = match_scores(points, *scores, prior)
        right += found[doubtful] == TIP
        scored += 1
        assert np.delete(found, doubtful).tolist() == np.delete(labels, doubtful).tolist()
        assert ((confidence >= 0.0) & (confidence <= 1.0)).all()
    assert right / scored > 0.9


def test_a_left_hand_is_verified_as_well(prior, rng):
    markers = hand(rng) * [-1.0, 1.0, 1.0]
    labels = np.delete(np.arange(LAYOUT.num_markers), PIP)
    doubtful = int(np.flatnonzero(labels == TIP)[0])
    found, _ = match_scores(markers[labels], *unsure(len(labels), labels, doubtful, PIP, rng), prior)
    assert found[doubtful] == TIP


def test_sure_scores_and_clouds_of_more_than_a_hand_are_believed(prior, rng):
    points = rng.normal(scale=0.05, size=(5, 3))
    by_point = np.full((5, LAYOUT.num_markers + 1), -20.0)
    by_point[:, -1] = 0.0
    by_label = np.full((LAYOUT.num_markers, 6), -20.0)
    by_label[:, -1] = 0.0
    labels, confidence = match_scores(points, by_point, by_label, prior)
    assert labels.tolist() == [GHOST] * 5
    np.testing.assert_allclose(confidence, 1.0)
    count = 2 * LAYOUT.num_markers + 1
    many = np.log(rng.dirichlet(np.ones(LAYOUT.num_markers + 1), size=count))
    some = np.log(rng.dirichlet(np.ones(count + 1), size=LAYOUT.num_markers))
    cloud = rng.normal(scale=0.1, size=(count, 3))
    both = match_scores(cloud, many, some, prior), match_scores(cloud, many, some, None)
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one, other)
