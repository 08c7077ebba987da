"""Weights and cards that are damaged: one sentence each, and nothing allocated for them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from handsim.errors import WeightsError
from train.labelers.storage import _SHIPPED, CARD, WEIGHTS, load_labeler

SHIPPED = json.loads((_SHIPPED / "dense19.json").read_text())
NETWORK = SHIPPED["network"]
CARDS = {
    "no names": {key: value for key, value in SHIPPED.items() if key != "marker_names"},
    "a number for names": SHIPPED | {"marker_names": 5},
    "a name twice": SHIPPED | {"marker_names": ["a"] * 19},
    "too few names": SHIPPED | {"marker_names": ["a"]},
    "a list": [1],
    "a list of settings": SHIPPED | {"network": [1]},
    "no width": SHIPPED | {"network": NETWORK | {"width": 0}},
    "text for a number": SHIPPED | {"network": NETWORK | {"reach": "far"}},
    "NaN": SHIPPED | {"network": NETWORK | {"reach": float("nan")}},
    "a network beyond any memory": SHIPPED | {"network": NETWORK | {"width": 4096, "depth": 100}},
    "an unknown kind": SHIPPED | {"labeler": "graph"},
    "a list for a kind": SHIPPED | {"labeler": []},
}


def write(folder, card, tensors=None):
    (folder / CARD).write_text(card if isinstance(card, str) else json.dumps(card))
    save_file(tensors or load_file(_SHIPPED / "dense19.safetensors"), folder / WEIGHTS)


@pytest.mark.parametrize("name", CARDS)
def test_a_card_that_is_none_is_told(tmp_path, name):
    write(tmp_path, CARDS[name])
    with pytest.raises(WeightsError, match=r"damaged or not a labeler's|names 1 markers for 19 labels"):
        load_labeler(tmp_path)


def test_a_card_nested_without_end_is_told(tmp_path):
    write(tmp_path, "[" * 200_000)
    with pytest.raises(WeightsError, match="is damaged or not a labeler's"):
        load_labeler(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_no_numbers_are_told(tmp_path, value):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    name = sorted(tensors)[0]
    tensors[name] = tensors[name].copy()
    tensors[name].flat[0] = value
    write(tmp_path, SHIPPED, tensors)
    with pytest.raises(WeightsError, match=f"is damaged: {name} holds NaN or infinite values"):
        load_labeler(tmp_path)


def test_a_lost_tensor_is_told(tmp_path):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    del tensors[sorted(tensors)[0]]
    write(tmp_path, SHIPPED, tensors)
    with pytest.raises(WeightsError, match="is damaged or not a labeler's"):
        load_labeler(tmp_path)


def test_a_pose_prior_of_another_glove_is_told(tmp_path):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    others = load_file(_SHIPPED / "sparse13.safetensors")
    priors = {name: table for name, table in others.items() if name.startswith("pose_prior.")}
    write(tmp_path, SHIPPED, tensors | priors)
    with pytest.raises(WeightsError, match="pose prior has 13 markers for 19 labels"):
        load_labeler(tmp_path)


def test_weights_without_a_pose_prior_are_read(tmp_path):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    write(tmp_path, SHIPPED, {name: one for name, one in tensors.items() if "pose_prior" not in name})
    assert load_labeler(tmp_path).network.prior is None
