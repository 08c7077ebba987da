"""The forecast of a rig against counting by hand, a simulated take, and points that are really put out."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import OpticsConfig, load_layout
from gloves.captures.capture import run_lengths
from gloves.optics.reconstruction import reconstruct
from handsim import load_rig, look_at
from handsim.errors import CaptureError
from handsim.space.transforms import pose_matrices
from tests.rigs import mixed_rig, square_rig
from train import simulate_take
from train.forecast.rig_forecast import (
    camera_losses,
    covariances,
    duration_quantile,
    ellipsoid,
    forecast,
    light_work,
    sample_work,
    work_of_take,
)
from train.simulation.scenes import SceneMotion
from train.simulation.training_frames import MovingObject


def test_shares_are_those_of_the_lines_of_sight(six_lit):
    found = forecast(six_lit, load_rig("six"))
    views = np.concatenate([one.seen.sum(axis=-1).ravel() for one in six_lit])
    assert found.marker_frames == len(views) == 5 * 120 * 16
    assert found.seen_by_two == pytest.approx((views >= 2).mean())
    assert found.seen_by_three == pytest.approx((views >= 3).mean())
    assert 1.0 - found.seen_by_two <= found.missing + 0.02
    assert 0.0 < found.error.mean < 0.001


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand", "hand-controller"])
def test_the_forecast_is_what_simulated_takes_of_this_kind_have(kind):
    """Gaps and ghosts too, with the losses and reflections that takes have by default."""
    rig, rng = load_rig("six"), np.random.default_rng(0)
    takes = [simulate_take(kind, glove="tips8", rig=rig, num_frames=240, seed=seed) for seed in range(4)]
    scenes = [SceneMotion(one.moving_hands(), moving_thing(one), one.rate) for one in takes]
    found = forecast(light_work({kind: scenes}, rig, rng=rng)[kind], rig)
    present = [one.markers_present()[:, :16] for one in takes]
    ghosts = [(np.isfinite(one.points[..., 0]) & (one.labels < 0)).sum(axis=1).mean() for one in takes]
    assert found.missing == pytest.approx(np.mean([~one for one in present]), abs=0.02)
    minutes = found.marker_frames / 120.0 / 60.0
    assert found.gaps * minutes == pytest.approx(sum(len(run_lengths(~one)) for one in present), rel=0.2)
    assert found.ghosts == pytest.approx(np.mean(ghosts), rel=0.6, abs=0.05)  # others are drawn


@pytest.mark.parametrize("length", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("share", [0.5, 0.95])
def test_gaps_that_outlast_a_scene_count(length, share):
    """Exponential gaps of a second in scenes that end after the gap's beginning by 0 to 8 times `length`."""
    rng = np.random.default_rng(3)
    gaps, rest = rng.exponential(1.0, 20_000), rng.uniform(0.0, 8.0 * length, 20_000)
    found = duration_quantile(np.minimum(gaps, rest), gaps <= rest, share)
    assert found == pytest.approx(-np.log(1.0 - share), rel=0.06)
    assert np.quantile(np.minimum(gaps, rest), share) < found


def test_gaps_without_an_end_have_no_percentile():
    ended = np.array([True, True, False, False])
    assert duration_quantile(np.array([0.1, 0.2, 0.3, 0.4]), ended, 0.5) == 0.2
    assert duration_quantile(np.array([0.1, 0.2, 0.3, 0.4]), ended, 0.95) == np.inf
    assert np.isnan(duration_quantile(np.empty(0), np.empty(0, dtype=bool), 0.5))
    lengths = np.array([0.4, 0.1, 0.2, 0.3])
    assert duration_quantile(lengths, np.ones(4, dtype=bool), 0.5) == 0.2


def moving_thing(take):
    """The object of a take, where it was."""
    body = take.bodies[0] if take.bodies else None
    if body is None:
        return None
    return MovingObject(body.shape, pose_matrices(take.body_poses[:, 0]))


def lit(scenes, rig):
    """The scenes in the default room."""
    return light_work({"calibration": scenes}, rig, rng=np.random.default_rng(2))["calibration"]


def test_a_second_camera_at_the_same_place_can_go_and_others_cannot(work):
    rig = load_rig("figure5")
    few = lit(work[:2], rig)
    losses = camera_losses(few, rig)
    whole = forecast(few, rig)
    for number, loss in enumerate(losses):
        views = np.concatenate([one.seen.reshape(-1, 16) for one in few])
        others = np.delete(views, number, axis=1).sum(axis=1)
        assert loss.needed == pytest.approx((views[:, number] & (others < 2)).mean())
        assert loss.without.seen_by_two <= whole.seen_by_two
    six = camera_losses(lit(work[:2], load_rig("six")), load_rig("six"))
    assert min(one.needed for one in six) > max(one.needed for one in losses)


@pytest.mark.parametrize("rig", [load_rig("six"), load_rig("figure5"), mixed_rig()], ids=lambda rig: rig.name)
def test_the_covariance_is_that_of_reconstructed_points(rig):
    """Also of cameras with lenses, whose noise is one of real pixels."""
    frames = 20_000
    point = np.array([0.15, -0.1, 1.2])
    optics = OpticsConfig(noise=0.5, blob_loss=0.0, dropout=0.0)
    seen = np.ones((frames, 1, len(rig.positions)), dtype=bool)
    sources = np.tile(point, (frames, 1, 1))
    found = reconstruct(sources, seen, rig, optics, continuous=False, rng=np.random.default_rng(0))
    measured = np.cov((found.positions[:, 0] - point).T)
    expected = covariances(point[None], seen[:1, 0], rig, np.array([0.5]))[0]
    assert np.linalg.norm(measured - expected) < 0.05 * np.linalg.norm(expected)


def test_two_cameras_side_by_side_know_depth_least():
    middle = np.array([0.0, 0.0, 1.1])
    poses = np.stack([look_at(np.array([x, -2.0, 1.1]), middle) for x in (-0.25, 0.25)])
    rig = square_rig("pair", poses)
    spread = covariances(middle[None], np.ones((1, 2), dtype=bool), rig, np.array([0.12]))
    found = ellipsoid(spread)
    assert abs(found.directions[0, 1]) > 0.999
    # By hand: an error of s across either ray moves the point by s / (sqrt(2) sin a) in depth, where a is
    # half the angle between the rays, and by s / sqrt(2) upwards.
    distance = np.hypot(0.25, 2.0)
    across = 0.12 * distance / rig.cameras[0].focal_length
    assert found.axes[0] == pytest.approx(across / np.sqrt(2) / (0.25 / distance), rel=1e-6)
    assert found.axes[1:] == pytest.approx(
        [across / np.sqrt(2) / (2.0 / distance), across / np.sqrt(2)], rel=1e-6
    )
    assert found.mean == pytest.approx(np.linalg.norm(found.axes))


def test_no_points_have_no_error():
    assert np.isnan(ellipsoid(np.empty((0, 3, 3))).mean)


def test_people_walk_through_a_long_volume():
    center, sides = np.array([5.0, 1.0, 1.3]), np.array([4.0, 0.6, 0.6])
    rng = np.random.default_rng(0)
    work = sample_work(load_layout("tips8"), center, sides, 1500, 1, rng=rng)
    wrists = np.concatenate([hand.qpos[:, :3] for one in work.values() for hand in one[0].hands])
    away = wrists - center
    assert np.ptp(away[:, 0]) > 3.0 and np.abs(away[:, 0]).max() < 2.4
    assert np.abs(away[:, 1:]).max() < 0.6


def test_an_object_stays_in_the_hand(work):
    scene = work[-1]
    offset = np.tile([1.0, 2.0, 0.1], (scene.num_frames, 1))
    there = scene.moved(offset)
    before, after = (
        one.moving_object.T_world_body[:, :3, 3] - one.hands[0].qpos[:, :3] for one in (scene, there)
    )
    assert after == pytest.approx(before)
    assert there.hands[1].qpos[:, :3] - scene.hands[1].qpos[:, :3] == pytest.approx(offset)


def test_a_take_keeps_its_place_and_its_stretches():
    take = simulate_take("hand-pen", num_frames=60, glove="tips8")
    (scene,) = work_of_take(take, None, 40)["the take"]
    assert scene.num_frames == 40 and scene.moving_object is not None
    assert scene.hands[0].qpos == pytest.approx(take.qpos[:40, 0])
    assert scene.hands[0].fit.layout.num_markers == 8
    take.qpos[20:30, 0] = np.nan
    parts = work_of_take(take, load_layout("dense19"), 1000)["the take"]
    assert [one.num_frames for one in parts] == [20, 30]
    assert parts[0].hands[1].fit.layout.num_markers == 19
    take.qpos[:, 1] = np.nan
    with pytest.raises(CaptureError, match="no 12 frames in a row"):
        work_of_take(take, None, 1000)
