"""A simulated trial with labeled markers on hand, forearm and elbow, for the commands of docs/angles.md."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gloves import Capture, attach, write_capture
from poses import sample_motion

FOREARM = [[-0.06, 0.02, 0.03], [-0.1, -0.025, 0.028], [-0.14, 0.022, 0.033], [-0.075, -0.03, 0.02]]
LANDMARKS = [[0.0, 0.03, 0.0], [0.0, -0.03, 0.0], [-0.25, 0.035, 0.0], [-0.25, -0.035, 0.0]]
UPPER_ARM = [[-0.34, 0.02, 0.06], [-0.3, -0.03, 0.05]]
NAMES = ("RFA", "RFB", "RFC", "RFD", "RRS", "RUS", "REL", "REM", "RUA", "RUB")


def write_arm_trial() -> None:
    """Write trial.trc: 0.6 s with a straight wrist and a flat hand, then both move."""
    rng = np.random.default_rng(1)
    fit = attach("dense19", "M").with_side("right")
    qpos = np.array(sample_motion(fit.model, 3.0, rng=rng).qpos)
    late = np.clip(np.arange(len(qpos)) / 120 - 0.6, 0.0, None)[:, None]
    turned = Rotation.from_rotvec(0.8 * np.sin(3.0 * late) * [0.0, 1.0, 0.0])
    qpos[:, :3], qpos[:, 3:7] = [0.1, 0.0, 1.0], turned.as_quat(scalar_first=True)
    qpos[:, 7:] *= np.minimum(late, 1.0)
    arm = np.array([*FOREARM, *LANDMARKS, *UPPER_ARM])
    moved = arm + qpos[:, None, :3] + 0.02 * np.sin(late)[:, None]
    qpos[:, :3] += 0.02 * np.sin(late)
    points = np.concatenate([fit.markers(qpos)[0], moved], axis=1)
    points += 0.0002 * rng.standard_normal(points.shape)
    write_capture("trial.trc", Capture((*fit.layout.names, *NAMES), points, 120.0))
