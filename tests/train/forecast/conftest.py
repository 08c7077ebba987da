"""Hands at work for a short while, as a rig sees them."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import load_layout
from handsim import load_rig
from handsim.space.rig import ROOM_CENTER
from train.forecast.rig_forecast import light_work, sample_work

SIDES = np.full(3, 0.6)


@pytest.fixture(scope="session")
def work():
    rng = np.random.default_rng(0)
    found = sample_work(load_layout("tips8"), np.array(ROOM_CENTER), SIDES, 120, 1, rng=rng)
    return [scene for scenes in found.values() for scene in scenes]


@pytest.fixture(scope="session")
def six_lit(work):
    return light_work({"calibration": work}, load_rig("six"), rng=np.random.default_rng(1))["calibration"]
