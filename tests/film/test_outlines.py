from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from film.bundle import POSES, Bundle, Detections, State
from film.outlines import Outlines, _color_shares
from gloves.takes.take import Take
from tests.film.filmed import SIZE, Filming, moving_take, pose_of


def test_each_hand_is_seen_by_itself():
    """Two hands are found as each is alone; where the take has none, nothing is."""
    filming = Filming(seed=31, seconds=1.5, rate=4.0, readout=(0.0, 0.0))
    both = moving_take(sides=("right", "left"))
    qpos = both.qpos.copy()
    qpos[both.times < filming.offset + 0.1] = np.nan
    both = Take.of_poses(both.hands, qpos, rate=both.rate)
    pictures = filming.pictures(moving_take(sides=("right", "left")), "skin")
    camera = filming.cameras()[0]
    values = np.zeros(POSES + 6)
    values[[0, 2]] = filming.offset, np.log(camera.focal_length / SIZE[0])
    values[POSES:] = pose_of(camera)
    looks, found = list(enumerate(pictures)), []
    for take in (
        both,
        *(Take.of_poses(both.hands[n : n + 1], qpos[:, n : n + 1], rate=both.rate) for n in (0, 1)),
    ):
        bundle = Bundle(take, Detections.of(filming.found(take)), SIZE, None)
        edges, seen = Outlines(bundle).edges(State(values), looks, 0.02)
        assert edges is not None and np.isnan(seen.tried[0]).all()
        found.append(seen.found)
    together, *alone = found
    assert np.nanmax(together) > 30.0
    apart = np.abs(np.hstack(alone) - together)[1:]
    assert np.nanmedian(apart) <= 1.0  # of a forearm beside the other hand fewer pixels are counted


def test_colors_are_smoothed_in_all_channels():
    rng = np.random.default_rng(0)
    counts = (rng.integers(0, 50, (32, 32, 32)) * (rng.random((32, 32, 32)) > 0.95)).astype(np.float32)
    smooth = gaussian_filter(counts, 1.0, mode="nearest")
    np.testing.assert_allclose(_color_shares(counts), smooth / smooth.sum() + 3e-5, rtol=1e-5)
