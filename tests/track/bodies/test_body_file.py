"""Bodies as files: the same again when read, and a sentence for every file that describes none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from handsim.errors import ArgumentError
from handsim.space.objects import named_object
from track.bodies.body_file import BodyError, load_bodies, load_body, save_body
from track.bodies.rigid_body import RigidTemplate

NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8)


@st.composite
def bodies(draw) -> RigidTemplate:
    names = draw(st.lists(NAMES, min_size=3, max_size=8, unique=True))
    places = draw(arrays.arrays(float, (len(names), 3), elements=st.floats(-0.3, 0.3)))
    try:
        return RigidTemplate(draw(NAMES), tuple(names), places)
    except ArgumentError:  # markers too near to each other, on a line, or alike from two sides
        assume(False)
        raise


@given(body=bodies())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, body: RigidTemplate) -> None:
    path = tmp_path_factory.mktemp("body") / "body.toml"
    save_body(path, body)
    again = load_body(path)
    assert (again.name, again.marker_names) == (body.name, body.marker_names)
    np.testing.assert_allclose(again.positions, body.positions, rtol=0.0, atol=1e-12)
    save_body(path.with_name("again.toml"), again)
    assert path.read_bytes() == path.with_name("again.toml").read_bytes()


def text(*, head: str = 'name = "wand"', count: int = 3, **keys: str) -> str:
    """A good file of `count` markers, of which the second has the given keys replaced (empty: left out)."""
    places = ["[0, 0, 0]", "[50.0, 0, 0]", "[0, 80, 0]", "[0, 0, 30]"]
    tables = []
    for number in range(count):
        values = {"name": f'"m{number}"', "place_mm": places[number]}
        if number == 1:
            values |= keys
        tables.append(
            "[[marker]]\n" + "\n".join(f"{key} = {value}" for key, value in values.items() if value)
        )
    return "\n".join([head, *tables])


def test_files_are_in_millimeters(tmp_path):
    path = tmp_path / "wand.toml"
    path.write_text(text(head='name = "wand"\ndescription = "three on a stick"'))
    body = load_body(path)
    assert (body.name, body.marker_names) == ("wand", ("m0", "m1", "m2"))
    np.testing.assert_allclose(body.positions, [[0, 0, 0], [0.05, 0, 0], [0, 0.08, 0]])


def test_objects_of_handsim_have_names():
    np.testing.assert_array_equal(load_body("mug").positions, named_object("mug").markers)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("name = ", "not a TOML file"),
        ("", "the file lacks the key 'name'"),
        ('name = "wand"', "wand: 0 markers, expected at least 3"),
        (text(count=2), "wand: 2 markers, expected at least 3"),
        (text(head="name = 3"), "name is 3, expected text in quotes"),
        (text(head='name = " wand"'), "the body's name ' wand': expected printable characters"),
        (text(head='name = "wand"\ndescription = 3'), "description is 3, expected text in quotes"),
        (text(head='name = "wand"\nradius_mm = 3'), "the file has an unknown key 'radius_mm'"),
        ('name = "wand"\nmarker = [1, 2]', "marker is not a list of tables"),
        (text(name='"m0"'), "wand: a marker name is there twice: m0, m0, m2"),
        (text(name='"a\\tb"'), "marker name 'a\\tb': expected printable characters"),
        (text(name=""), "marker number 2 lacks the key 'name'"),
        (text(place_mm=""), "marker 'm1' lacks the key 'place_mm'"),
        (text(place="[1, 2, 3]"), "marker 'm1' has an unknown key 'place' (did you mean 'place_mm'?)"),
        (text(place_mm="[50, 0]"), "marker 'm1': place_mm is [50, 0], expected three numbers [x, y, z] in"),
        (text(place_mm="[50, 0, nan]"), "marker 'm1': place_mm is [50, 0, NaN], expected three numbers"),
        (text(place_mm='"50 0 0"'), "marker 'm1': place_mm is \"50 0 0\", expected three numbers"),
        (text(place_mm="[0.05, 0, 0]"), "m0 and m1 are 0.1 mm apart, expected at least 6 mm"),
        (text(place_mm="[80, 0, 0]"), "its markers look the same from two sides (m1 at m2, m2 at m1)"),
    ],
)
def test_a_file_that_describes_no_body_is_told(content, words, tmp_path):
    path = tmp_path / "wand.toml"
    path.write_text(content)
    with pytest.raises(BodyError) as caught:
        load_body(path)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_bodies_are_told(tmp_path):
    with pytest.raises(
        ArgumentError, match=r"unknown body 'mugg' \(did you mean 'mug'\?\); valid names: contr"
    ):
        load_body("mugg")
    with pytest.raises(ArgumentError, match="pen: 1 markers, expected at least 3"):
        load_body("pen")
    with pytest.raises(BodyError, match=r"nowhere.toml: cannot be read: No such file"):
        load_body(tmp_path / "nowhere.toml")
    with pytest.raises(BodyError, match="cannot be written"):
        save_body(tmp_path, load_body("mug"))


def test_bodies_that_are_tracked_together_have_names_of_their_own(tmp_path):
    assert [body.name for body in load_bodies(["mug", "box"])] == ["mug", "box"]
    for name, other in (("mug", "mug"), ("left", "box")):
        path = tmp_path / "body.toml"
        path.write_text(text(head=f'name = "{name}"'))
        with pytest.raises(
            ArgumentError, match=f"body.toml: a body is named '{name}', expected a name of its own"
        ):
            load_bodies([other, path])
