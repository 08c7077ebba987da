"""Hands in gloves, followed for a while, and frames of their points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos
from handsim.hand.shape import Side
from poses.shapes import resting_angles
from track.association.frame_state import FrameState, Numbering
from track.association.hand_state import HandState

RATE = 120.0
Followed = Callable[..., HandState]


@pytest.fixture
def followed() -> Followed:
    """Makes a hand that was followed at rest for half a second, its markers 1 mm off at random."""

    def make(
        side: Side = "right", place: tuple[float, float, float] = (0.0, 0.0, 0.0), off: object = 0.0
    ) -> HandState:
        """`off` (19, 3) [m] is where the markers of the glove as worn are beside the designed ones."""
        user = nominal_fit(load_layout("dense19"), "M", side)
        state, rng = HandState(user), np.random.default_rng(0)
        qpos = join_qpos(resting_angles(user.model)[None], position=np.array([place]))[0]
        target = state.solver.marker_positions(qpos) + off
        state.initialize(qpos, target, 0.0)
        for frame in range(1, 60):
            prediction = state.predict(frame / RATE)
            seen = target + 0.001 * rng.standard_normal(target.shape)
            state.update(state.fit(seen, prediction.qpos, prediction), np.ones(19, dtype=bool), frame / RATE)
        return state

    return make


@pytest.fixture
def frame_of() -> Callable[..., FrameState]:
    """Makes a frame of points whose labels have some evidence."""

    def make(
        points, labels, time, *, hands=1, evidence=0.0, first_seen=0.0, free_since=None, ids=None
    ) -> FrameState:
        count = len(points)
        numbers = np.arange(count) if ids is None else ids
        evidences, seen = np.full(count, evidence), np.full(count, first_seen)
        free = np.full(count, time if free_since is None else free_since)
        return FrameState(
            points,
            numbers,
            np.asarray(labels),
            evidences,
            np.ones(count),
            seen,
            free,
            time,
            Numbering([19] * hands),
        )

    return make
