"""The search for a better layout: its own measure rises, and what is to be kept is kept."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.layout import MarkerLayout, MarkerPlace, load_layout
from handsim.errors import LayoutError
from handsim.space.cameras import load_rig
from track.glove_advice import improvement
from track.glove_advice.improvement import Improvement


@pytest.fixture(autouse=True)
def few_people(monkeypatch):
    monkeypatch.setattr(improvement, "_PEOPLE", 8)
    monkeypatch.setattr(improvement, "_POSES_EACH", 12)


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


def test_wrong_names_and_too_many_to_keep_are_refused():
    layout = load_layout("starter6")
    with pytest.raises(LayoutError, match="to be kept are Tail, expected markers of the layout: BackHand1"):
        search_of(layout, keep=("Tail",))
    with pytest.raises(LayoutError, match="all 6 markers are to be kept"):
        search_of(layout, keep=layout.names).resize(5)
