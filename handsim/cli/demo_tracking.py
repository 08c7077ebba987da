"""The demo's step of this package: track a simulated capture of two hands."""

from __future__ import annotations

from typing import Final

import numpy as np

from handsim.app.page import Section
from handsim.cli.demo_run import GLOVE, DemoRun
from track.capture_tracking import track_capture
from track.evaluation.take_evaluation import true_users
from track.tracker import Tracker
from train.labelers.storage import load_labeler
from train.simulation.takes import TakeConfig, simulate_take

_FRAMES: Final = 120


def track_take(run: DemoRun) -> Section:
    """Track a simulated capture and say how far its joints are off."""
    run.report("tracking a simulated capture")
    take = simulate_take(TakeConfig(kind="hand-hand", num_frames=_FRAMES, seed=run.seed))
    tracked = track_capture(take.capture(), Tracker(true_users(take), load_labeler(GLOVE)))
    tracked.save(run.tracked_take)
    errors = []
    for number, hand in enumerate(take.hands):
        model, found = hand.model, tracked.motion(hand.side).qpos
        joints = [model.forward_kinematics(qpos)[..., :3, 3] for qpos in (found, take.qpos[:, number])]
        errors.append(1e3 * np.linalg.norm(joints[0] - joints[1], axis=-1).mean())
    return Section(
        "Tracking",
        f"A simulated capture of two hands, {_FRAMES} frames, is labeled and tracked. The mean error of the "
        f"joints is {np.mean(errors):.2f} mm.",
    )
