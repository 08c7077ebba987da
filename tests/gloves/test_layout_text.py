"""A layout's text keeps its comments and says where the markers went."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gloves.layout
from gloves.layout import load_layout, moved_text, starter_layout
from handsim.hand.shape import BONE_NAMES

DENSE = (Path(gloves.layout.__file__).parent / "layouts" / "dense19.toml").read_text("utf-8")


@pytest.mark.parametrize("text", [DENSE, starter_layout()])
def test_a_layout_that_is_as_it_was_keeps_every_byte(text, tmp_path):
    path = tmp_path / "glove.toml"
    path.write_text(text)
    assert moved_text(text, load_layout(path)) == (text, True)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 18),
    st.sampled_from(BONE_NAMES),
    st.floats(-0.3, 1.3),
    st.floats(-math.pi, math.pi),
    st.floats(-1.0, 1.0),
    st.just(0.0) | st.floats(0.0, 0.05),
)
def test_a_moved_marker_is_read_where_it_went(tmp_path_factory, index, bone, along, around, across, height):
    layout = load_layout("dense19")
    marker = dataclasses.replace(
        layout.markers[index],
        bone=bone,
        along=along,
        around=around,
        across=across if bone == "palm" else 0.0,
        height=height,
    )
    wanted = dataclasses.replace(
        layout, markers=(*layout.markers[:index], marker, *layout.markers[index + 1 :])
    )
    commented = DENSE.replace('name = "', '# a remark\nname = "').replace("along =", "along  =")
    text, kept = moved_text(commented, wanted)
    assert kept and text.count("# a remark") == commented.count("# a remark")
    path = tmp_path_factory.mktemp("layout") / "glove.toml"
    path.write_text(text)
    read = load_layout(path).markers
    assert read[:index] == layout.markers[:index] and read[index + 1 :] == layout.markers[index + 1 :]
    assert (read[index].name, read[index].bone) == (marker.name, bone)
    for key in ("along", "around", "across", "height"):
        assert getattr(read[index], key) == pytest.approx(getattr(marker, key), abs=1e-8)


def test_remarks_behind_values_stay(tmp_path):
    text = DENSE.replace("along = 0.32\n", "along = 0.32 # a third\n").replace(
        "around = -40.0\n", "around = -40.0# side\n"
    )
    layout = load_layout("dense19")
    first = dataclasses.replace(layout.markers[0], along=0.5)
    moved, kept = moved_text(text, dataclasses.replace(layout, markers=(first, *layout.markers[1:])))
    assert kept and "along = 0.5 # a third\naround = -40.0# side\n" in moved


def test_a_stalk_that_is_taken_away_leaves_no_line(tmp_path):
    text = DENSE.replace("across = 0.225", "across = 0.225\nheight_mm = 12 # a stalk")
    path = tmp_path / "glove.toml"
    path.write_text(text)
    layout = load_layout(path)
    assert layout.markers[-1].height == pytest.approx(0.012)
    assert moved_text(text, layout) == (text, True)
    assert moved_text(text, load_layout("dense19")) == (DENSE, True)


def test_sides_stay(tmp_path):
    text = DENSE.replace("radius_mm", 'sides = ["left"] # the other hand wears none\nradius_mm')
    path = tmp_path / "glove.toml"
    path.write_text(text)
    assert load_layout(path).sides == ("left",)
    assert moved_text(text, load_layout(path)) == (text, True)
    both, kept = moved_text(text, load_layout("dense19"))
    path.write_text(both)
    assert not kept and load_layout(path) == load_layout("dense19")


def test_a_text_that_cannot_be_changed_line_by_line_is_written_anew(tmp_path):
    layout = load_layout("dense19")
    tables = ", ".join(
        f'{{name = "{marker.name}", bone = "{marker.bone}", along = {marker.along}, '
        f"around = {math.degrees(marker.around)}, across = {marker.across}}}"
        for marker in layout.markers
    )
    # Inline tables are as good as others; `across = 0` is allowed on any bone.
    text, kept = moved_text(f'# gone\nname = "dense19"\nradius_mm = 3.2\nmarker = [{tables}]\n', layout)
    path = tmp_path / "new.toml"
    path.write_text(text)
    assert not kept and "gone" not in text
    assert load_layout(path).names == layout.names
