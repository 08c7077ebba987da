"""Weights and cards that are damaged: one sentence each, and nothing allocated for them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from handsim.errors import WeightsError
from train.glove_labeler import load_labeler
from train.labelers.storage import (
    _SHIPPED,
    CARD,
    WEIGHTS,
    load_network,
    save_network,
    weights_metadata,
)

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
    assert load_labeler(tmp_path).prior is None


def header(content: bytes) -> dict:
    """A safetensors file's header by its published layout: its length, then JSON."""
    length = int.from_bytes(content[:8], "little")
    assert length % 8 == 0  # so that tensors are aligned
    return json.loads(content[8 : 8 + length])


@pytest.mark.parametrize("glove", ["dense19", "sparse13"])
def test_shipped_weights_tell_of_themselves(glove):
    card = json.loads((_SHIPPED / f"{glove}.json").read_text())
    told = header((_SHIPPED / f"{glove}.safetensors").read_bytes())["__metadata__"]
    assert told == weights_metadata(card)
    assert told["format"] == "pt"
    assert told["license"] == "apache-2.0"
    assert told["layout"] == glove
    assert json.loads(told["marker_names"]) == card["marker_names"]
    assert told["trained_on"] == "simulated frames only"
    assert told["handsim_version"] == card["handsim"]


def test_saved_weights_are_the_networks_and_the_same_bytes_each_time(tmp_path):
    network, card = load_network("dense19")
    for folder in ("one", "other"):
        save_network(tmp_path / folder, network, card)
    content = (tmp_path / "one" / WEIGHTS).read_bytes()
    assert content == (tmp_path / "other" / WEIGHTS).read_bytes()
    assert next(iter(header(content))) == "__metadata__"
    tensors, shipped = load_file(tmp_path / "one" / WEIGHTS), load_file(_SHIPPED / "dense19.safetensors")
    assert tensors.keys() == shipped.keys()
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(tensor, shipped[name])
        assert tensor.dtype == shipped[name].dtype


def test_names_beyond_ascii_and_cards_that_say_little(tmp_path):
    network, _ = load_network("dense19")
    names = [f"Märker{number}" for number in range(19)]
    save_network(tmp_path, network, {"marker_names": names})
    told = header((tmp_path / WEIGHTS).read_bytes())["__metadata__"]
    assert json.loads(told["marker_names"]) == names
    assert "license" not in told
    assert load_labeler(tmp_path).marker_names == tuple(names)
