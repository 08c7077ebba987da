"""What moves in a take: kinds of capture, calibration, hands like real ones."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest

from gloves import Take, attach, load_layout
from handsim import HandModel
from handsim.errors import ArgumentError, PoseError
from handsim.space.transforms import quaternion_matrix
from poses.motion import RATE
from poses.shapes import is_valid
from poses.touch import FINGERS, is_touching
from train import simulate_take
from train.simulation import scenes
from train.simulation.scenes import (
    CalibrationTakeConfig,
    SceneMotion,
    calibration_angles,
    sample_real_like_scene,
)
from train.simulation.takes import sample_scene, simulate_calibration
from train.simulation.training_frames import FLESH, NOISE, move_skin

SHORT = CalibrationTakeConfig(free=1.0, rounds=1)
FRAMES = 240


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_faster_scene_passes_through_the_same_poses(times, rng):
    scene = sample_scene("hand-controller", load_layout("dense19"), 31, rng=rng)
    fast = scene.faster(times)
    assert fast.rate == scene.rate == RATE
    assert fast.num_frames == -(-31 // times)
    for hand, before in zip(fast.hands, scene.hands, strict=True):
        assert hand.fit is before.fit
        np.testing.assert_array_equal(hand.qpos, before.qpos[::times])
    held, before = fast.moving_object, scene.moving_object
    np.testing.assert_array_equal(held.T_world_body, before.T_world_body[::times])


def test_the_thumb_touches_every_finger(rng):
    model = HandModel.named("M")
    angles = calibration_angles(model, SHORT, rng=rng)
    assert is_valid(model, angles).all()
    for finger in FINGERS:
        assert is_touching(model, angles, finger).any()


def test_a_take_of_both_hands_has_its_truth(rng):
    hands = [HandModel.named("M", side=side) for side in ("right", "left")]
    fits = tuple(attach(load_layout("dense19"), hand) for hand in hands)
    take = simulate_calibration(fits, CalibrationTakeConfig(free=0.5, rounds=0), rng=rng)
    assert [hand.side for hand in take.hands] == ["right", "left"]
    assert take.settings["kind"] == "calibration"
    assert take.markers_present().mean() > 0.9
    for label, hand, fit in zip(take.hand_labels, take.moving_hands(), fits, strict=True):
        off = take.observed(label) - fit.markers(hand.qpos)[0]
        assert np.nanmedian(np.linalg.norm(off, axis=-1)) < 0.0005
    middles = [np.nanmedian(take.observed(label), axis=(0, 1)) for label in take.hand_labels]
    assert np.linalg.norm(middles[0] - middles[1]) > 0.2


def test_only_touches_out_of_reach_are_left_out(rng, monkeypatch):
    model, touching_angles = HandModel.named("M"), scenes.touching_angles

    def without_the_ring_finger(model, finger, start):
        if finger == "ring":
            raise PoseError("out of reach")
        return touching_angles(model, finger, start)

    monkeypatch.setattr(scenes, "touching_angles", without_the_ring_finger)
    angles = calibration_angles(model, SHORT, rng=rng)
    assert is_touching(model, angles, "index").any()

    def broken(model, finger, start):
        raise ArgumentError("start has shape (3,), expected (..., 20)")

    monkeypatch.setattr(scenes, "touching_angles", broken)
    with pytest.raises(ArgumentError, match="start has shape"):
        calibration_angles(model, SHORT, rng=rng)


def test_bad_values_are_told(rng):
    with pytest.raises(ArgumentError, match="free is 0, expected a number above 0"):
        CalibrationTakeConfig(free=0.0)
    with pytest.raises(ArgumentError, match="expected 0 or more"):
        CalibrationTakeConfig(rounds=-1)
    with pytest.raises(ArgumentError, match="0 hands, expected one or two"):
        simulate_calibration((), SHORT, rng=rng)


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
