"""Layouts: the shipped ones, what a file may say, and a sentence for everything it may not."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gloves.layout
from gloves import MarkerLayout, MarkerPlace, load_layout
from gloves.fit import forearm_markers, nominal_fit
from gloves.layout import list_layouts, moved_text, shipped_layout, starter_layout, stored_layout
from handsim.errors import LayoutError
from handsim.hand.shape import BONE_NAMES, SIZES
from tests.sentences import error_names

DENSE19 = (
    "ThumbCMC ThumbMCP ThumbIP ThumbTip IndexMCP IndexPIP IndexTip MiddleMCP MiddlePIP MiddleTip "
    "RingMCP RingPIP RingTip PinkyMCP PinkyPIP PinkyTip BackHand1 BackHand2 BackHand3"
).split()
NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8)
NUMBERS = {
    "along": st.floats(-0.3, 1.3),
    "around": st.floats(-180.0, 180.0).map(math.radians),
    "height": st.just(0.0) | st.floats(0.0, 0.05),
}
PLACES = st.one_of(
    st.builds(MarkerPlace, NAMES, st.sampled_from(BONE_NAMES), **NUMBERS),
    st.builds(MarkerPlace, NAMES, st.just("palm"), across=st.floats(-1.0, 1.0), **NUMBERS),
)
LAYOUTS = st.builds(
    MarkerLayout,
    NAMES,
    st.lists(PLACES, min_size=5, max_size=60, unique_by=lambda place: place.name).map(tuple),
    st.floats(0.0005, 0.015),
    st.sampled_from([("left", "right"), ("right",), ("left",)]),
    st.sampled_from([(), load_layout("clinical26").forearm]),
)
TOP = 'name = "g"\nradius_mm = 3.2'
DENSE = (Path(gloves.layout.__file__).parent / "layouts" / "dense19.toml").read_text("utf-8")
REMARKED = DENSE.replace("along = 0.32\naround = -40.0\n", "along = 0.32 # a third\naround = -40.0# side\n")
STALKED = DENSE.replace("across = 0.225", "across = 0.225\nheight_mm = 12 # a stalk")
ONE_SIDED = DENSE.replace("radius_mm", 'sides = ["left"] # the other hand wears none\nradius_mm')


def test_shipped_layouts() -> None:
    names = "clinical26 dense19 dfki13 sparse13 starter10 starter15 starter30 starter6 tips8"
    assert list_layouts() == tuple(names.split())
    dense, sparse = load_layout("dense19"), load_layout("sparse13")
    assert list(dense.names) == DENSE19
    assert (dense.num_markers, sparse.num_markers) == (19, 13)
    kept = {name for name in DENSE19 if not name.endswith(("CMC", "MCP"))}
    assert list(sparse.names) == [name for name in DENSE19 if name in kept]
    assert dense.radius == sparse.radius == pytest.approx(0.0032)
    # The sparse glove is the dense one with markers taken off, nothing moved.
    assert set(sparse.markers) < set(dense.markers)


@pytest.mark.parametrize("name", list_layouts())
def test_shipped_layouts_fit_every_hand(name: str) -> None:
    shipped = shipped_layout(name)
    layout = shipped.layout
    assert layout == load_layout(name) and layout.name == name
    assert shipped.description and shipped.source
    count = str(layout.num_markers + len(layout.forearm))
    assert count in name and count in shipped.description
    for size in SIZES:
        right, left = (nominal_fit(layout, size, side).attachment.points for side in ("right", "left"))
        np.testing.assert_allclose(left, right * [1.0, -1.0, 1.0], atol=1e-9)
        distances = np.linalg.norm(right[:, None] - right, axis=-1)
        np.fill_diagonal(distances, np.inf)
        assert distances.min() > 2 * layout.radius + 0.003  # a camera sees them apart


def test_starters_follow_their_rule() -> None:
    small, *larger = (load_layout(name) for name in ("starter6", "starter10", "starter15"))
    assert [marker.bone for marker in small.markers[:3]] == ["palm"] * 3
    assert all(marker.bone.endswith("distal") for marker in small.markers[3:])
    for starter in larger:
        assert starter.markers[: small.num_markers] == small.markers
        small = starter
    assert set(small.markers) < set(load_layout("dense19").markers)
    assert set(load_layout("tips8").markers) == set(small.markers[:8])
    bones = Counter(marker.bone for marker in load_layout("starter30").markers)
    assert set(bones) == set(BONE_NAMES) and bones["palm"] == 6


def test_an_unknown_shipped_layout() -> None:
    with pytest.raises(LayoutError, match="unknown glove 'starter7'"):
        shipped_layout("starter7")


def test_a_glove_for_one_hand_is_refused_for_the_other() -> None:
    layout = dataclasses.replace(load_layout("dense19"), sides=("left",))
    assert nominal_fit(layout, "M", "left").side == "left"
    with pytest.raises(LayoutError, match=r"is for a left hand only .* a right hand was asked for"):
        nominal_fit(layout, "M", "right")


def test_sides_have_one_order(tmp_path: Path) -> None:
    path = tmp_path / "glove.toml"
    path.write_text(text(top='sides = ["right", "left"]'))
    swapped = load_layout(path)
    path.write_text(text())  # the good file, from which those below differ in one thing
    assert load_layout(path) == swapped and swapped.names == ("m0", "m1", "m2", "m3", "m4")


def test_markers_sit_on_the_bones_their_names_tell() -> None:
    segments = {"CMC": "metacarpal", "MCP": "proximal", "PIP": "middle", "IP": "proximal", "Tip": "distal"}
    for marker in load_layout("dense19").markers:
        if marker.name.startswith("BackHand"):
            assert marker.bone == "palm"
        elif marker.name == "ThumbMCP":
            assert marker.bone == "thumb_metacarpal"
        else:
            digit, segment = marker.bone.split("_")
            prefix = {"little": "Pinky"}.get(digit, digit.capitalize())
            assert marker.name.startswith(prefix)
            assert segments[marker.name.removeprefix(prefix)] == segment


def test_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    file = tmp_path / "glove.toml"
    file.write_text(starter_layout(), encoding="utf-8-sig")
    assert load_layout(file).num_markers >= 5


def test_starter_loads(tmp_path: Path) -> None:
    path = tmp_path / "my_glove.toml"
    path.write_text(starter_layout())
    layout = load_layout(path)
    assert layout.num_markers == 8
    assert all(bone in starter_layout() for bone in BONE_NAMES)
    assert max(map(len, starter_layout().splitlines())) <= 110


@given(layout=LAYOUTS)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, layout: MarkerLayout) -> None:
    path = tmp_path_factory.mktemp("layout") / "glove.toml"
    layout.save(path)
    again = load_layout(path)
    assert (again.name, again.names, again.sides) == (layout.name, layout.names, layout.sides)
    assert again.radius == pytest.approx(layout.radius, abs=1e-12)
    for one, other in zip(layout.markers, again.markers, strict=True):
        assert other.bone == one.bone
        assert (other.along, other.around, other.across) == pytest.approx(
            (one.along, one.around, one.across), abs=1e-9
        )
        assert other.height == pytest.approx(one.height, abs=1e-12)
    assert again.forearm == layout.forearm and ("forearm" in layout.record()) == bool(layout.forearm)
    assert stored_layout(json.loads(json.dumps(layout.record()))) == layout


def text(*, count: int = 5, radius_mm: str = "3.2", top: str = "", **keys: str) -> str:
    """A good file of `count` markers, of which the second has the given keys replaced (empty: left out)."""
    parts = ['name = "g"', f"radius_mm = {radius_mm}" if radius_mm else "", top]
    for number in range(count):
        values = {"name": f'"m{number}"', "bone": '"palm"', "along": "0.5", "around": "0"}
        if number == 1:
            values |= keys
        parts += ["[[marker]]", *(f"{key} = {value}" for key, value in values.items() if value)]
    return "\n".join(parts)


BAD = {
    "unknown bone": (
        text(bone='"index_proximl"'),
        "m1 | index_proximl | index_proximal | palm | little_distal",
    ),
    "on the wrist": (text(bone='"wrist"'), "m1 | wrist | palm | -0.15 to 0"),
    "one on the forearm": (text(count=6, bone='"forearm"'), "forearm | (1) | 3 or more"),
    "two of one name": (text(name='"m0"'), "two markers | 'm0'"),
    "too few": (text(count=2), "5 to 60 | got 2"),
    "too many": (text(count=61), "5 to 60 | got 61"),
    "no markers": (TOP, "5 to 60 | got 0"),
    "markers are no list": (f"{TOP}\nmarker = 3", "marker | [[marker]] table"),
    "one table": (f'{TOP}\n[marker]\nname = "m"', "marker | [[marker]] table"),
    "list of numbers": (f"{TOP}\nmarker = [1, 2, 3, 4, 5]", "marker | [[marker]] table"),
    "radius too large": (text(radius_mm="32"), "radius | 32 mm | 0.5 to 15 mm"),
    "radius in meters": (text(radius_mm="0.0032"), "radius | 0.0032 mm | 0.5 to 15 mm"),
    "radius is NaN": (text(radius_mm="nan"), "radius_mm is NaN | a number"),
    "radius missing": (text(radius_mm=""), "lacks | 'radius_mm'"),
    "radius is text": (text(radius_mm='"3.2"'), 'radius_mm is "3.2" | a number'),
    "radius is true": (text(radius_mm="true"), "radius_mm is true | a number"),
    "huge integer": (text(radius_mm=f"1{'0' * 400}"), "not a TOML file | 64 bits"),
    "name is a number": (text().replace('"g"', "3"), "name is 3 | text in quotes"),
    "name is empty": (text().replace('"g"', '""'), "name '' | printable"),
    "description is a number": (text(top="description = 3"), "description is 3 | text in quotes"),
    "extra key": (text(top="radius = 3"), "unknown key 'radius' | 'radius_mm' | sides"),
    "extra marker key": (text(allong="0.5"), "m1 | 'allong' | 'along' | height_mm"),
    "missing marker key": (text(along=""), "m1 | lacks | 'along'"),
    "missing marker name": (text(name=""), "number 2 | lacks | 'name'"),
    "marker name is a number": (text(name="3"), "number 2 | name is 3 | text in quotes"),
    "marker name is empty": (text(name='""'), "marker name '' | printable"),
    "marker name has a tab": (text(name='"a\\tb"'), "a\\tb | printable"),
    "along is text": (text(along='"half"'), 'm1 | along is "half" | a number'),
    "along is NaN": (text(along="nan"), "m1 | along is NaN | a number"),
    "along is a list": (text(along="[0.5, 0.5]"), "m1 | along is [0.5, 0.5] | a number"),
    "along far off": (text(along="1.4"), "m1 | along is 1.4 | -0.3 to 1.3"),
    "around too large": (text(around="181"), "m1 | around is 181 degrees | -180 to 180"),
    "across on a finger": (text(bone='"index_middle"', across="0.1"), "m1 | across | palm | index_middle"),
    "across too large": (text(across="-1.5"), "m1 | across is -1.5 | -1 to 1"),
    "height below the skin": (text(height_mm="-1"), "m1 | height is -1 mm | 0 to 50 mm"),
    "height far off": (text(height_mm="51"), "m1 | height is 51 mm | 0 to 50 mm"),
    "height is NaN": (text(height_mm="nan"), "m1 | height_mm is NaN | a number"),
    "height is text": (text(height_mm='"10"'), 'm1 | height_mm is "10" | a number'),
    "source is a number": (text(top="source = 3"), "source is 3 | text in quotes"),
    "unknown side": (text(top='sides = ["rihgt"]'), "'rihgt' | 'right' | left"),
    "no side": (text(top="sides = []"), 'sides | "right", "left" or both'),
    "one side twice": (text(top='sides = ["left", "left"]'), 'sides | "right", "left" or both'),
    "sides is text": (text(top='sides = "left"'), "sides is 'left' | a list"),
    "sides is a list of numbers": (text(top="sides = [1]"), "sides is [1] | a list"),
    "not TOML": ("name = ", "not a TOML file | end of document"),
    "nested too deep": ("name = " + "[" * 5000, "not a TOML file | nested too deep"),
    "empty file": ("", "lacks | 'name'"),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_is_told(tmp_path: Path, case: str) -> None:
    path = tmp_path / "glove.toml"
    content, words = BAD[case]
    path.write_text(content)
    with error_names(LayoutError, f"{path} | {words}"):
        load_layout(path)


def test_what_is_no_layout_is_told(tmp_path: Path) -> None:
    path = tmp_path / "glove.toml"
    path.write_bytes(b"name = '\xff'")
    for glove, words in (
        ("dense91", "'dense91' | 'dense19' | tips8 | path of a .toml file"),
        ("missing.toml", "missing.toml | No such file"),
        (path, f"{path} | not a TOML file | UTF-8"),
    ):
        with error_names(LayoutError, words):
            load_layout(glove)
    with error_names(LayoutError, f"{tmp_path} | cannot be written"):
        load_layout("dense19").save(tmp_path)


def test_what_was_stored_before_stalks_and_sides_loads() -> None:
    stored = json.loads(json.dumps(load_layout("dense19").record()))
    del stored["sides"]
    for marker in stored["markers"]:
        del marker["height"]
    assert stored_layout(stored) == load_layout("dense19")


def test_markers_of_the_forearm_are_none_of_the_glove(tmp_path: Path) -> None:
    layout = load_layout("clinical26")
    assert layout.num_markers == 22 and "RadialStyloid" not in layout.names
    assert [one.name for one in layout.forearm[:2]] == ["RadialStyloid", "UlnarStyloid"]
    assert MarkerLayout("same", (*layout.forearm, *layout.markers), 0.0032).forearm == layout.forearm
    assert nominal_fit(layout, "M", "right").attachment.points.shape == (22, 3)
    twice = dataclasses.replace(layout.forearm[0], name="MCP2")
    with error_names(LayoutError, "two markers | 'MCP2'"):
        dataclasses.replace(layout, forearm=(twice, *layout.forearm))
    moved = dataclasses.replace(layout.forearm[0], along=0.2)
    changed, kept = moved_text(
        Path(gloves.layout.__file__).with_name("layouts").joinpath("clinical26.toml").read_text("utf-8"),
        dataclasses.replace(layout, forearm=(moved, *layout.forearm[1:])),
    )
    assert kept and "along = 0.2\n" in changed


def test_the_forearm_is_beside_the_wrist_and_mirrored() -> None:
    layout = load_layout("clinical26")
    (right, out), (left, _) = (forearm_markers(layout, 0.19, side) for side in ("right", "left"))
    np.testing.assert_allclose(left, right * [1.0, -1.0, 1.0])
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0)
    assert (
        (right[:, 0] < 0.0).all() and right[0, 1] > 0.03 > -0.03 > right[1, 1] and right[2:, 2].min() > 0.015
    )


def test_pinky_is_another_name_of_the_little_finger(tmp_path: Path) -> None:
    text = starter_layout()
    assert "little_distal" in text
    (tmp_path / "glove.toml").write_text(text.replace('"little_', '"pinky_'))
    (tmp_path / "same.toml").write_text(text)
    assert load_layout(tmp_path / "glove.toml") == load_layout(tmp_path / "same.toml")


@pytest.mark.parametrize("text", [DENSE, starter_layout(), REMARKED, STALKED, ONE_SIDED])
def test_a_layout_that_is_as_it_was_keeps_every_byte(text, tmp_path):
    path = tmp_path / "glove.toml"
    path.write_text(text)
    assert moved_text(text, load_layout(path)) == (text, True)


def test_changes_keep_what_stands_behind_other_values(tmp_path):
    layout = load_layout("dense19")
    first = dataclasses.replace(layout.markers[0], along=0.5)
    moved, kept = moved_text(REMARKED, dataclasses.replace(layout, markers=(first, *layout.markers[1:])))
    assert kept and "along = 0.5 # a third\naround = -40.0# side\n" in moved
    assert moved_text(STALKED, layout) == (DENSE, True), "a stalk that is taken away leaves no line"
    both, kept = moved_text(ONE_SIDED, layout)
    (tmp_path / "glove.toml").write_text(both)
    assert not kept and load_layout(tmp_path / "glove.toml") == layout


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
    across = across if bone == "palm" else 0.0
    marker = MarkerPlace(layout.names[index], bone, along, around, across, height)
    markers = (*layout.markers[:index], marker, *layout.markers[index + 1 :])
    wanted = dataclasses.replace(layout, markers=markers)
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
