"""The search for a better layout: its own measure rises, and what is to be kept is kept."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import MarkerLayout, MarkerPlace, load_layout
from handsim import HandModel, load_rig
from handsim.errors import LayoutError
from handsim.hand.shape import BONE_NAMES
from track.gloves import glove_improvement
from track.gloves.glove_improvement import Improvement, sample_places
from track.gloves.glove_score import palm_spread


@pytest.fixture(autouse=True)
def few_people(monkeypatch):
    monkeypatch.setattr(glove_improvement, "_PEOPLE", 8)
    monkeypatch.setattr(glove_improvement, "_POSES_EACH", 12)


def hopeless() -> MarkerLayout:
    """Six markers in a row on the palm."""
    places = [MarkerPlace(f"P{n}", "palm", 0.1 + 0.15 * n, 0.0, 0.0) for n in range(6)]
    return MarkerLayout("hopeless", tuple(places), 0.003)


def search_of(layout, keep=(), seed=0):
    return Improvement(layout, load_rig("figure5"), keep, rng=np.random.default_rng(seed))


@pytest.mark.slow
def test_a_hopeless_layout_gets_better_and_keeps_what_it_shall():
    search = search_of(hopeless(), keep=("P2",))
    before, steps = search.worth, []
    search.search(12.0, steps.append)
    costs = [before.cost, *(worth.cost for worth in steps)]
    assert costs == sorted(costs, reverse=True) and costs[-1] < costs[0] - 10.0
    assert hopeless().markers[2] in search.layout.markers
    assert len(set(search.layout.names)) == 6


def test_markers_are_added_and_dropped():
    layout = load_layout("starter10")
    search = search_of(layout, keep=("IndexTip",))
    search.resize(8)
    assert len(search.layout.markers) == 8
    assert set(search.layout.names) < set(layout.names) and "IndexTip" in search.layout.names
    smaller = search.smaller(6)
    assert [count for count, _ in smaller] == [7, 6] and len(search.layout.markers) == 8
    search.resize(9)
    assert len(search.layout.markers) == 9


def test_places_are_found_with_a_ruler_and_names_say_the_bone():
    layout = load_layout("tips8")
    search = search_of(layout)
    search.resize(9)
    search.search(2.0, lambda worth: None)
    found, old = search.layout, {marker.name: marker for marker in layout.markers}
    model = HandModel.named("M")
    for marker in found.markers:
        if marker == old.get(marker.name):
            continue
        for value, step in ((marker.along, 0.05), (np.rad2deg(marker.around), 15.0), (marker.across, 0.05)):
            assert value / step == pytest.approx(round(value / step), abs=1e-3)
        if marker.name in old:
            assert marker.bone == old[marker.name].bone
        else:
            assert marker.name.lower().startswith(marker.bone.replace("_", ""))
        if marker.bone != "palm":
            length = model.skeleton.lengths[BONE_NAMES.index(marker.bone)]
            assert marker.along * length >= 0.005
            assert marker.bone.endswith("distal") or (1.0 - marker.along) * length >= 0.005


def test_a_search_keeps_every_digit_no_crowd_and_the_palm():
    layout = load_layout("tips8")
    search, places = search_of(layout), layout.markers
    assert search.is_wearable(places)
    assert not search.is_wearable(places[1:])  # the thumb has none
    assert not search.is_wearable(places[:-1])  # two on the palm
    second = dataclasses.replace(places[1], name="second", along=0.3)
    assert not search.is_wearable((*places, second))
    in_line = [dataclasses.replace(one, across=0.0, along=0.1 * n) for n, one in enumerate(places[-3:], 2)]
    assert not search.is_wearable((*places[:-3], *in_line))


def test_the_palms_rotation_is_told_by_a_triangle():
    model = HandModel.named("M")
    places = load_layout("tips8").markers
    spread = palm_spread(places, model)
    assert np.deg2rad(1.0) < spread < np.deg2rad(4.0)
    assert palm_spread(load_layout("starter30").markers, model) < spread
    assert palm_spread(places[:-1], model) == np.inf


def test_wrong_names_and_too_many_to_keep_are_refused():
    layout = load_layout("starter6")
    with pytest.raises(LayoutError, match="to be kept are Tail, expected markers of the layout: BackHand1"):
        search_of(layout, keep=("Tail",))
    with pytest.raises(LayoutError, match="all 6 markers are to be kept"):
        search_of(layout, keep=layout.names).resize(5)


def test_the_palm_has_more_places_than_a_finger(rng):
    bones = [place.bone for place in sample_places(150, rng=rng)]
    assert bones.count("palm") > 2 * bones.count("index_middle")


def test_places_that_do_not_fit_are_left_out() -> None:
    places = sample_places(60, rng=np.random.default_rng(0), apart=0.03)
    assert 5 <= len(places) < 60
