"""Tables 5 and 7, and few cameras: the paper's figures, and those of our tracker."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.paper.printed import CAMERAS, HAN, TABLE3, TABLE5, TABLE7
from benchmarks.paper.take_evaluation import TrackingReport
from benchmarks.paper.tracking_tables import (
    TRACKING_TABLES,
    USERS,
    errors_by_occlusion,
    measure,
    measure_with_body,
    table_figures,
)
from benchmarks.record import run_commands
from train import load_labeler, simulate_take
from train.simulation.room import TWINS
from train.simulation.scenes import KINDS


def test_the_papers_tables_agree_with_each_other():
    assert tuple(TABLE3) == KINDS
    for kind in KINDS:
        assert TABLE3[kind].frames == TWINS[kind].num_frames
        valid, right = TABLE7["calibrated"][kind]
        assert TABLE5[HAN][kind] == pytest.approx(valid * right, abs=0.01 if kind == "hand-pen" else 4e-4)
        assert (valid * right) > np.prod(TABLE7["uncalibrated"][kind])
    assert np.prod(CAMERAS) == pytest.approx(0.882, abs=5e-4)


@pytest.mark.slow
def test_both_kinds_of_hands_are_measured():
    takes = {kind: simulate_take(kind=kind, num_frames=6).without_body() for kind in KINDS}
    measured = measure(takes, load_labeler("dense19"))
    assert set(measured) == set(USERS)
    kept = {name: value for name, (_, value) in table_figures(measured).items()}
    for key in ("true", "size"):
        assert len(kept[f"right_{key}"]) == len(kept[f"valid_{key}"]) == len(KINDS)
    assert kept["right_true"][0] == 100.0 and kept["valid_true"][0] == [100.0, 100.0]
    assert kept["errors_true"][0][0] < 0.5 < kept["errors_size"][0][0]


def test_errors_are_means_over_poses():
    def report(missing: int, joint: float, poses: int) -> TrackingReport:
        true = np.ones(poses, dtype=bool)
        errors = np.full((poses, 1), joint)
        return TrackingReport(true, true, np.full((poses, 1), missing), errors, 2 * errors)

    errors = errors_by_occlusion([report(0, 0.001, 3), report(0, 0.005, 1), report(4, 0.007, 2)])
    assert errors[0] == pytest.approx([2.0, np.rad2deg(0.004)])
    assert errors[2] == pytest.approx([7.0, np.rad2deg(0.014)])
    assert np.isnan([errors[1], errors[3]]).all()


@pytest.mark.slow
def test_few_cameras(capsys):
    assert run_commands("benchmarks.paper", "", TRACKING_TABLES, ["cameras", "--num-frames", "8"]) == 0
    said = capsys.readouterr().out
    take = simulate_take(kind="single-hand", num_frames=8, rig="six")
    missing = 100 * (1.0 - take.markers_present().mean())
    assert f"before rig six [%]: {missing:.6g}" in said
    assert "Han 2018, calibrated: valid, right of these [%]: [95.55, 92.32]" in said
    assert all(f": handsim, {users}: [" in said for users in USERS)


@pytest.mark.slow
def test_a_body_that_is_followed_must_have_its_labels():
    labeler = load_labeler("dense19")
    take = simulate_take(kind="hand-controller", num_frames=20)
    assert measure_with_body(take, labeler) == dict.fromkeys(USERS, 100.0)
    labels = take.labels.copy()
    labels[7][labels[7] == take.hand_labels[-1].stop + 1] = -1
    other = dataclasses.replace(take, labels=labels)
    assert measure_with_body(other, labeler)["calibrated"] == 95.0
