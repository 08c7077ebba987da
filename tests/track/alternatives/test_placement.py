"""A hand fitted with free places of its markers: what places cost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import mean_hand
from track.alternatives.placement import place_markers
from train import simulate_take

TURN = 0.8  # [rad] how far a moved marker is turned about its bone


def cost(names: list[str]) -> float:
    """Cost of the places in a capture of a hand that wears some markers turned about their bones."""
    layout = load_layout("dense19")
    places = [
        dataclasses.replace(one, around=one.around + TURN) if one.name in names else one
        for one in layout.markers
    ]
    worn = dataclasses.replace(layout, markers=tuple(places))
    take = simulate_take("single-hand", glove=worn, hands=("right",), num_frames=60, seed=5).without_body()
    shape, seen = take.hands[0].shape, take.observed(range(layout.num_markers))
    there = np.flatnonzero(np.isfinite(seen[..., 0]).all(axis=1))[::6]
    return place_markers(seen[there], mean_hand(shape.length, shape.breadth, layout)).cost


@pytest.mark.parametrize("digit", ["Thumb", "Index", "Ring"])
def test_an_offset_that_neighbors_share_costs_little_more_than_one(digit):
    names = [name for name in load_layout("dense19").names if name.startswith(digit)]
    assert cost(names) < cost(names[-1:]) + 2.0
