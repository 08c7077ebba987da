"""The labeler that comes with the package, on simulated and on real marker data."""

from __future__ import annotations

import json
from importlib import resources

import pytest

from gloves import load_layout
from gloves.captures.formats import read_markers
from handsim.errors import WeightsError
from train import Corruption, evaluate_labeler, load_labeler
from train.labelers.storage import shipped_labelers


def test_cards_say_where_the_weights_come_from():
    for name in shipped_labelers():
        folder = resources.files("train").joinpath("weights")
        card = json.loads(folder.joinpath(f"{name}.json").read_text())
        assert card["trained_on"] == "simulated frames only"
        assert tuple(card["marker_names"]) == load_layout(name).names
        assert card["dataset"]["glove"] == name
        assert len(folder.joinpath(f"{name}.safetensors").read_bytes()) < 5_000_000


@pytest.mark.parametrize(("corruption", "least"), [(Corruption(0, 0), 0.985), (Corruption(), 0.92)])
def test_real_people_are_labeled(sig18, corruption, least, rng):
    labeler = load_labeler("dense19")
    files = sorted(sig18.rglob("*.trc"))
    chosen = rng.choice(len(files), size=40, replace=False)
    markers = read_markers([files[number] for number in chosen], labeler.marker_names)
    frames = markers[rng.choice(len(markers), size=min(2000, len(markers)), replace=False)]
    assert evaluate_labeler(labeler, frames, corruption, rng=rng).figures["slot_accuracy"] >= least


def test_damaged_weights_are_told(tmp_path):
    folder = resources.files("train").joinpath("weights")
    (tmp_path / "labeler.json").write_bytes(folder.joinpath("dense19.json").read_bytes())
    (tmp_path / "labeler.safetensors").write_bytes(folder.joinpath("dense19.safetensors").read_bytes()[:-100])
    with pytest.raises(WeightsError, match=r"labeler\.safetensors is damaged or not a labeler's"):
        load_labeler(tmp_path)
