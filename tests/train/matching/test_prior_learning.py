"""Learning what hands look like from frames of them."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from train.matching.prior_learning import align_all, learn_pose_prior


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
    right = [prior.log_density(hand, labels, mirrored=False) for hand in others]
    wrong = [prior.log_density(hand, labels, mirrored=False) for hand in exchanged]
    mirrored = [prior.log_density(hand, labels, mirrored=True) for hand in others]
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
