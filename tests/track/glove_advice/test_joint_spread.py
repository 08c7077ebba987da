"""The forecast of a joint's error, against the errors that the solver really makes."""

from __future__ import annotations

import dataclasses

import numpy as np

from gloves.fit import attach
from gloves.layout import load_layout
from handsim.hand.model import HandModel
from handsim.hand.shape import JOINTS
from poses.shapes import sample_poses
from track.glove_advice.joint_spread import NOISE, joint_spreads, pose_spreads, untold_spreads
from track.kinematics.pose_solver import PoseSolver


def test_the_forecast_is_the_error_of_the_solver(rng):
    """Flexions that three markers tell of; noise of the forecast's size is added to true markers."""
    fit = attach(load_layout("starter30"), HandModel.named("M"))
    qpos = sample_poses(fit.model, 300, rng=rng)
    markers = fit.markers(qpos)[0]
    seen = np.ones(markers.shape[:2], dtype=bool)
    forecast = pose_spreads([(fit, qpos, seen)])
    solved = PoseSolver(fit).solve(markers + NOISE * rng.standard_normal(markers.shape), qpos).qpos
    measured = np.sqrt(((solved - qpos)[:, 7:] ** 2).mean(axis=0))
    ratios = measured / forecast
    assert 1 / 1.3 < np.median(ratios) < 1.3
    assert (ratios > 0.4).all() and (ratios < 2.5).all()


def test_more_markers_leave_less_open(rng):
    model = HandModel.named("M")
    qpos = sample_poses(model, 40, rng=rng)
    few, many = (
        pose_spreads([(attach(load_layout(name), model), qpos, np.ones((40, count), dtype=bool))])
        for name, count in (("starter10", 10), ("starter30", 30))
    )
    assert (many < few).all()
    assert (few <= untold_spreads() + 1e-9).all()


def test_a_finger_without_markers_is_known_as_far_as_its_neighbors_tell():
    """All markers on the palm: nothing is known of the fingers."""
    layout = load_layout("starter30")
    palm = tuple(marker for marker in layout.markers if marker.bone == "palm")
    fit = attach(dataclasses.replace(layout, markers=palm), HandModel.named("M"))
    qpos = np.zeros((1, 27))
    qpos[:, 3] = 1.0
    spreads = pose_spreads([(fit, qpos, np.ones((1, len(palm)), dtype=bool))])
    fingers = [number for number, joint in enumerate(JOINTS) if not joint.name.startswith("thumb")]
    # The skin of the palm moves a little with the first joints of the fingers.
    np.testing.assert_allclose(spreads[fingers][2::4], untold_spreads()[fingers][2::4], rtol=0.01)
    np.testing.assert_allclose(spreads[fingers][3::4], untold_spreads()[fingers][3::4], rtol=0.01)


def test_a_tip_that_is_never_seen_costs_its_finger(tips, tips_hands):
    tip = tips.names.index("IndexTip")
    joints = [number for number, joint in enumerate(JOINTS) if joint.name.startswith("index")]
    others = [number for number, joint in enumerate(JOINTS) if joint.name.startswith("little")]
    lost = joint_spreads(tips_hands, without=tip) - joint_spreads(tips_hands)
    assert lost[joints].max() > 5 * max(1e-3, lost[others].max())
