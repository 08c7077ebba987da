"""The labeler for any layout, at once and after a minute of learning."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest
import torch

from gloves import load_layout
from handsim.cli.doctor import check_learned_gloves
from handsim.errors import HandSimWarning, WeightsError
from tests.programs import run_python
from train import Corruption, evaluate_labeler
from train.labelers import layout_labeler
from train.labelers.layout_labeler import (
    LayoutLabeler,
    fine_tuned_labeler,
    is_learned,
    learned_labeler,
    mean_features,
    sample_worn_markers,
    shipped_network,
)
from train.labelers.networks import LayoutNetworkConfig as Config
from train.labelers.networks import distance_features
from train.labelers.protocol import learned_folder, learned_gloves

pytestmark = pytest.mark.usefixtures("own_cache")
CLOUD = np.random.default_rng(0).normal(0, 0.05, (8, 3))


@pytest.fixture(scope="module")
def labeler():
    return LayoutLabeler.at_once(load_layout("starter15"), num_poses=8000)


@pytest.mark.parametrize(("corruption", "least"), [(Corruption(0, 0), 0.93), (Corruption(4, 2), 0.80)])
def test_a_glove_of_no_training_is_labeled(labeler, corruption, least):
    markers = sample_worn_markers(load_layout("starter15"), 300, rng=np.random.default_rng(5))
    report = evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(6))
    assert report.figures["slot_accuracy"] > least


def test_features_are_means_over_all_poses():
    markers, config = (
        sample_worn_markers(load_layout("starter6"), 1200, rng=np.random.default_rng(3)),
        Config(),
    )
    points = torch.from_numpy(markers - markers.mean(axis=1, keepdims=True)).float()
    expected = distance_features(points, config).double().mean(0)
    np.testing.assert_allclose(mean_features(markers, config), expected, atol=1e-5)


@pytest.mark.slow
def test_features_of_a_large_glove_keep_little_memory():
    """Peak memory grew with the number of poses when small sums lay between large freed tensors."""
    program = """
import resource
import numpy as np
from train.labelers.layout_labeler import mean_features
from train.labelers.networks import LayoutNetworkConfig
markers = np.random.default_rng(0).normal(0.0, 0.05, (40_000, 60, 3))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
mean_features(markers, LayoutNetworkConfig())
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    assert int(run_python(program).stdout) < 600_000  # kilobytes


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


def test_a_damaged_network_is_told(tmp_path, monkeypatch):
    shutil.copytree(layout_labeler.SHIPPED, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(layout_labeler, "SHIPPED", tmp_path)
    shipped_network.cache_clear()
    try:
        assert shipped_network().state_dict()
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


def never(*_args, **_options):
    raise AssertionError("it was learned again")


def test_a_glove_is_learned_once(quickly_learned, tmp_path, monkeypatch):
    shipped = load_layout("starter6")
    third = dataclasses.replace(shipped.markers[0], along=1 / 3)  # more decimals than a file has
    layout = dataclasses.replace(shipped, markers=(third, *shipped.markers[1:]))
    layout.save(tmp_path / "third.toml")
    assert not is_learned(layout)
    first = learned_labeler(layout)
    assert is_learned(layout) and len(learned_gloves()) == 1
    monkeypatch.setattr(layout_labeler, "fine_tuned_labeler", never)
    again = learned_labeler(load_layout(tmp_path / "third.toml"))
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
    monkeypatch.setattr(layout_labeler, "MAX_KEPT", 1)
    for name in ("starter6", "tips8"):
        learned_labeler(load_layout(name))
    assert not is_learned(load_layout("starter6")) and is_learned(load_layout("tips8"))


def test_a_cache_that_cannot_be_written_costs_no_labels_and_is_told(quickly_learned, monkeypatch, tmp_path):
    assert not check_learned_gloves().remedy
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(HandSimWarning, match=r"glove 'starter6' cannot be kept in .*file.*XDG_CACHE_HOME"):
        learned = learned_labeler(load_layout("starter6"))
    assert learned.label_frames([CLOUD])[0].labels.shape == (8,)
    assert "XDG_CACHE_HOME" in check_learned_gloves().remedy


@pytest.mark.slow
def test_a_glove_of_tips_is_labeled_better_after_some_steps():
    layout = load_layout("tips8")
    markers = sample_worn_markers(layout, 600, rng=np.random.default_rng(1))
    shipped = {name: value.clone() for name, value in shipped_network().state_dict().items()}
    fresh = LayoutLabeler.at_once(layout)
    tuned = fine_tuned_labeler(layout, num_clouds=4000)
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
