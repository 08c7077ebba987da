from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from film.bundle import OFFSET, POSES, Bundle, Detections, Samples, State
from handsim import Camera, Lens
from tests.film.filmed import SIZE, Filming, moving_take, pose_of


@pytest.mark.parametrize("given", [False, True])
def test_the_jacobian_is_that_of_the_residuals(given):
    """Two spans, a lens that bends, hands that are thicker; some points are behind the second camera."""
    take, filming, rng = moving_take(), Filming(seed=1, seconds=6.0), np.random.default_rng(0)
    true = filming.cameras()[0]
    fisheye = Camera("f", SIZE, true.K, lens=Lens("fisheye", (0.02, -0.01, 0.0, 0.0)))
    bundle = Bundle(take, Detections.of(filming.found(take)), SIZE, fisheye if given else None)
    values = np.zeros(POSES + 12)
    values[:POSES] = [filming.offset, 1e-5, 0.1, 0.01, -0.01, -0.03, 0.01, 1e-3, 0.01, 0.01, 0.02]
    rotation = true.T_world_camera[:3, :3]
    turns = np.stack([rotation, rotation @ np.diag([-1.0, 1.0, -1.0])])
    state = State(values, (0, 150))
    for span, turn in enumerate(turns):
        camera = dataclasses.replace(true, T_world_camera=np.block(
            [[turn, true.T_world_camera[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]]
        ))  # fmt: skip
        values[POSES + 6 * span :][:6] = pose_of(camera)
    samples = bundle.samples(bundle.match(state, np.inf))
    size = len(samples.frames)
    samples = samples._replace(
        outward=rng.normal(size=(size, 3)), from_middle=rng.normal(0.0, 0.03, (size, 3))
    )
    found = bundle.jacobian(state, samples, 3.0)
    behind = state.spans(samples.frames) == 1
    assert (found[behind] == 0.0).all() or given
    for number in range(len(values)):
        if given and 2 <= number < 7:  # the lens stays
            continue
        step = np.zeros(len(values))
        step[number] = 1e-6
        more, less = (
            bundle.residuals(state._replace(values=values + way * step), samples, 3.0) for way in (1, -1)
        )
        np.testing.assert_allclose(found[:, number], (more - less) / 2e-6, rtol=1e-4, atol=2e-3)


def test_a_camera_that_no_edge_agrees_with_stays_where_it_is():
    take, filming = moving_take(), Filming(seed=1, seconds=6.0)
    bundle = Bundle(take, Detections.of(filming.found(take)), SIZE, None)
    values = np.zeros(POSES + 6)
    values[OFFSET], values[POSES:] = filming.offset, pose_of(filming.cameras()[0])
    none, flat = np.zeros((0, 3)), np.zeros((0, 2))
    samples = Samples(np.zeros(0, int), flat, flat, none, none, lambda times: none)
    state, cost, _ = bundle.solve(State(values, (0,)), samples, 2.0, first=True)
    np.testing.assert_allclose(state.values[POSES:], values[POSES:])
    assert cost >= 0.0
