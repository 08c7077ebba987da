"""Named hand shapes: found by name, in range, and struck by every size of hand as they are written."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import SIZES
from poses.shapes import (
    HIGH,
    LIBRARIES,
    LOW,
    MAX_PENETRATION,
    all_gestures,
    gesture,
    gesture_names,
    gestures_of,
    is_valid,
    make_valid,
)

# Random poses blend exactly these, in this order: another sum here means other training sets.
_BLENDED = "1a3e09876ee645e750ec62f76644780e15ab045294e70693ae700a934acc667d"


def test_random_poses_blend_the_same_gestures_as_ever():
    assert all_gestures().shape == (53, 20)
    hundredths = np.rint(100 * np.rad2deg(all_gestures())).astype("<i4")
    assert hashlib.sha256(hundredths.tobytes()).hexdigest() == _BLENDED


def test_every_name_is_found_and_belongs_to_one_library():
    names = [name for library in LIBRARIES for name in gesture_names(library)]
    assert len(names) == len(set(names))
    for library in LIBRARIES:
        for name, angles in zip(gesture_names(library), gestures_of(library), strict=True):
            np.testing.assert_array_equal(gesture(name), angles)
    assert gesture_names() == gesture_names("gestures")


def test_the_libraries_are_complete():
    assert gesture_names("fingerspelling") == tuple(
        f"asl_{letter}" for letter in "abcdefghijklmnopqrstuvwxyz"
    )
    assert gesture_names("numbers") == tuple(f"asl_{number}" for number in range(10))
    assert gesture_names("counting") == tuple(
        f"count_{first}_{number}" for first in ("thumb", "index") for number in range(1, 6)
    )
    assert len(gesture_names("grasps")) == 33
    assert all(name.startswith("grasp_") for name in gesture_names("grasps"))
    assert len(gesture_names("pinches")) == 9
    assert len(gesture_names("keys")) == 12


def test_wrong_names_are_told():
    with pytest.raises(ArgumentError, match=r"unknown gesture 'asl_aa' \(did you mean 'asl_a'\?\)"):
        gesture("asl_aa")
    with pytest.raises(ArgumentError, match=r"unknown library 'grasp' \(did you mean 'grasps'\?\)"):
        gesture_names("grasp")
    with pytest.raises(ArgumentError, match="unknown library 'all'; valid names: gestures, fingerspelling"):
        gestures_of("all")


def test_a_gesture_is_a_copy():
    gesture("asl_a")[:] = 0.0
    assert gesture("asl_a").any()


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("size", SIZES)
def test_every_size_strikes_them_nearly_as_written(library, size):
    model, written = HandModel.named(size), gestures_of(library)
    assert (written >= LOW).all()
    assert (written <= HIGH).all()
    struck = make_valid(model, written)
    assert is_valid(model, struck).all()
    assert model.penetration(join_qpos(struck)).max() <= MAX_PENETRATION
    assert np.rad2deg(np.abs(struck - written)).max() <= 3.0


def _tips(name: str) -> np.ndarray:
    """Where the five tips are [m], in the wrist frame of the mean hand."""
    model = HandModel.named("M")
    frames = model.forward_kinematics(join_qpos(gesture(name)[None]))[0]
    last = [3, 6, 9, 12, 15]
    return frames[last, :3, 3] + frames[last, :3, 0] * model.skeleton.lengths[last, None]


def test_letters_look_like_themselves():
    far = {letter: _tips(f"asl_{letter}")[:, 0] for letter in "abdefiklmnorstuvwxy"}  # along the hand
    for letter, up in (("d", [1]), ("i", [4]), ("l", [1]), ("u", [1, 2]), ("v", [1, 2]), ("w", [1, 2, 3])):
        down = np.setdiff1d(np.arange(1, 5), up)
        assert far[letter][up].min() > far[letter][down].max() + 0.025, letter
    assert far["b"][1:].min() > 0.13
    for letter in "asmnet":
        assert far[letter][1:].max() < 0.12, letter
    # Tips that meet.
    assert np.linalg.norm(_tips("asl_f")[0] - _tips("asl_f")[1]) < 0.025
    assert np.linalg.norm(_tips("asl_o")[0] - _tips("asl_o")[1:3], axis=1).max() < 0.025
    assert np.linalg.norm(_tips("asl_d")[0] - _tips("asl_d")[2]) < 0.02
    # V spreads what U holds together, and R crosses it: the middle finger ends on the thumb's side (y).
    apart = {letter: _tips(f"asl_{letter}")[1, 1] - _tips(f"asl_{letter}")[2, 1] for letter in "ruv"}
    assert apart["r"] < 0.0 < apart["u"] < 0.02 < apart["v"]
    # The thumb: out to the side in L and Y, under three fingers in M, under two in N.
    assert _tips("asl_l")[0, 1] > 0.07
    assert _tips("asl_y")[0, 1] > 0.07
    assert _tips("asl_m")[0, 1] < _tips("asl_n")[0, 1] < _tips("asl_t")[0, 1]


def test_a_pressed_key_moves_that_finger_most():
    for keyboard in ("typing", "piano"):
        rest = gesture(f"{keyboard}_rest").reshape(5, 4)
        for number, digit in enumerate(("thumb", "index", "middle", "ring", "little")):
            moved = np.abs(gesture(f"{keyboard}_{digit}").reshape(5, 4) - rest).max(axis=1)
            assert moved.argmax() == number
            assert np.deg2rad(5.0) < moved[number] < np.deg2rad(20.0)
