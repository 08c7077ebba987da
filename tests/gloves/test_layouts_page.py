"""docs/layouts.md lists the shipped layouts as they are."""

from __future__ import annotations

import re
from pathlib import Path

from gloves import load_layout
from gloves.layout import list_layouts, parse_layout

PAGE = (Path(__file__).parents[2] / "docs" / "layouts.md").read_text("utf-8")


def test_every_shipped_layout_has_its_row():
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| ([\d.]+) \| .+ \| (.+) \|$", PAGE, re.M)
    assert sorted(name for name, *_ in rows) == sorted(list_layouts())
    for name, markers, radius, _ in rows:
        layout = load_layout(name)
        assert (layout.num_markers, 1e3 * layout.radius) == (int(markers), float(radius))
    assert {name for name, *_, labeler in rows if labeler == "comes with it"} == {"dense19", "sparse13"}


def test_every_key_of_a_file_is_explained():
    keys = {
        key
        for row in re.findall(r"^\| (`.+?`) \| .+ \|$", PAGE, re.M)
        for key in re.findall(r"`([\w\[\]]+)`", row)
    }
    markers = [
        {"name": f"m{number}", "bone": "palm", "along": 0.5, "around": 0.0, "across": 0.1, "height_mm": 3.0}
        for number in range(5)
    ]
    full = {"name": "g", "radius_mm": 3.2, "description": "", "source": "", "sides": ["left"]}
    assert parse_layout({**full, "marker": markers}).sides == ("left",)
    assert {*full, *markers[0], "[[marker]]"} <= keys
