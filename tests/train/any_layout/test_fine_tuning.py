"""The network for any layout learns one layout in a few hundred steps."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.layout import load_layout
from train.any_layout.fine_tuning import fine_tuned_labeler
from train.any_layout.layout_labeler import LayoutLabeler, shipped_network
from train.any_layout.worn_markers import sample_worn_markers
from train.data.augmentation import Corruption
from train.evaluate import evaluate_labeler


@pytest.mark.slow
def test_a_glove_of_tips_is_labeled_better_after_some_steps():
    layout = load_layout("tips8")
    markers = sample_worn_markers(layout, 300, rng=np.random.default_rng(1))
    shipped = {name: value.clone() for name, value in shipped_network().state_dict().items()}
    fresh = LayoutLabeler.at_once(layout)
    tuned = fine_tuned_labeler(layout, num_clouds=2000)
    right = [
        evaluate_labeler(one, markers, Corruption(2, 2), rng=np.random.default_rng(2)).figures[
            "slot_accuracy"
        ]
        for one in (fresh, tuned)
    ]
    assert right[1] > right[0] + 0.02
    for name, value in shipped_network().state_dict().items():  # the shipped network stays as it is
        assert value.equal(shipped[name])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_labeler():
    layout = load_layout("starter6")
    one, other = (fine_tuned_labeler(layout, num_clouds=192, seed=3) for _ in range(2))
    for name, value in one.network.state_dict().items():
        assert value.equal(other.network.state_dict()[name])
