"""The map of a volume: good in the middle, bad where no camera looks."""

from __future__ import annotations

import numpy as np

from handsim.space.cameras import ROOM_CENTER, named_rig
from train.rig_advice.volume_map import GRID, map_volume


def test_the_middle_is_seen_and_far_away_is_not(work):
    sides = np.array([6.0, 0.4, 0.4])
    found = map_volume(work, named_rig("figure5"), np.array(ROOM_CENTER), sides, rng=np.random.default_rng(0))
    assert len(found.points) == GRID**3
    middle, ends = np.abs(found.points[:, 0]) < 0.1, np.abs(found.points[:, 0]) > 2.9
    assert found.seen_by_two[middle].mean() > 0.95 > found.seen_by_three[ends].mean()
    assert found.seen_by_two[ends].mean() < 0.6
    assert (found.seen_by_three <= found.seen_by_two).all()
    assert 0.0 < np.nanmean(found.error[middle]) < 0.001
    assert np.isnan(found.error[ends]).any() or np.nanmean(found.error[ends]) > np.nanmean(
        found.error[middle]
    )
