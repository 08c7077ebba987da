"""What is known of a layout: counted again by other means where that is possible."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.layout import load_layout
from gloves.takes.take import Take
from handsim.errors import CaptureError
from handsim.space.rig import load_rig
from track.glove_advice.observed_hands import observe_motion, observe_poses
from train.simulation.takes import simulate_take


def test_seen_and_near_are_counted(tips, tips_hands, tips_score):
    observed = np.concatenate([hand.frames.observed for hand in tips_hands])
    markers = np.concatenate([hand.frames.markers for hand in tips_hands])
    np.testing.assert_allclose(tips_score.seen, np.isfinite(observed).all(axis=2).mean(axis=0))
    first, second = tips.names.index("MiddleTip"), tips.names.index("RingTip")
    apart = np.linalg.norm(markers[:, first] - markers[:, second], axis=1)
    expected = (apart < 2 * tips.radius + 0.003).mean()
    assert tips_score.near[first, second] == tips_score.near[second, first] == pytest.approx(expected)
    assert np.diag(tips_score.near).max() == 0.0


def test_slots_are_right_more_often_where_all_is_seen(tips, tips_score):
    clean, observed = tips_score.clean.figures, tips_score.observed.figures
    assert 1.0 / tips.num_markers < observed["slot_accuracy"] <= clean["slot_accuracy"] + 0.02
    assert tips_score.observed.num_frames == tips_score.clean.num_frames
    assert tips_score.sides_right > 0.9


def test_joints_are_known_less_without_a_marker(tips, tips_score):
    assert tips_score.joints_without.shape == (tips.num_markers, 20)
    assert (tips_score.joints_without >= tips_score.joints - 0.01).all()


def test_a_blind_rig_sees_fewer_markers(tips):
    rig = load_rig("six")
    pair = dataclasses.replace(rig, cameras=rig.cameras[:2])
    shares = [
        np.isfinite(
            np.concatenate(
                [hand.frames.observed for hand in observe_poses(tips, one, 120, rng=np.random.default_rng(2))]
            )
        ).mean()
        for one in (rig, pair)
    ]
    assert shares[1] < 0.7 * shares[0]


def test_the_hands_of_a_take_wear_the_layout(tips):
    take = simulate_take("hand-hand", num_frames=60)
    hands = observe_motion(take, tips, load_rig("figure5"), 20, rng=np.random.default_rng(3))
    assert [hand.fit.side for hand in hands] == [hand.side for hand in take.hands]
    assert all(hand.frames.markers.shape == (20, tips.num_markers, 3) for hand in hands)
    np.testing.assert_array_equal(hands[0].qpos[:, 7:], take.qpos[np.linspace(0, 59, 20).astype(int), 0, 7:])
    empty = Take.of_poses(take.hands, np.full_like(take.qpos, np.nan), rate=take.rate)
    with pytest.raises(CaptureError, match="no frame in which every hand"):
        observe_motion(empty, load_layout("tips8"), load_rig("six"), 20, rng=np.random.default_rng(3))
