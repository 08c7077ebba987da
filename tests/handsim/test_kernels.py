"""Compiled rotations against SciPy's."""

from __future__ import annotations

import dataclasses
import itertools
import pickle

import mujoco
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from handsim import HandModel, join_qpos
from handsim.callbacks import before_compiling
from handsim.hand.shape import DIGITS, SIDES, bones_of, named_shape
from handsim.kernels import (
    align_rigid,
    kernel,
    move,
    multiply_rotations,
    pose_digit_axes,
    quaternion_product,
    rotate_quaternion,
    segment_distance_squared,
    velocity_of,
    write_axis_angle_matrix,
    write_quaternion_matrix,
)
from handsim.space.transforms import quaternion_matrix, random_quaternions, rigid_fit
from poses.contact import digit_parts
from poses.shapes import HIGH, LOW
from tests.programs import run_python

SEEDS = st.integers(0, 100_000)


points = arrays(np.float64, (4, 3), elements=st.floats(-1, 1, width=32))


def _quaternion(rotation: Rotation) -> np.ndarray:
    return np.ascontiguousarray(rotation.as_quat(scalar_first=True))


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_matrices_are_scipys(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng)
    transform = np.full((4, 4), 7.0)
    write_quaternion_matrix(transform, *_quaternion(rotation))
    np.testing.assert_allclose(transform[:3, :3], rotation.as_matrix(), atol=1e-14)
    assert (transform[3] == 7.0).all()
    assert (transform[:, 3] == 7.0).all()
    axis, angle = rotation.apply([1.0, 0.0, 0.0]), rng.uniform(-6.0, 6.0)
    matrix = np.empty((3, 3))
    write_axis_angle_matrix(matrix, axis, angle)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-14)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_products_are_scipys(seed):
    rng = np.random.default_rng(seed)
    first, second = Rotation.random(2, rng=rng)
    both = (first * second).as_matrix()
    product = first.as_matrix()
    multiply_rotations(product, second.as_matrix(), product)
    np.testing.assert_allclose(product, both, atol=1e-14)
    numbers = quaternion_product(*_quaternion(first), *_quaternion(second))
    np.testing.assert_allclose(Rotation.from_quat(numbers, scalar_first=True).as_matrix(), both, atol=1e-14)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_rotations_by_own_vectors_are_scipys(seed):
    rng = np.random.default_rng(seed)
    start, axis = Rotation.random(rng=rng), Rotation.random(rng=rng).apply([1.0, 0.0, 0.0])
    angle = rng.uniform(-3.0, 3.0)
    expected = (start * Rotation.from_rotvec(angle * axis)).as_matrix()
    after = np.empty(4)
    rotate_quaternion(_quaternion(start), angle * axis, after)
    np.testing.assert_allclose(np.linalg.norm(after), 1.0, atol=1e-15)
    np.testing.assert_allclose(Rotation.from_quat(after, scalar_first=True).as_matrix(), expected, atol=1e-13)


def test_no_rotation_leaves_an_orientation_as_it_is():
    after = np.empty(4)
    rotate_quaternion(np.array([0.6, 0.0, 0.8, 0.0]), np.zeros(3), after)
    np.testing.assert_allclose(after, [0.6, 0.0, 0.8, 0.0], atol=1e-16)


def test_rigid_fits_are_the_best_ones():
    rng = np.random.default_rng(0)
    for _ in range(20):
        source, target = rng.normal(size=(2, 19, 3))
        target[rng.choice(19, size=5, replace=False)] = np.nan
        weights, pose = rng.integers(1, 4, size=19).astype(float), np.zeros(27)
        squares = align_rigid(source, target, weights, pose)
        there = np.repeat(
            np.arange(19), weights.astype(int) * np.isfinite(target[:, 0])
        )  # weights by counting
        rotation, translation = rigid_fit(source[there], target[there])
        np.testing.assert_allclose(quaternion_matrix(pose[3:7]), rotation, atol=1e-9)
        np.testing.assert_allclose(pose[:3], translation, atol=1e-9)
        left = source[there] @ rotation.T + translation - target[there]
        np.testing.assert_allclose(squares, (left**2).sum(), rtol=1e-9)


def segment_distance(p, q, a, b):
    return np.sqrt(segment_distance_squared(p, q, a, b))


@given(points)
@settings(max_examples=200, deadline=None)
def test_distance_is_the_bounded_least_squares_one(corners):
    p, q, a, b = corners
    solved = lsq_linear(np.stack([q - p, a - b], axis=1), a - p, bounds=(0, 1), tol=1e-14)
    expected = np.sqrt(2 * solved.cost)
    assert segment_distance(p, q, a, b) <= expected + 1e-6
    assert segment_distance(p, q, a, b) >= expected - 1e-4  # the solver stops short on flat valleys


@given(points)
@settings(max_examples=100, deadline=None)
def test_distance_does_not_depend_on_order(corners):
    p, q, a, b = corners
    first = segment_distance(p, q, a, b)
    rounding = 4e-6  # segments of up to 3.5 m within 1e-6 rad of each other are parallel
    assert segment_distance(q, p, a, b) == pytest.approx(first, abs=rounding)
    assert segment_distance(a, b, p, q) == pytest.approx(first, abs=rounding)


def test_points_parallel_and_crossing():
    o, x, y = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert segment_distance(o, o, x, x) == 1.0
    assert segment_distance(o, x, y, y + x) == 1.0
    assert segment_distance(-x, x, -y, y) == 0.0
    assert segment_distance(o, x, 3 * x, 2 * x) == 1.0


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    rng = np.random.default_rng(5)
    qpos = rng.standard_normal((40, 27))
    qpos[:, 3:7] = random_quaternions(40, rng=rng)
    return qpos


def test_a_step_is_mujocos(poses):
    model = HandModel.named("M").mj_model
    step = np.random.default_rng(6).standard_normal((len(poses), 26))
    step[0] = 0.0
    for qpos, by, moved in zip(poses, step, move(poses, step), strict=True):
        theirs = qpos.copy()
        mujoco.mj_integratePos(model, theirs, by, 1.0)
        np.testing.assert_allclose(moved, theirs, atol=1e-12)


def test_a_velocity_is_mujocos(poses):
    model, theirs = HandModel.named("M").mj_model, np.empty(26)
    for before, after in itertools.pairwise(poses):
        mujoco.mj_differentiatePos(model, theirs, 0.25, before, after)
        np.testing.assert_allclose(velocity_of(before, after, 0.25), theirs, atol=1e-9)


def test_a_step_takes_back_what_a_velocity_said(poses):
    for before, after in itertools.pairwise(poses):
        moved = move(before[None], velocity_of(before, after, 0.5)[None] * 0.5)[0]
        moved[3:7] *= np.sign(moved[3:7] @ after[3:7])
        np.testing.assert_allclose(moved, after, atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("digit", range(5))
@pytest.mark.parametrize("arch", [0.0, 0.6])
def test_a_digit_is_where_the_hand_has_it(side, digit, arch, rng):
    model = HandModel(dataclasses.replace(named_shape("L", side=side), arch=[0.5 * arch, arch]))
    qpos = join_qpos(
        rng.uniform(LOW, HIGH, size=(20, 20)),
        position=rng.normal(size=(20, 3)),
        quaternion=random_quaternions(20, rng=rng),
    )
    capsules = model.capsules
    theirs = capsules.posed(model.forward_kinematics(qpos))[
        :, np.isin(capsules.bones, bones_of(DIGITS[digit]))
    ]
    parts, ours, scratch = digit_parts(model, digit), np.empty((3, 2, 3)), np.empty((4, 3))
    for row, expected in zip(qpos, theirs, strict=True):
        wrist = quaternion_matrix(row[3:7]), row[:3]
        pose_digit_axes(wrist, row[7 + 4 * digit : 11 + 4 * digit], parts, ours, scratch)
        np.testing.assert_allclose(ours, expected, atol=1e-14)


def test_kernels_that_an_earlier_version_kept_are_compiled_anew(tmp_path, monkeypatch):
    """Their index may name types of modules that are gone, which Python cannot read."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def twice(x):
        return 2.0 * x

    assert kernel(twice)(1.5) == 3.0
    (index,) = tmp_path.rglob("*.nbi")
    stale = pickle.dumps(numba.__version__) + b"cmodule_that_is_gone\nName\n."
    index.write_bytes(stale)
    assert kernel(twice)(1.5) == 3.0
    assert index.read_bytes() != stale


def test_two_processes_keep_a_kernel_for_other_types_in_other_files(tmp_path, monkeypatch):
    """Neither sees the other's index; numba would let both write to file number one."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def twice(x):
        return x + x

    one, other = kernel(twice), kernel(twice)
    monkeypatch.setattr(other._cache._cache_file, "_load_index", dict)
    assert (one(1.5), other(1)) == (3.0, 2)
    assert len(list(tmp_path.rglob("*.nbc"))) == 2
    assert isinstance(kernel(twice)(1), int), "the index tells the newest"


def test_what_prepares_kernels_is_called_once_before_one_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    called = []
    before_compiling.append(lambda: called.append(1))

    def twice(x):
        return x + x

    compiled = kernel(twice)
    assert (compiled(1.5), compiled(1), called) == (3.0, 2, [1])


def test_a_program_is_told_once_that_its_first_calls_compile(tmp_path):
    source = tmp_path / "doubled.py"
    source.write_text(
        "from handsim.kernels import kernel\n\n\n@kernel\ndef twice(x):\n    return x + x\n\n\n"
        "print(twice(1), twice(1.5))\n"
    )
    first, again = (run_python(f"import runpy; runpy.run_path({str(source)!r})") for _ in range(2))
    assert first.stdout == again.stdout == "2 3.0\n"
    assert first.stderr.count("compiling, once on this machine") == 1 and again.stderr == ""
