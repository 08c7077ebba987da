"""The labeler that needs no training, on gloves that it has never seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.layout import load_layout
from handsim.errors import HandSimWarning, WeightsError
from train.any_layout import layout_labeler
from train.any_layout.layout_labeler import (
    LayoutLabeler,
    sample_worn_markers,
    save_layout_network,
    shipped_network,
)
from train.data.batches import Corruption
from train.evaluate import evaluate_labeler
from train.glove_labeler import load_labeler
from train.labelers.storage import shipped_labelers


@pytest.fixture(scope="module")
def labeler():
    return LayoutLabeler.at_once(load_layout("starter15"), num_poses=8000)


@pytest.mark.parametrize(("corruption", "least"), [(Corruption(0, 0), 0.93), (Corruption(4, 2), 0.80)])
def test_a_glove_of_no_training_is_labeled(labeler, corruption, least):
    markers = sample_worn_markers(load_layout("starter15"), 300, rng=np.random.default_rng(5))
    report = evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(6))
    assert report.figures["slot_accuracy"] > least


def test_labels_follow_the_order_of_the_layout(labeler):
    """The same glove with its markers listed backwards: the same names."""
    layout = load_layout("starter15")
    backwards = dataclasses.replace(layout, markers=layout.markers[::-1])
    other = LayoutLabeler.at_once(backwards, num_poses=8000)
    assert other.marker_names == layout.names[::-1]
    clouds = list(sample_worn_markers(layout, 60, rng=np.random.default_rng(7)))
    names = [
        [known.marker_names[label] if label >= 0 else None for label in labeling.labels]
        for known in (labeler, other)
        for labeling in known.label_frames(clouds)
    ]
    equal = np.array(names[:60]) == np.array(names[60:])
    assert equal.mean() > 0.97  # the two know the layout from other poses


def test_a_glove_without_a_labeler_is_labeled_and_that_is_told(tmp_path, quickly_learned):
    layout = load_layout("starter6")
    layout.save(tmp_path / "mine.toml")
    with pytest.warns(HandSimWarning, match="no labeler was trained on glove .*mine.toml"):
        found = load_labeler(str(tmp_path / "mine.toml"), None)
    assert isinstance(found, LayoutLabeler) and found.marker_names == layout.names
    assert "any_layout" not in shipped_labelers()


def test_the_network_is_saved_and_read_again(tmp_path, monkeypatch):
    network = shipped_network()
    save_layout_network(tmp_path, network, 1)
    monkeypatch.setattr(layout_labeler, "SHIPPED", tmp_path)
    shipped_network.cache_clear()
    try:
        for name, tensor in shipped_network().state_dict().items():
            assert np.array_equal(tensor.numpy(), network.state_dict()[name].numpy()), name
        (tmp_path / layout_labeler.WEIGHTS).write_bytes(b"nothing")
        shipped_network.cache_clear()
        with pytest.raises(WeightsError, match="missing or damaged"):
            shipped_network()
    finally:
        shipped_network.cache_clear()


def test_the_back_of_the_hand_is_rigid_and_fingers_bend():
    layout = load_layout("starter10")
    markers = sample_worn_markers(layout, 250, rng=np.random.default_rng(0))
    assert markers.shape == (250, 10, 3) and np.isfinite(markers).all()
    back, tip = layout.names.index("BackHand1"), layout.names.index("MiddleTip")
    second = layout.names.index("BackHand2")
    for person in range(0, 200, 100):
        rows = markers[person : person + 100]
        assert np.linalg.norm(rows[:, back] - rows[:, second], axis=1).std() < 2e-3
        assert np.linalg.norm(rows[:, back] - rows[:, tip], axis=1).std() > 1e-2
    firsts = np.linalg.norm(markers[[0, 100, 200], back] - markers[[0, 100, 200], second], axis=1)
    assert len(np.unique(firsts.round(5))) == 3  # three people


def test_the_same_seed_gives_the_same_markers():
    layout = load_layout("tips8")
    one, two = (sample_worn_markers(layout, 30, rng=np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one, two)
