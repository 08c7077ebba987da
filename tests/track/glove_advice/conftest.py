"""A glove on a few hands, and a labeler of it."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.layout import load_layout
from handsim.space.rig import load_rig
from track.glove_advice.layout_score import score_layout
from track.glove_advice.observed_hands import observe_poses
from train.labelers.layout_labeler import LayoutLabeler


@pytest.fixture(scope="session")
def tips():
    return load_layout("tips8")


@pytest.fixture(scope="session")
def tips_hands(tips):
    return observe_poses(tips, load_rig("six"), 240, rng=np.random.default_rng(0))


@pytest.fixture(scope="session")
def tips_score(tips, tips_hands):
    labeler = LayoutLabeler.at_once(tips, num_poses=2000)
    return score_layout(tips, tips_hands, labeler, rng=np.random.default_rng(1))
