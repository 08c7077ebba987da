"""A user's file gives back the same hands to the last bit, and says in one sentence what is wrong with it."""

from __future__ import annotations

import dataclasses
import functools
import json
import operator
import os

import mujoco
import numpy as np
import pytest

from gloves import GloveFit, load_layout
from gloves.fit import nominal_fit
from handsim import HandModel, HandSimError, sample_shape
from handsim.cli.main import main
from handsim.errors import ArgumentError
from handsim.hand.shape import SIDES
from tests.sentences import error_names
from track import User, load_user
from track.kinematics.pose_spread import SKELETON_NUMBERS, HandErrors
from track.user import AS_MEASURED, MEASURED, UserError, as_user


@pytest.fixture
def hands(rng):
    """Left and right hand of somebody, in gloves whose markers have slipped."""
    layout = load_layout("dense19")
    pair = []
    for side in SIDES:
        worn = nominal_fit(layout, "M", side).attachment
        worn = dataclasses.replace(worn, points=worn.points + rng.normal(scale=0.003, size=worn.points.shape))
        pair.append(GloveFit(HandModel(sample_shape(side=side, rng=rng)), worn))
    return tuple(pair)


def errors_of_somebody():
    """Three independent errors of a hand of a millimeter or a degree."""
    rng = np.random.default_rng(3)
    return HandErrors(0.01 * rng.normal(size=(SKELETON_NUMBERS, 3)), 0.001 * rng.normal(size=(19, 3, 3)))


def test_errors_of_calibrated_hands_come_back(hands, tmp_path):
    told = errors_of_somebody()
    User(hands, errors={"right": told}).save(tmp_path / "user.json")
    found = load_user(tmp_path / "user.json").errors
    assert set(found) == {"right"}
    for one, other in zip(told, found["right"], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_an_arch_comes_back_and_older_files_have_none(hands, tmp_path):
    arched = GloveFit(HandModel(dataclasses.replace(hands[1].shape, arch=[0.1, 0.4])), hands[1].attachment)
    User((hands[0], arched)).save(tmp_path / "user.json")
    first, second = json.loads((tmp_path / "user.json").read_text("utf-8"))["hands"]
    assert "arch" not in first["shape"] and second["shape"]["arch"] == [0.1, 0.4]
    for hand, arch in zip(load_user(tmp_path / "user.json"), ([0.0, 0.0], [0.1, 0.4]), strict=True):
        np.testing.assert_array_equal(hand.shape.arch, arch)


def test_older_files_have_no_such_errors(hands, tmp_path):
    User(hands).save(tmp_path / "user.json")
    content = json.loads((tmp_path / "user.json").read_text("utf-8"))
    content["angle_errors"] = {"right": [[0.01, 0.01]] * 20}
    (tmp_path / "user.json").write_text(json.dumps(content), "utf-8")
    assert load_user(tmp_path / "user.json").errors == {}


def test_hands_come_back_exactly(hands, tmp_path):
    User(hands, "drawn at random").save(tmp_path / "user.json")
    again = load_user(tmp_path / "user.json")
    assert again.sides == ("left", "right") and again.notes == "drawn at random"
    assert [hand.side for hand in again] == ["left", "right"] and list(again) == list(again.hands)
    for first, second in zip(hands, again, strict=True):
        assert first.attachment.layout == second.attachment.layout
        for name in ("points", "normals", "bone_indices", "bone_weights"):
            np.testing.assert_array_equal(getattr(first.attachment, name), getattr(second.attachment, name))
        for field in dataclasses.fields(first.model.shape):
            mine, other = (getattr(hand.model.shape, field.name) for hand in (first, second))
            np.testing.assert_array_equal(mine, other)


def test_a_hand_that_a_calibration_left_as_measured_is_not_calibrated(hands, tmp_path):
    left = f"left hand: no better, so that it stays as it was{AS_MEASURED}"
    User(hands, f"calibrated from a capture; {left}; right hand: better").save(tmp_path / "user.json")
    for user in (load_user(tmp_path / "user.json"), as_user(tmp_path / "user.json")):
        assert not user.is_calibrated("left") and user.is_calibrated("right")
    assert as_user(tmp_path / "user.json").notes == f"user.json; {left}"
    assert user.origin("left") == "measured"


@pytest.mark.parametrize(
    ("notes", "origin"),
    [("", "calibrated"), ("M", "named"), (f"{MEASURED}187 x 83 mm", "measured"), (f"{MEASURED}M", "named")],
)
def test_notes_tell_where_hands_are_from(hands, notes, origin, tmp_path):
    """A size that could not be measured is the usual one."""
    user = User(hands, notes)
    assert user.origin("left") == origin and user.is_calibrated("left") == (origin == "calibrated")
    user.save(tmp_path / "user.json")
    again = as_user(tmp_path / "user.json")
    assert again.origin("left") == origin and "user.json" in again.notes
    assert as_user(tmp_path / "user.json").of_sides(["right"]).origin("right") == origin


def test_what_cannot_be_saved_is_told(hands, tmp_path):
    with pytest.raises(ArgumentError, match="expected a left hand, a right hand, or one of each"):
        User((hands[0], hands[0]))
    with pytest.raises(ArgumentError, match="expected a left hand"):
        User(())
    with pytest.raises(ArgumentError, match="different gloves"):
        User((hands[0], nominal_fit(load_layout("sparse13"), "M", "right")))
    with pytest.raises(UserError, match="cannot be written"):
        User(hands).save(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_user_s_hand_leaves_with_its_markers(hands, tmp_path, capsys):
    user = User(hands)
    user.save(tmp_path / "user.json")
    user.export(tmp_path / "left.xml", "left")
    assert main(["export", str(tmp_path / "user.json"), "--out", str(tmp_path / "hand.xml")]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'hand.xml'}: right hand of")
    for name, hand in (("left.xml", hands[0]), ("hand.xml", hands[1])):
        assert mujoco.MjModel.from_xml_path(str(tmp_path / name)).nsite == hand.layout.num_markers
    with pytest.raises(ArgumentError, match=r"expected a name that ends in \.xml, \.urdf, \.osim, \.glb"):
        user.export(tmp_path / "hand.stl")


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("glove", 1, "a value is of another kind than handsim calibrate writes"),
        ("hands.0.markers.points.3.1", 1e30, "points holds numbers beyond 100, expected markers on a hand"),
        ("schema", 99, "schema 99, expected 1"),
        ("glove.markers.0.bone", "toe", "unknown bone 'toe'"),
        ("hands.0.shape.length", "long", "damaged"),
        ("hands.0.markers.points.3.1", float("nan"), "points holds NaN"),
        ("hands.0.markers.points.0", None, "expected (19, 3)"),
        ("hands.0.markers.bone_indices.0.0", 16, "whole numbers from 0 to 15"),
        ("hands.0.markers.bone_weights.0", [0.5, 0.0, 0.0, 0.0], "sum to one"),
        ("hands", None, "'hands' is missing"),
        ("errors.right.numbers.45", None, "errors of the right hand are not small numbers"),
        ("errors.right.markers.0.0.1", 10**7, "errors of the right hand are not small numbers"),
        ("errors.right.markers.0", None, "errors of the right hand are not small numbers"),
        ("errors.right.numbers", [[]] * 46, "errors of the right hand are not small numbers"),
        ("errors.right.markers", None, "'markers' is missing"),
        ("hands.1.shape.side", "left", "expected a left hand, a right hand, or one of each"),
    ],
)
def test_damage_is_told_in_one_sentence(place, value, words, hands, tmp_path):
    path = tmp_path / "user.json"
    User(hands, errors={"right": errors_of_somebody()}).save(path)
    content = json.loads(path.read_text("utf-8"))
    *way, last = [int(key) if key.isdigit() else key for key in place.split(".")]
    table = functools.reduce(operator.getitem, way, content)
    if value is None:
        del table[last]
    else:
        assert table[last] != value
        table[last] = value
    path.write_text(json.dumps(content), "utf-8")
    with error_names(UserError, f"{path} | {words}"):
        load_user(path)


@pytest.mark.parametrize("text", ["", "[1, 2]", "{}", "{", "\u0000", "[" * 100_000])
def test_other_files_are_told(text, tmp_path):
    path = tmp_path / "user.json"
    path.write_text(text, "utf-8")
    with pytest.raises(HandSimError, match="not a user's file"):
        load_user(path)


def test_a_pipe_is_no_user(tmp_path):
    os.mkfifo(tmp_path / "user.json")
    with pytest.raises(UserError, match="this is a pipe, expected a regular file"):
        load_user(tmp_path / "user.json")
