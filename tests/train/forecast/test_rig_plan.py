"""The search for a rig against trying everything, and the views of candidates against a rig's own."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim import CameraRig, load_rig
from handsim.errors import ArgumentError
from handsim.space.camera import pinhole
from train import plan_rig
from train.forecast.rig_forecast import light_work
from train.forecast.rig_plan import Planning, places, view_candidates
from train.forecast.settings import MOUNTS

CENTER, SIDES = np.array([0.3, -0.2, 1.1]), np.full(3, 0.6)


@pytest.fixture(scope="module")
def candidates(work):
    """Ten of the sixteen cameras of `figure5`, as candidates."""
    ten = [load_rig("figure5").cameras[number] for number in (0, 2, 4, 6, 8, 10, 11, 13, 14, 15)]
    return ten, view_candidates([one.faster(4) for one in work], ten, rng=np.random.default_rng(0))


def seen_of(views):
    flags = np.unpackbits(views.bits.view(np.uint8), axis=1).astype(bool)
    assert not flags[:, views.num_marker_frames :].any()
    return flags[:, : views.num_marker_frames].T


def test_candidates_see_what_a_rig_of_them_sees(candidates, work):
    ten, views = candidates
    rig = CameraRig("ten", ten)
    lit = light_work({"calibration": [one.faster(4) for one in work]}, rig, rng=np.random.default_rng(0))
    expected = np.concatenate([one.seen.reshape(-1, 10) for one in lit["calibration"]])
    seen = seen_of(views)
    assert seen.shape == expected.shape
    assert (seen == expected).mean() > 0.98  # the visible spots are drawn anew
    turn = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    tilted = [one.at(one.T_world_camera @ turn) for one in ten]
    away = view_candidates(work[:1], tilted, rng=np.random.default_rng(0))
    assert not away.bits.any() and not away.information.any()


def test_the_search_finds_the_best_of_all_choices(candidates):
    ten, views = candidates
    search = Planning(views)
    values = {chosen: search.value_of(chosen) for chosen in itertools.combinations(range(len(ten)), 4)}
    steps = []
    search.grow(4)
    search.exchange(steps.append)
    assert steps == sorted(steps)
    assert search.value_of(search.chosen) == pytest.approx(values[tuple(sorted(search.chosen))])
    assert search.value_of(search.chosen) > max(values.values()) - 0.003
    assert search.value_of(search.chosen) > np.percentile(list(values.values()), 95)


def test_the_value_is_that_of_shares_and_errors(candidates):
    _, views = candidates
    search = Planning(views)
    count = seen_of(views)[:, [1, 5, 7]].sum(axis=1)
    shares = [(count >= level).mean() for level in (1, 2, 3, 4)]
    told = views.information[:, [1, 5, 7]].sum(axis=1).astype(float)
    errors = []
    for a, b, c, d, e, f in told.T:
        matrix = np.array([[a, b, c], [b, d, e], [c, e, f]])
        good = np.linalg.matrix_rank(matrix) == 3 and np.linalg.cond(matrix) < 1e5
        errors.append(min(1.5, np.sqrt(np.trace(np.linalg.inv(matrix)))) if good else 1.5)
    expected = np.dot(shares, (0.02, 0.4, 0.6, 0.05)) - 0.15 * np.mean(errors)
    assert search.value_of([1, 5, 7]) == pytest.approx(expected, abs=2e-3)
    assert search._values_with([1, 5])[7] == pytest.approx(search.value_of([1, 5, 7]), abs=1e-6)


def test_kept_cameras_stay_and_too_many_have_no_room(candidates):
    _, views = candidates
    search = Planning(views, kept=[3, 8])
    search.grow(5)
    search.exchange()
    assert search.chosen[:2] == [3, 8] and len(set(search.chosen)) == 5
    with pytest.raises(ArgumentError, match=r"there is room for 10 cameras 0\.3 m apart, expected 11"):
        search.grow(11)


@pytest.mark.slow
def test_a_plan_beats_cameras_in_a_row():
    old = CameraRig("row", load_rig("figure5").cameras[:2])
    wide = pinhole("wide", (1664, 1088), 1188.0)
    found = plan_rig(
        4, (2.4, 1.8, 2.2), mounts=("truss",), camera=wide, keep=old, glove="tips8", name="new"
    )  # fmt: skip
    assert found.rig.cameras[:2] == old.cameras
    assert [(one.name, one.size) for one in found.rig.cameras[2:]] == [
        ("camera3", wide.size),
        ("camera4", wide.size),
    ]
    assert len(found.rig.positions) == len(found.targets) == 4
    assert found.after.seen_by_two > found.before.seen_by_two + 0.1


@given(st.sampled_from(MOUNTS), st.floats(2.2, 9.0), st.floats(2.2, 9.0), st.floats(2.0, 4.0))
def test_places_lie_on_their_mount(mount, width, depth, height):
    room = np.array([width, depth, height])
    poses, targets = places(room, (mount,), CENTER, SIDES)
    assert len(targets) <= 400
    away = poses[:, :3, 3] - [*CENTER[:2], 0.0]
    assert (np.abs(away[:, :2]) <= room[:2] / 2 + 1e-5).all()
    assert (away[:, 2] > 0.4).all() and (away[:, 2] < height).all()
    inset = {"walls": 0.1, "truss": 0.0}.get(mount)
    if inset is not None:
        edge = room[:2] / 2 - inset - np.abs(away[:, :2])
        assert np.abs(edge).min(axis=1) == pytest.approx(0.0, abs=1e-5)
    outside = poses[:, :3, 3] - np.clip(poses[:, :3, 3], CENTER - 0.3, CENTER + 0.3)
    assert (np.linalg.norm(outside, axis=1) >= 0.25).all()
    ahead = targets - poses[:, :3, 3]
    cosine = np.einsum("ki,ki->k", ahead, poses[:, :3, 2]) / np.linalg.norm(ahead, axis=1)
    assert cosine == pytest.approx(1.0)


def test_cameras_look_about_in_a_long_volume():
    room = np.array([6.0, 4.0, 3.0])
    _, narrow = places(room, ("walls",), CENTER, SIDES)
    _, wide = places(room, ("walls",), CENTER, np.array([3.0, 0.6, 0.6]))
    assert len(wide) == 3 * len(narrow)
    assert sorted(set(wide[:, 0].round(6))) == pytest.approx([-0.6, 0.3, 1.2])


def test_a_room_that_hands_fill_is_refused():
    with pytest.raises(ArgumentError, match=r"no place on walls is 0.25 m or more from the volume of"):
        places(np.array([0.9, 0.9, 1.5]), ("walls",), CENTER, np.array([2.0, 2.0, 3.0]))
