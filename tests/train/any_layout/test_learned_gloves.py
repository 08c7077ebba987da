"""A glove is learned once: kept, read again, learned anew where the file is damaged, and not kept forever."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves.layout import load_layout
from train.any_layout import learned_gloves
from train.any_layout.layout_labeler import LayoutLabeler, sample_worn_markers, shipped_network
from train.any_layout.learned_gloves import fine_tuned_labeler, is_learned, learned_labeler
from train.data.batches import Corruption
from train.evaluate import evaluate_labeler
from train.labelers.storage import learned_folder

pytestmark = pytest.mark.usefixtures("own_cache")
CLOUD = np.random.default_rng(0).normal(0, 0.05, (8, 3))


def never(*_args, **_options):
    raise AssertionError("it was learned again")


def test_a_glove_is_learned_once(quickly_learned, monkeypatch):
    layout = load_layout("starter6")
    assert not is_learned(layout)
    first = learned_labeler(layout)
    assert is_learned(layout) and len(learned_gloves.learned_gloves()) == 1
    monkeypatch.setattr(learned_gloves, "fine_tuned_labeler", never)
    again = learned_labeler(layout)
    for one, other in zip(first.label_frames([CLOUD]), again.label_frames([CLOUD]), strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.confidence, other.confidence)
    moved = dataclasses.replace(layout.markers[0], along=layout.markers[0].along + 0.05)
    assert not is_learned(dataclasses.replace(layout, markers=(moved, *layout.markers[1:])))


@pytest.mark.slow
def test_a_damaged_file_is_learned_anew(quickly_learned):
    layout = load_layout("starter6")
    learned_labeler(layout)
    (file,) = learned_folder().iterdir()
    file.write_bytes(b"nothing")
    assert learned_labeler(layout).label_frames([CLOUD])[0].labels.shape == (8,)
    assert len(file.read_bytes()) > 1000


@pytest.mark.slow
def test_the_least_recently_used_go(quickly_learned, monkeypatch):
    monkeypatch.setattr(learned_gloves, "MOST", 1)
    for name in ("starter6", "tips8"):
        learned_labeler(load_layout(name))
    assert not is_learned(load_layout("starter6")) and is_learned(load_layout("tips8"))


def test_a_cache_that_cannot_be_written_costs_no_labels(quickly_learned, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert learned_labeler(load_layout("starter6")).label_frames([CLOUD])[0].labels.shape == (8,)


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
def test_the_same_seed_gives_the_same_labeler(quickly_learned):
    layout = load_layout("starter6")
    one, other = (fine_tuned_labeler(layout, num_clouds=192, seed=3) for _ in range(2))
    for name, value in one.network.state_dict().items():
        assert value.equal(other.network.state_dict()[name])
