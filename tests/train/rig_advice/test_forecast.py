"""The forecast of a rig against counting by hand, and against a simulated take."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.captures.gaps import run_lengths
from handsim.space.cameras import named_rig
from train.rig_advice.forecast import ROOM, camera_losses, forecast, light
from train.simulation.room import record_take


def test_shares_are_those_of_the_lines_of_sight(six_lit):
    found = forecast(six_lit, named_rig("six"))
    views = np.concatenate([one.seen.sum(axis=-1).ravel() for one in six_lit])
    assert found.marker_frames == len(views) == 5 * 120 * 16
    assert found.seen_by_two == pytest.approx((views >= 2).mean())
    assert found.seen_by_three == pytest.approx((views >= 3).mean())
    assert 1.0 - found.seen_by_two <= found.missing + 0.02
    assert 0.0 < found.error.mean < 0.001


def test_the_forecast_is_what_a_take_of_the_same_hands_misses(work, six_lit):
    rig = named_rig("six")
    present = [
        record_take(scene, rig, ROOM, {}, rng=np.random.default_rng(number)).markers_present()
        for number, scene in enumerate(work)
    ]
    found = forecast(six_lit, rig)
    missing = np.mean([~one for one in present])
    gaps = sum(len(run_lengths(~one)) for one in present)
    assert found.missing == pytest.approx(missing, abs=0.02)
    minutes = found.marker_frames / 120.0 / 60.0
    assert found.gaps * minutes == pytest.approx(gaps, rel=0.15)


def test_a_second_camera_at_the_same_place_can_go_and_others_cannot(work):
    rig = named_rig("figure5")
    few = light(work[:2], rig, rng=np.random.default_rng(2))
    losses = camera_losses(few, rig)
    whole = forecast(few, rig)
    for number, loss in enumerate(losses):
        views = np.concatenate([one.seen.reshape(-1, 16) for one in few])
        others = np.delete(views, number, axis=1).sum(axis=1)
        assert loss.needed == pytest.approx((views[:, number] & (others < 2)).mean())
        assert loss.without.seen_by_two <= whole.seen_by_two
    six = camera_losses(light(work[:2], named_rig("six"), rng=np.random.default_rng(2)), named_rig("six"))
    assert min(one.needed for one in six) > max(one.needed for one in losses)
