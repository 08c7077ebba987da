"""Takes that are like real ones: displaced markers, anybody's hands, fast motion."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest

from gloves.layout import load_layout
from gloves.takes.take import Take
from handsim.space.transforms import quaternion_matrix
from train.simulation.scenes import FLESH, NOISE, SceneMotion, move_skin, sample_real_like_scene
from train.simulation.takes import sample_scene, simulate_take

FRAMES = 240


@functools.cache
def real_like() -> Take:
    return simulate_take(kind="real-like", num_frames=FRAMES)


def test_markers_are_off_by_noise_and_flesh():
    take = real_like()
    for hand, label in zip(take.moving_hands(), take.hand_labels, strict=True):
        bones = hand.fit.model.forward_kinematics(hand.qpos)
        off = take.observed(label) - hand.fit.attachment.centers(hand.fit.model, bones)
        assert np.sqrt(np.nanmean(off**2)) == pytest.approx(np.hypot(NOISE, FLESH), rel=0.15)
        assert np.abs(np.nanmean(off, axis=(0, 1))).max() < 0.0005


def test_a_part_of_the_displacement_repeats_with_the_pose_in_the_frame_of_the_wrist():
    hand = real_like().moving_hands()[0]
    still = hand.qpos[np.tile(np.arange(4) * 60, 500)]  # four poses, again and again
    repeated = type(hand)(hand.fit, still)
    moved = move_skin(repeated, rng=np.random.default_rng(1))
    local = np.einsum("tji,tmj->tmi", quaternion_matrix(still[:, 3:7]), moved)
    means = local.reshape(500, 4, *local.shape[1:]).mean(axis=0)
    assert np.sqrt((means**2).mean()) == pytest.approx(FLESH, rel=0.1)
    rest = local - np.tile(means, (500, 1, 1))
    assert rest.std() == pytest.approx(NOISE, rel=0.05)


def test_the_same_seed_gives_the_same_take_of_two_hands():
    take, again = real_like(), simulate_take(kind="real-like", num_frames=FRAMES)
    np.testing.assert_array_equal(take.points, again.points)
    assert [hand.side for hand in take.hands] == ["right", "left"]
    assert take.num_frames == FRAMES and take.settings["kind"] == "real-like"


def test_hands_are_faster_than_in_the_twin_of_two_hands():
    layout = load_layout("dense19")

    def speed(sample: Callable[[np.random.Generator], SceneMotion]) -> float:
        scenes = [sample(np.random.default_rng(seed)) for seed in range(4)]
        return float(
            np.mean([np.abs(np.diff(scene.hands[0].qpos[:, 7:], axis=0)).mean() for scene in scenes])
        )

    slow = speed(lambda rng: sample_scene("hand-hand", layout, 600, rng=rng))
    fast = speed(lambda rng: sample_real_like_scene(layout, 600, rng=rng))
    assert fast > 1.3 * slow
