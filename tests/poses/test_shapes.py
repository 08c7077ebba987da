"""Named gestures, couplings, random poses and their validity, ours and those of a user's sampler."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handsim import HandModel, join_qpos, sample_shape
from handsim.errors import ArgumentError, PoseError
from handsim.hand.shape import ADULTS, EVERYBODY, SIDES, SIZES
from poses import PoseMix, load_gestures, sample_poses, validate
from poses.shapes import (
    HIGH,
    LIBRARIES,
    LOW,
    MAX_PENETRATION,
    apply_couplings,
    gesture,
    gesture_names,
    gestures_of,
    is_valid,
    make_valid,
    resting_angles,
    sample_angles,
    sample_valid_angles,
)
from tests.sentences import error_names

# Random poses blend exactly these, in this order: another sum here means other training sets.
_BLENDED = "1a3e09876ee645e750ec62f76644780e15ab045294e70693ae700a934acc667d"


def test_random_poses_blend_the_same_gestures_as_ever():
    assert gestures_of("gestures").shape == (53, 20)
    hundredths = np.rint(100 * np.rad2deg(gestures_of("gestures"))).astype("<i4")
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


@given(seed=st.integers(0, 10_000), side=st.sampled_from(SIDES))
@settings(max_examples=10, deadline=None)
def test_sampled_poses_are_inside_ranges_and_hardly_touch(seed, side):
    rng = np.random.default_rng(seed)
    model = HandModel(sample_shape(EVERYBODY, side=side, rng=rng))
    angles = sample_valid_angles(model, 300, rng=rng)
    assert (angles >= LOW).all()
    assert (angles <= HIGH).all()
    assert model.penetration(join_qpos(angles)).max() <= MAX_PENETRATION == 0.001


def test_valid_poses_stay_as_they_are_and_tight_ones_open_only_so_far(rng):
    model = HandModel.named("M")
    angles = sample_angles(500, rng=rng)
    valid = is_valid(model, angles)
    made = make_valid(model, angles)
    np.testing.assert_array_equal(made[valid], angles[valid])
    resting = resting_angles(model)
    towards = (made - angles) * (resting - angles)
    assert (towards >= -1e-12).all(), "a joint may only move towards rest"
    assert not (made == resting).all(axis=1).any()


def test_couplings_are_a_projection(rng):
    angles = rng.uniform(LOW - 0.5, HIGH + 0.5, size=(500, 20))
    once = apply_couplings(angles)
    np.testing.assert_allclose(apply_couplings(once), once, atol=1e-12)
    bent, straight = np.zeros((1, 20)), np.zeros((1, 20))
    bent[0, [4, 5, 9, 13]] = np.deg2rad([22.0, 90.0, 90.0, 90.0])
    straight[0, 4] = np.deg2rad(22.0)
    assert apply_couplings(bent)[0, 4] < 0.3 * apply_couplings(straight)[0, 4]


def test_each_source_of_poses_differs_from_the_others(rng):
    spreads = [
        sample_angles(3000, mix, rng=rng).std(axis=0)
        for mix in (PoseMix(1, 0, 0), PoseMix(0, 1, 0), PoseMix(0, 0, 1))
    ]
    assert all((spread > 0.01).all() for spread in spreads)
    assert spreads[2].mean() > spreads[0].mean()


def test_neighboring_fingers_move_together(rng):
    flexion = sample_angles(5000, rng=rng).reshape(-1, 5, 4)[:, 1:, 1]
    correlation = np.corrcoef(flexion.T)
    assert correlation[1, 2] > 0.4
    assert correlation[0, 3] < correlation[1, 2]


def test_gestures_can_be_struck_by_the_mean_hand():
    depth = HandModel.named("M").penetration(join_qpos(gestures_of("gestures")))
    assert len(depth) == 53 and (depth <= MAX_PENETRATION).all()


@pytest.mark.parametrize("seed", [17885, 68246])
def test_people_whose_digits_converge_rest_with_them_apart(seed):
    model = HandModel(sample_shape(EVERYBODY, rng=np.random.default_rng(seed)))
    resting = resting_angles(model)
    assert is_valid(model, resting[None]).all()
    assert len(sample_poses(model, 3, rng=np.random.default_rng(0))) == 3


def test_a_hand_without_room_for_its_fingers_is_told():
    shape = HandModel.named("M").shape
    fat = dataclasses.replace(shape, radii=shape.radii * 1.6)
    with pytest.raises(PoseError, match="digits overlap at rest"):
        resting_angles(HandModel(fat))


def test_poses_are_those_of_training_sets():
    model = HandModel.named("M")
    qpos = sample_poses(model, 40, rng=np.random.default_rng(3))
    angles = sample_valid_angles(model, 40, rng=np.random.default_rng(3))
    np.testing.assert_array_equal(qpos, join_qpos(angles))
    assert validate(model, qpos).all()


def test_a_user_brings_a_sampler(rng):
    def anywhere(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(LOW - 0.3, HIGH + 0.3, size=(num_poses, len(LOW)))

    model = HandModel.named("S", side="left")
    qpos = sample_poses(model, 50, anywhere, rng=rng)
    assert qpos.shape == (50, 27)
    assert validate(model, qpos).all()
    assert not validate(model, join_qpos(anywhere(model, 50, rng=rng))).any()


def test_validity_does_not_depend_on_the_wrist(rng):
    model = HandModel.named("L")
    qpos = join_qpos(rng.uniform(LOW, HIGH, size=(60, 20)))
    moved = qpos.copy()
    moved[:, :3], moved[:, 3:7] = rng.normal(size=(60, 3)), rng.normal(size=(60, 4))
    valid = validate(model, qpos)
    np.testing.assert_array_equal(validate(model, moved), valid)
    assert 0 < valid.sum() < len(valid)


def test_all_gestures_by_name():
    gestures = load_gestures()
    assert len(gestures) == sum(len(gestures_of(library)) for library in LIBRARIES)
    np.testing.assert_array_equal(gestures["fist"], gesture("fist"))
    gestures["fist"][:] = 0.0
    assert gesture("fist").any(), "the library keeps its own numbers"


def test_mistakes_are_named(rng):
    model = HandModel.named("M")
    with pytest.raises(ArgumentError, match="num_poses is 0, expected at least 1"):
        sample_poses(model, 0, rng=rng)
    with error_names(ArgumentError, "<lambda>' returns has shape (2, 20), expected (3, 20) joint angles"):
        sample_poses(model, 3, lambda model, num_poses, *, rng: np.zeros((2, 20)), rng=rng)
    with pytest.raises(ArgumentError, match=r"qpos has shape \(1, 20\), expected \(..., any, 27\)"):
        validate(model, np.zeros((1, 20)))


@pytest.mark.parametrize("size", ["XS", "M", "XL"])
def test_single_precision_is_as_valid(rng, size):
    qpos = sample_poses(size, 200, rng=rng)
    at_limits = join_qpos(np.stack([np.clip(0.0, LOW, HIGH), np.where(LOW < 0.0, 0.0, LOW)]))
    for poses in (qpos, at_limits):
        np.testing.assert_array_equal(validate(size, poses.astype(np.float32)), validate(size, poses))
    bent = join_qpos(np.where(np.arange(20) == 4, HIGH + 1e-3, 0.0)[None])
    assert not validate(size, bent).any()


@pytest.mark.parametrize("population", [ADULTS, EVERYBODY], ids=["adults", "everybody"])
@pytest.mark.parametrize(
    "seed", [49, 112, 140, 175, 202, 254, 388, 417, 512, 797, 1000, 1720, 6774, 7741, 13383, 21931]
)
def test_people_with_thick_fingers_can_be_sampled(population, seed):
    model = HandModel(sample_shape(population, rng=np.random.default_rng(seed)))
    assert validate(model, sample_poses(model, 20, rng=np.random.default_rng(seed))).all()


@pytest.mark.parametrize("seed", [8014, 417, 3237])
def test_people_with_short_phalanges_have_valid_poses(seed):
    model = HandModel(sample_shape(rng=np.random.default_rng(seed)))
    qpos = sample_poses(model, 3, rng=np.random.default_rng(0))
    assert validate(model, qpos).all()
