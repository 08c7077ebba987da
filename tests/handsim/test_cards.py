"""What notebooks show of takes, layouts, rigs and training sets: small, self-contained, true."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

import train
from gloves import attach, load_layout
from gloves.takes.take import Take
from handsim import HandModel, load_rig
from handsim.cards import card, map_drawing, share_drawing, span_drawing
from tests.programs import run_python

THINGS = {
    "take": lambda: take_of("right"),
    "take of two hands": lambda: take_of("right", "left"),
    "layout": lambda: load_layout("dense19"),
    "layout of six": lambda: load_layout("starter6"),
    "rig": lambda: load_rig("figure5"),
    "rig of six": lambda: load_rig("six"),
}


@pytest.fixture(scope="module")
def training_set(tmp_path_factory):
    return train.generate_dataset(tmp_path_factory.mktemp("set"), glove="sparse13", num_frames=40, workers=1)


def take_of(*sides: str) -> Take:
    hands = [attach(load_layout("sparse13"), HandModel.named("M", side=side)) for side in sides]
    return Take.of_poses(hands, np.tile(np.eye(1, 27, 3)[:, None], (6, len(hands), 1)), rate=100.0)


def checked(html: str) -> ET.Element:
    """The card as XML, which loads nothing and runs nothing, its shapes within the drawing."""
    assert len(html) < 20_000
    root = ET.fromstring(html)
    assert {one.tag.rpartition("}")[2] for one in root.iter()} <= {
        "div", "b", "table", "tr", "td", "svg", "rect", "text", "circle", "title", "polyline",
    }  # fmt: skip
    (drawing,) = (one for one in root if one.tag.endswith("svg"))
    width, height = (float(drawing.attrib[key]) for key in ("width", "height"))
    for shape in drawing:
        numbers = {
            key: float(shape.attrib[key])
            for key in ("x", "y", "cx", "cy", "width", "height")
            if key in shape.attrib
        }
        assert 0 <= numbers.get("cx", 0) <= width and 0 <= numbers.get("cy", 0) <= height
        assert 0 <= numbers.get("x", 0) + numbers.get("width", 0) <= width + 0.1
        assert 0 <= numbers.get("y", 0) + numbers.get("height", 0) <= height
    return root


@pytest.mark.parametrize("name", THINGS)
def test_a_card_is_small_and_self_contained(name):
    checked(THINGS[name]()._repr_html_())


def test_a_layout_shows_every_marker():
    layout = load_layout("dense19")
    root = checked(layout._repr_html_())
    assert [one.text for one in root.iter() if one.tag.endswith("title")] == list(layout.names)


def test_a_set_shows_how_often_each_marker_is_seen(training_set):
    root = checked(training_set._repr_html_())
    texts = [one.text for one in root.iter() if one.tag.endswith("text")]
    seen = np.isfinite(training_set.rows()["observed"]).all(axis=-1).mean(axis=0)
    assert texts == [
        f"{name} {100 * one:.1f} %" for name, one in zip(training_set.marker_names, seen, strict=True)
    ]


def test_spans_are_those_of_the_frames():
    present = np.array([True, True, False, False, True])
    boxes = [
        one for one in checked(card("a", {}, span_drawing({"x": present}))).iter() if one.tag.endswith("rect")
    ]
    assert [float(one.attrib["width"]) for one in boxes] == [220.0, 88.0, 44.0]


@pytest.mark.parametrize("name", ["<script>", 'a"b', "a & b", "Ä"])
def test_names_are_no_markup(name):
    drawing = map_drawing(np.zeros((1, 2)), [name])
    root = checked(card(name, {name: name}, drawing))
    assert root[0].text == name and next(one for one in root.iter() if one.tag.endswith("title")).text == name
    checked(card("a", {}, share_drawing({name: 0.5})))


def test_importing_the_cards_loads_no_matplotlib():
    code = "import sys, handsim.cards; print('matplotlib' in sys.modules)"
    assert run_python(code).stdout == "False\n"
