"""One function gives every labeler: of a glove as an object, a name or a path, and of everything else."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from gloves.layout import MarkerLayout, MarkerPlace, load_layout
from handsim.errors import ArgumentError, HandSimWarning, LayoutError, WeightsError
from handsim.hand.shape import DIGITS
from train.any_layout.layout_labeler import LayoutLabeler
from train.glove_labeler import load_labeler
from train.labelers.protocol import OwnLabeler
from train.labelers.set_inference import TrainedSetLabeler


class First:
    """The first point is the first marker, the others are ghosts."""

    marker_names = load_layout("tips8").names

    def label_frames(self, frames):
        labels = [np.where(np.arange(len(one)) == 0, 0, -1) for one in frames]
        return [SimpleNamespace(labels=one, confidence=np.ones(len(one))) for one in labels]


def test_a_layout_that_is_a_shipped_one_has_its_labeler(tmp_path):
    layout = load_layout("dense19")
    layout.save(tmp_path / "mine.toml")
    for glove in ("dense19", layout, tmp_path / "mine.toml", str(tmp_path / "mine.toml")):
        found = load_labeler(glove)
        assert isinstance(found, TrainedSetLabeler) and found.marker_names == layout.names


@pytest.mark.parametrize("given", ["name", "object", "path"])
def test_any_other_layout_is_learned_and_that_is_told(given, quickly_learned, tmp_path):
    layout = dataclasses.replace(load_layout("tips8"), name="mine")
    layout.save(tmp_path / "mine.toml")
    glove = {"name": "tips8", "object": layout, "path": tmp_path / "mine.toml"}[given]
    with pytest.warns(HandSimWarning, match="no labeler was trained on glove"):
        found = load_labeler(glove)
    assert isinstance(found, LayoutLabeler) and found.marker_names == layout.names
    labeling = found.label_frames([np.random.default_rng(0).normal(0, 0.05, (6, 3))])[0]
    assert labeling.labels.shape == (6,)


def test_a_glove_like_its_own_mirror_image_is_told(quickly_learned):
    fingers = [MarkerPlace(digit, f"{digit}_distal", 0.7, 0.0) for digit in DIGITS[1:]]
    places = [(along, across) for along in (0.3, 0.7) for across in (0.2, -0.2)]
    back = [MarkerPlace(f"{place}", "palm", place[0], 0.0, place[1]) for place in places]
    with pytest.warns(HandSimWarning, match="glove 'even' is nearly its own mirror image"):
        load_labeler(MarkerLayout("even", (*fingers, *back), 0.0032))
    with pytest.warns(HandSimWarning) as told:
        load_labeler("tips8")
    assert not any("mirror image" in str(one.message) for one in told)


def test_a_layout_of_the_same_name_and_other_places_is_another(quickly_learned):
    layout = load_layout("sparse13")
    moved = dataclasses.replace(layout.markers[0], along=layout.markers[0].along + 0.1)
    with pytest.warns(HandSimWarning, match="'sparse13'"):
        found = load_labeler(dataclasses.replace(layout, markers=(moved, *layout.markers[1:])))
    assert isinstance(found, LayoutLabeler)


def test_any_layout_needs_a_glove(quickly_learned):
    with pytest.raises(ArgumentError, match="'any-layout' needs a glove, expected load_labeler"):
        load_labeler("any-layout")
    assert isinstance(load_labeler("tips8", "any-layout"), LayoutLabeler)


def test_an_object_is_a_labeler_behind_checks():
    found = load_labeler(First())
    assert isinstance(found, OwnLabeler)
    assert found.label_frames([np.zeros((2, 3))])[0].labels.tolist() == [0, -1]
    assert load_labeler("tips8", First()).marker_names == First.marker_names
    shipped = load_labeler("dense19")
    assert load_labeler(shipped) is shipped
    with pytest.raises(WeightsError, match=r"the labeler knows markers .*, but glove 'dense19' has"):
        load_labeler("dense19", First())


@pytest.mark.parametrize("wrong", [5, None, [], 2.5, First])
def test_anything_else_is_told(wrong):
    with pytest.raises(ArgumentError, match=r"^labeler is .*, expected a MarkerLayout, the name or path of"):
        load_labeler(wrong)
    with pytest.raises(ArgumentError, match=r"^glove is"):
        load_labeler(wrong, "dense19")


def test_an_unknown_name_is_told():
    with pytest.raises(WeightsError, match=r"unknown labeler or glove 'dense18' \(did you mean 'dense19'"):
        load_labeler("dense18")
    with pytest.raises(LayoutError, match="unknown glove 'dense18'"):
        load_labeler("dense18", "dense19")
