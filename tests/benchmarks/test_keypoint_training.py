"""Photographs of people who are learned from and of others, and what MediaPipe calls a keypoint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import keypoint_training as training


@pytest.fixture
def photos():
    """500 photographs of 50 people, whose numbers are their sizes; hands differ."""
    points = np.random.default_rng(0).uniform(20.0, 108.0, (500, 21, 2))
    return training.Pictures(
        np.zeros((500, training.SIZE, training.SIZE, 3), np.uint8), points, np.arange(500)
    )


def test_nobody_is_learned_from_and_tried_on(photos):
    labeled, others = training.split(photos, 100)
    assert len(labeled.crops) == 100 and len(others.crops) >= 200
    assert np.abs(labeled.sizes[:, None] - others.sizes).min() > 10  # a whole person between them
    labeled, others = training.split(photos, 0)
    assert len(labeled.crops) == 0
    np.testing.assert_array_equal(others.sizes, photos.sizes)


def test_labels_of_mediapipe_are_learned_where_our_keypoints_are(photos):
    edge = (training.WIDE - training.SIZE) // 2
    wide = training.labeled_as_ours(photos)
    assert wide.crops.shape[1:] == (training.WIDE, training.WIDE, 3)
    np.testing.assert_allclose(training.MEDIAPIPE @ (wide.points - edge), photos.points)
    moved = photos.points - (wide.points - edge)
    middle = photos.points[:, 9] - wide.points[:, 0] + edge
    np.testing.assert_allclose(moved[:, 0], 0.09 * middle, atol=1e-9)  # the wrist, towards the fingers


def test_batches_have_a_quarter_of_labeled_photographs(photos):
    light = np.full((500, training.WIDE, training.WIDE, 3), 200, np.uint8)
    light[:, ::2] = 0  # pictures of one color have no contrast
    drawn = training.Pictures(light, photos.points, photos.sizes)
    labeled = training.labeled_as_ours(training.Pictures(*(values[:100] for values in photos)))
    images, points = next(training.batches(drawn, 400, np.random.default_rng(0), labeled))
    flat = images.std(dim=(1, 2, 3)) < 0.5
    assert points.shape == (400, 21, 2)
    assert 0.18 < flat.float().mean() < 0.32


def test_a_map_with_two_peaks_has_its_keypoint_at_the_higher_one():
    network = training.KeypointNetwork(width=1)
    far = torch.cdist(network.places, torch.tensor([[0.3, 0.5], [0.7, 0.5]]))
    near = torch.exp(-((far / training.SPREAD) ** 2) / 2)
    heat = torch.log(0.55 * near[:, 0] + 0.45 * near[:, 1] + 1e-9).expand(1, 21, -1)
    network.heat = lambda x: heat
    found = network(torch.zeros(1, 3, training.SIZE, training.SIZE))
    np.testing.assert_allclose(found[0, 0], [0.3, 0.5], atol=0.01)
