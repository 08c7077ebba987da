"""Advice on a rig: each sentence for the rig that deserves it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from handsim import load_rig, look_at
from handsim.space.rig import ROOM_CENTER, list_rigs
from tests.rigs import square_rig
from train import CameraLoss
from train.forecast.rig_score import (
    GRID,
    camera_table,
    faults,
    map_volume,
    score_work,
    work_table,
    working_point,
    write_rig_page,
)


@pytest.fixture(scope="module")
def score(work):
    middle, sides = np.array(ROOM_CENTER), np.full(3, 0.6)
    return score_work(load_rig("six"), {"all kinds": work}, middle, sides, described_as="a <test>")


def with_missing(one, missing, **more):
    return dataclasses.replace(one, missing=missing, ghosts=0.0, **more)


@pytest.fixture
def good(score):
    """A rig without faults, each of whose cameras is needed."""
    whole = with_missing(score.whole, 0.01)
    losses = [CameraLoss(0.5, 0.1, with_missing(score.whole, 0.1 + 0.01 * n)) for n in range(6)]
    volume = score.volume._replace(seen_by_two=np.full(125, 0.98))
    return dataclasses.replace(score, whole=whole, kinds={"a": whole}, losses=losses, volume=volume)


def test_of_a_good_rig_only_the_camera_that_matters_most_is_told(good):
    assert good.advice == [
        "Camera 6 matters most: without it 15.0 % of the marker-frames are missing, not 1.0 %."
    ]


def test_idle_cameras_can_go(good):
    losses = list(good.losses)
    losses[2] = CameraLoss(0.4, 0.001, with_missing(good.whole, 0.0104))
    losses[4] = CameraLoss(0.4, 0.001, with_missing(good.whole, 0.0102))
    losses[0] = CameraLoss(0.4, 0.001, with_missing(good.whole, 0.02))
    sentence = dataclasses.replace(good, losses=losses).advice[1]
    assert sentence.startswith("Camera 5 can go: it sees 0.1 % of the marker-frames that no two others see")
    assert "So can any one of 3;" in sentence


def test_missing_markers_bad_corners_and_ghosts_are_told(good):
    whole = dataclasses.replace(good.whole, missing=0.2, ghosts=1.5)
    shares = np.full(125, 0.98)
    shares[7] = 0.3
    volume = good.volume._replace(seen_by_two=shares)
    kinds = {"a": good.whole, "b": whole}
    advice = dataclasses.replace(good, whole=whole, volume=volume, kinds=kinds).advice
    assert advice[0].startswith("20.0 % of the marker-frames will be missing, most with b (20 %)")
    assert "two cameras see 30 % of a hand's markers, 98 % at the best place" in advice[1]
    assert advice[-1].startswith("1.5 points a frame will be no marker, most with b (1.5)")


def test_a_long_error_names_its_axis(good):
    error = good.whole.error._replace(
        axes=np.array([0.002, 0.0005, 0.0004]), directions=np.array([[0.1, 0.99, 0.0], [1, 0, 0], [0, 0, 1]])
    )
    advice = dataclasses.replace(good, whole=dataclasses.replace(good.whole, error=error)).advice
    assert advice[-1].startswith("Points are least certain along y, 2.00 mm against 0.40 mm")


def test_two_cameras_are_both_needed(good):
    losses = [CameraLoss(0.9, 0.9, None)] * 2
    advice = dataclasses.replace(good, losses=losses).advice
    assert advice == ["Without either camera there are no points at all: a third would forgive a loss."]
    assert camera_table(dataclasses.replace(good, losses=losses))[1][3] == "-"


def test_the_page_has_tables_and_pictures_and_the_record_every_figure(score, tmp_path):
    path = tmp_path / "page.html"
    write_rig_page(path, score)
    page = path.read_text("utf-8")
    assert page.count("data:image/svg+xml") == 2 and "a &lt;test&gt;" in page
    assert len(work_table(score)) == 2 and len(camera_table(score)) == 7
    record = score.record()
    assert record["all"]["missing"] == score.whole.missing
    assert len(record["all"]["error_directions"]) == 3 and len(record["volume"]["error"]) == 125
    assert len(record["without_camera"]) == 6 and record["without_camera"][3]["seen"] > 0.1


def test_the_middle_is_seen_and_far_away_is_not(work):
    sides = np.array([6.0, 0.4, 0.4])
    found = map_volume(work, load_rig("figure5"), np.array(ROOM_CENTER), sides, rng=np.random.default_rng(0))
    assert len(found.points) == GRID**3
    middle, ends = np.abs(found.points[:, 0]) < 0.1, np.abs(found.points[:, 0]) > 2.9
    assert found.seen_by_two[middle].mean() > 0.95 > found.seen_by_three[ends].mean()
    assert found.seen_by_two[ends].mean() < 0.6
    assert (found.seen_by_three <= found.seen_by_two).all()
    assert 0.0 < np.nanmean(found.error[middle]) < 0.001
    assert np.isnan(found.error[ends]).any() or np.nanmean(found.error[ends]) > np.nanmean(
        found.error[middle]
    )


@pytest.mark.parametrize("name", list_rigs())
def test_shipped_rigs_look_at_the_hands_and_have_no_faults(name):
    assert working_point(load_rig(name)) == pytest.approx([0.0, 0.0, 1.1], abs=1e-6)
    assert faults(load_rig(name)) == []


def with_cameras(change, name="six"):
    rig = load_rig(name)
    poses = rig.T_world_camera.copy()
    change(poses)
    return square_rig(rig.name, poses)


def test_opengl_axes_and_a_camera_upside_down_are_told():
    def back(poses):
        poses[:, :3, 1:3] *= -1.0

    def upside_down(poses):
        poses[2, :3, :2] *= -1.0

    assert "OpenGL" in faults(with_cameras(back))[0]
    (sentence,) = faults(with_cameras(upside_down))
    assert sentence.startswith("camera 3 is upside down")


def test_close_low_and_near_cameras_are_told():
    def move(poses):
        poses[0] = look_at(poses[1, :3, 3] + [0.03, 0.0, 0.0], np.array([0.0, 0.0, 1.1]))
        poses[2] = look_at(np.array([1.0, -1.0, -0.2]), np.array([0.0, 0.0, 1.1]))
        poses[3] = look_at(np.array([0.4, 0.0, 1.1]), np.array([0.0, 0.0, 1.1]))

    found = faults(with_cameras(move))
    assert any(one.startswith("cameras 1 and 2 are 3 cm apart") for one in found)
    assert any(one.startswith("camera 3 is 0.20 m below the floor") for one in found)
    assert any(one.startswith("camera 4 is 0.10 m from the cube") for one in found)


def test_a_narrow_far_and_shifted_rig_is_told():
    middle = np.array([4.0, 0.0, 1.1])
    poses = np.stack([look_at(middle + [9.0, side, 0.0], middle) for side in (-0.5, 0.5)])
    found = faults(square_rig("narrow", poses, resolution=320))
    assert any("no two cameras see the middle at more than 6 deg" in one for one in found)
    assert any("the cameras look at (4.00, 0.00, 1.10) m" in one for one in found)
    assert any(one.startswith("camera 1 sees a marker of 6.4 mm as 0.2 px") for one in found)
