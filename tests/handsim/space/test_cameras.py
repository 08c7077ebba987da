"""Rigs: the shipped ones to the last digit, anybody's from a file, and a sentence for every mistake.

`HANDSIM_RENEW_GOLDEN=1 pytest tests/handsim/test_cameras.py` writes the golden sentences anew; read the diff.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim.errors import ArgumentError, RigError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import Population, sample_shape
from handsim.space.camera import look_at
from handsim.space.cameras import (
    HAND_REACH,
    CameraRig,
    check_outside,
    check_outside_volume,
    list_rigs,
    load_rig,
    named_rig,
    save_rig,
)

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden"
CENTER = np.array([0.0, 0.0, 1.1])

TOP = 'name = "mine"\nfield_of_view = 50.0\n'
FIRST = "[[camera]]\nposition = [1.0, 0.0, 2.0]\ntarget = [0.0, 0.0, 1.0]\n"
SECOND = "[[camera]]\nposition = [-1.0, 0.5, 2.0]\ntarget = [0.0, 0.0, 1.0]\n"


def test_shipped_rigs_hold_what_their_names_say():
    counts = {name: len(named_rig(name).positions) for name in list_rigs()}
    assert counts == {"eight": 8, "figure5": 16, "six": 6}
    for name in list_rigs():
        assert named_rig(name).name == name
        assert named_rig(name).resolution == 1280


def test_figure5_stays_where_training_sets_were_made_with_it():
    saved, rig = json.loads((GOLDEN / "figure5.json").read_text()), named_rig("figure5")
    assert rig.field_of_view == saved["field_of_view"]
    np.testing.assert_array_equal(rig.positions, np.array(saved["T_world_camera"])[:, :3, 3])
    # another processor may round a norm otherwise in the last bit
    np.testing.assert_allclose(rig.T_world_camera, saved["T_world_camera"], rtol=0, atol=5e-16)


@pytest.mark.parametrize("name", list_rigs())
def test_every_place_of_the_volume_is_in_three_views(name, rng):
    rig = named_rig(name)
    check_outside_volume(rig, CENTER, 0.3)
    seen = rig.in_view(CENTER + rng.uniform(-0.3, 0.3, size=(5000, 3))).sum(axis=-1)
    assert (seen >= 3).all()


def test_a_file_of_ones_own(tmp_path):
    pose = look_at(np.array([-1.0, 0.5, 2.0]), np.array([0.0, 0.0, 1.0]))
    path = tmp_path / "mine.toml"
    path.write_text(f"{TOP}resolution = 2048\n{FIRST}[[camera]]\nT_world_camera = {pose.tolist()}\n")
    rig = load_rig(path)
    assert (rig.name, rig.resolution) == ("mine", 2048)
    assert rig.field_of_view == pytest.approx(np.deg2rad(50.0))
    np.testing.assert_array_equal(rig.positions, [[1.0, 0.0, 2.0], [-1.0, 0.5, 2.0]])
    path.write_text(TOP + FIRST + SECOND)
    np.testing.assert_allclose(load_rig(str(path)).T_world_camera, rig.T_world_camera, atol=1e-15)
    assert load_rig(path).resolution == 1280
    np.testing.assert_array_equal(load_rig("six").T_world_camera, named_rig("six").T_world_camera)


def test_a_saved_rig_has_the_same_cameras(tmp_path):
    for name in list_rigs():
        rig = named_rig(name)
        save_rig(tmp_path / "rig.toml", rig)
        again = load_rig(tmp_path / "rig.toml")
        np.testing.assert_allclose(again.T_world_camera, rig.T_world_camera, atol=1e-9)
        assert (again.name, again.resolution) == (rig.name, rig.resolution)
        assert again.field_of_view == pytest.approx(rig.field_of_view)


def test_the_documented_file_says_what_the_document_says(capsys):
    script = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "rigs.md").read_text("utf-8"), re.S)
    assert script is not None
    exec(script[1], {})
    assert capsys.readouterr().out.split("\n") == [
        "[ True  True]",
        "[[-52.3 -80.5]",
        " [-60.2 -60.2]]",
        "1204",
        "",
    ]


distance = st.floats(-2.0, 2.0)


@given(st.tuples(distance, distance, distance), st.tuples(distance, distance, distance))
def test_a_camera_sees_its_target_in_the_middle_of_an_upright_picture(position, target):
    position, target = np.array(position), np.array(target)
    if np.linalg.norm(target - position) < 0.1:
        return
    pose = look_at(position, target)
    other = look_at(position + [5.0, 0.0, 0.0], target)
    rig = CameraRig("two", np.stack([pose, other]), 1.0)
    np.testing.assert_allclose(rig.project(target)[0], 0.0, atol=1e-6)
    assert rig.in_view(target)[0]
    if abs(pose[2, 2]) < 0.99:
        above = rig.project(target + [0.0, 0.0, 1e-3])[0]
        assert above[1] < 0, "up in the world is up in the picture, where pixels count downwards"


def test_pixels_are_the_pinhole_cameras():
    rig = CameraRig("two", np.stack([np.eye(4), look_at(np.ones(3), np.zeros(3))]), np.deg2rad(90.0), 1000)
    assert rig.focal_length == pytest.approx(500.0)
    points = np.array([[[0.2, -0.1, 2.0], [2.0, 0.0, 2.0]], [[0.0, 0.0, 0.5], [0.1, 0.0, -1.0]]])
    pixels = rig.project(points)
    assert pixels.shape == (2, 2, 2, 2)
    np.testing.assert_allclose(pixels[0, :, 0], [[50.0, -25.0], [500.0, 0.0]])
    np.testing.assert_allclose(pixels[1, 0, 0], 0.0)
    assert np.isnan(pixels[1, 1, 0]).all(), "behind the camera"
    # the edge of the view cone is the edge of the picture
    off = np.array([np.sin(np.deg2rad(44.9)), 0.0, np.cos(np.deg2rad(44.9))])
    assert rig.in_view(off)[0]
    assert 498 < rig.project(off)[0, 0] < 500


MISTAKES = {
    "one camera": TOP + FIRST,
    "no camera": TOP,
    "33 cameras": TOP + "".join(FIRST.replace("1.0, 0.0, 2.0", f"1.0, {n}.0, 2.0") for n in range(33)),
    "two cameras at one place": TOP + FIRST + SECOND + FIRST,
    "text for a number": TOP + FIRST + SECOND.replace("0.5", '"half"'),
    "not a number": TOP + FIRST + SECOND.replace("0.5", "nan"),
    "two numbers": TOP + FIRST + SECOND.replace("-1.0, 0.5, 2.0", "-1.0, 0.5"),
    "a camera that looks at itself": TOP + FIRST + SECOND.replace("[-1.0, 0.5, 2.0]", "[0.0, 0.0, 1.0]"),
    "millimeters": TOP + FIRST + SECOND.replace("[-1.0, 0.5, 2.0]", "[-1000.0, 500.0, 2000.0]"),
    "damaged": TOP + FIRST + SECOND + "target = [0.0,",
    "no name": "field_of_view = 50.0\n" + FIRST + SECOND,
    "unknown key": TOP + FIRST + SECOND.replace("target", "targets"),
    "no target": TOP + FIRST + SECOND.split("target", maxsplit=1)[0],
    "too much": TOP + FIRST + SECOND + "T_world_camera = [[1.0]]\n",
    "three rows": TOP + FIRST + "[[camera]]\nT_world_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]\n",
    "ragged rows": TOP + FIRST + "[[camera]]\nT_world_camera = [[1, 0, 0, 0], [0, 1]]\n",
    "a pose that scales": TOP
    + FIRST
    + "[[camera]]\nT_world_camera = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]\n",
    "field of view in radians": TOP.replace("50.0", "0.87") + FIRST + SECOND,
    "resolution of half a pixel": TOP + "resolution = 640.5\n" + FIRST + SECOND,
    "resolution of a dot": TOP + "resolution = 1\n" + FIRST + SECOND,
    "camera is no table": TOP + "camera = 3\n",
}


def test_error_sentences(tmp_path):
    actual = {}
    for name, text in MISTAKES.items():
        (tmp_path / "rig.toml").write_text(text)
        with pytest.raises(RigError) as told:
            load_rig(tmp_path / "rig.toml")
        actual[name] = str(told.value).replace(str(tmp_path), "")
    for name in ("figure6", "rigs/mine.json", "missing.toml"):
        with pytest.raises(RigError) as told:
            load_rig(name)
        actual[name] = str(told.value)
    path = GOLDEN / "rig_errors.json"
    if os.environ.get("HANDSIM_RENEW_GOLDEN") == "1":
        path.write_text(json.dumps(actual, indent=2, ensure_ascii=False) + "\n", "utf-8")
    assert actual == json.loads(path.read_text("utf-8"))


def test_binary_files_are_told(tmp_path):
    (tmp_path / "rig.toml").write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(RigError, match="not UTF-8 text"):
        load_rig(tmp_path / "rig.toml")


def test_cameras_in_the_hand_are_refused():
    rig, model = named_rig("six"), HandModel.named("M")
    far = model.skin(join_qpos(np.zeros((3, 20)), position=CENTER))
    check_outside(rig, far)
    check_outside(rig, np.full((4, 3), np.nan))
    near = model.skin(join_qpos(np.zeros((1, 20)), position=rig.positions[2] + [0.0, 0.0, 0.04]))
    with pytest.raises(
        ArgumentError, match=r"camera 3 of rig 'six' is 0\.0\d+ m from the hand, expected at least 0.05 m"
    ):
        check_outside(rig, np.concatenate([far, near]))
    with pytest.raises(
        ArgumentError, match=r"camera 3 of rig 'six' is .* m from the pen, expected at least 3 m"
    ):
        check_outside(
            CameraRig("six", rig.T_world_camera[[3, 4, 0]], 1.0), [2.0, 0.0, 3.5], clearance=3.0, what="pen"
        )


def test_cameras_in_the_volume_are_refused():
    rig = named_rig("six")
    check_outside_volume(rig, CENTER, 0.6)
    with pytest.raises(
        ArgumentError,
        match=r"camera 5 of rig 'six' is 0.14 m from the space that wrists move in, expected at least 0.25 m",
    ):
        check_outside_volume(rig, CENTER + [0.0, 0.44, 0.0], 0.5)
    with pytest.raises(ArgumentError, match=r"camera 1 of rig 'six' is 0 m from"):
        check_outside_volume(rig, CENTER, 2.0)


def test_no_hand_reaches_beyond_its_reach(rng):
    flat = join_qpos(np.zeros((1, 20)))
    for _ in range(20):
        skin = HandModel(sample_shape(Population(children=0.2), side="right", rng=rng)).skin(flat)
        assert np.linalg.norm(skin, axis=-1).max() < HAND_REACH
    assert np.linalg.norm(HandModel.named("XL").skin(flat), axis=-1).max() < HAND_REACH
