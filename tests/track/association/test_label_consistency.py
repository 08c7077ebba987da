"""Names that IDs carry along, checked against the hand that is coming."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import load_layout
from handsim.hand.model import join_qpos
from poses.motion.motions import sample_motion
from track.association.hand_state import Coming, HandMemory
from track.association.label_consistency import fit_names, forget_surprises, targets_of

RATE = 120.0


@pytest.fixture(scope="module")
def hand() -> GloveFit:
    return nominal_fit(load_layout("dense19"), "M", "right")


@pytest.fixture(scope="module")
def motion(hand) -> np.ndarray:
    qpos = sample_motion(hand.model, 2.0, rng=np.random.default_rng(3)).qpos
    return join_qpos(qpos[:, 7:], position=np.tile([0.1, 0.2, 1.0], (len(qpos), 1)))


@pytest.fixture(scope="module")
def markers(hand, motion) -> np.ndarray:
    return hand.attachment.centers(hand.model, hand.model.forward_kinematics(motion))


def followed(
    hand: GloveFit, motion: np.ndarray, markers: np.ndarray, frames: int
) -> tuple[HandMemory, Coming]:
    """A hand that was followed for some frames, all of its markers being seen, and what is coming next."""
    memory = HandMemory(hand)
    memory.begin(motion[0], markers[0], 0.0)
    for frame in range(1, frames):
        coming = memory.predict(frame / RATE)
        estimate = memory.fit(markers[frame], coming.qpos, coming)
        memory.carry_on(estimate, np.ones(memory.num_markers, dtype=bool), frame / RATE)
    return memory, memory.predict(frames / RATE)


def test_targets_are_points_in_the_layouts_order():
    points = np.arange(12.0).reshape(4, 3)
    targets = targets_of(points, np.array([2, -1, 0, 4]), 5)
    np.testing.assert_array_equal(targets[[2, 0, 4]], points[[0, 2, 3]])
    assert np.isnan(targets[[1, 3]]).all()
    assert np.isnan(targets_of(points[:0], np.array([], dtype=int), 5)).all()


@pytest.mark.parametrize("frames", [1, 20, 150])
def test_right_names_stay_and_give_the_pose(hand, motion, markers, frames):
    memory, coming = followed(hand, motion, markers, frames)
    names = np.arange(19)
    forget_surprises(memory, markers[frames], names, coming)
    estimate = fit_names(memory, markers[frames], names, coming)
    np.testing.assert_array_equal(names, np.arange(19))
    assert estimate.rms < 1e-4
    np.testing.assert_allclose(estimate.places, markers[frames], atol=1e-3)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 18), st.integers(0, 500), st.floats(0.025, 0.2), st.sampled_from([1, 20]))
def test_a_name_far_from_where_its_marker_comes_is_forgotten(hand, motion, markers, wrong, seed, off, frames):
    memory, coming = followed(hand, motion, markers, frames)
    way = np.random.default_rng(seed).normal(size=3)
    points, names = markers[frames].copy(), np.arange(19)
    points[wrong] += off * way / np.linalg.norm(way)
    forget_surprises(memory, points, names, coming)
    assert np.flatnonzero(names < 0).tolist() == [wrong]
    assert np.flatnonzero(names != np.arange(19)).tolist() == [wrong]


def test_a_hand_that_is_elsewhere_keeps_its_names(hand, motion, markers):
    """Then it is the pose that was not coming."""
    memory, coming = followed(hand, motion, markers, 20)
    names, points = np.arange(19), markers[20] + [0.05, 0.0, 0.0]
    forget_surprises(memory, points, names, coming)
    np.testing.assert_array_equal(names, np.arange(19))
    estimate = fit_names(memory, points, names, coming)
    np.testing.assert_array_equal(names, np.arange(19))
    np.testing.assert_allclose(estimate.places, points, atol=1e-3)


def test_few_names_may_be_wrong_at_once(hand, motion, markers):
    memory, coming = followed(hand, motion, markers, 20)
    for many, gone in ((5, 5), (6, 0)):  # of 19 names, at most 30 %
        names, points = np.arange(19), markers[20].copy()
        points[:many] += [0.0, 0.0, 0.06]
        forget_surprises(memory, points, names, coming)
        assert (names < 0).sum() == gone


def planted(points: np.ndarray, wrong: int, off: float, seed: int) -> np.ndarray:
    """Points of which one lies elsewhere."""
    way, points = np.random.default_rng(seed).normal(size=3), points.copy()
    points[wrong] += off * way / np.linalg.norm(way)
    return points


@settings(deadline=None, max_examples=40)
@given(st.sampled_from([0, 4, 7, 10, 13, 16, 17, 18]), st.integers(0, 500), st.floats(0.03, 0.1))
def test_a_planted_wrong_name_is_taken_away_and_the_right_ones_stay(hand, motion, markers, wrong, seed, off):
    """On the palm and at the knuckles, where no bent finger explains it."""
    memory, coming = followed(hand, motion, markers, 20)
    names = np.arange(19)
    estimate = fit_names(memory, planted(markers[20], wrong, off, seed), names, coming)
    assert np.flatnonzero(names < 0).tolist() == [wrong]
    np.testing.assert_allclose(estimate.places, markers[20], atol=0.004)


def test_a_wrong_name_on_a_finger_seldom_takes_others_along(hand, motion, markers):
    """The worst goes first: where a bent finger explains the wrong one, that may be a right one."""
    memory, coming = followed(hand, motion, markers, 20)
    found = []
    for number, wrong in enumerate([*range(1, 16)] * 20):
        names = np.arange(19)
        fit_names(memory, planted(markers[20], wrong, (0.03, 0.05, 0.09)[number % 3], number), names, coming)
        found.append(np.flatnonzero(names < 0).tolist() == [wrong])
    assert np.mean(found) >= 0.95


@pytest.mark.parametrize("pair", [(3, 6), (6, 9), (9, 12), (5, 8), (0, 17)])
def test_of_two_names_that_changed_places_both_go(hand, motion, markers, pair):
    memory, coming = followed(hand, motion, markers, 20)
    names = np.arange(19)
    names[list(pair)] = pair[::-1]
    estimate = fit_names(memory, markers[20], names, coming)
    assert set(np.flatnonzero(names < 0)) == set(pair)
    np.testing.assert_allclose(estimate.places, markers[20], atol=0.004)


def test_with_no_names_the_hand_comes_as_it_was_coming(hand, motion, markers):
    memory, coming = followed(hand, motion, markers, 20)
    names = np.full(19, -1)
    estimate = fit_names(memory, markers[20], names, coming)
    assert np.isnan(estimate.rms) and (names == -1).all()
    np.testing.assert_array_equal(estimate.qpos, coming.qpos)
    forget_surprises(memory, np.zeros((0, 3)), np.zeros(0, dtype=int), coming)
