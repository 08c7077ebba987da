"""Labels that a hand decides where scores do not."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import attach
from handsim import HandModel, sample_shape
from poses import sample_poses
from train import load_labeler
from train.matching.assignment import GHOST
from train.matching.verification import match_scores

LAYOUT = load_layout("dense19")
TIP, PIP = LAYOUT.names.index("RingTip"), LAYOUT.names.index("PinkyTip")


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
