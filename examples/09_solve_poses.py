"""Solve the poses of a hand from labeled markers, without a tracker.

    python examples/09_solve_poses.py

This is the inverse kinematics alone: each frame is solved on its own, and missing markers are NaN.
"""

from __future__ import annotations

import numpy as np

from gloves import attach, load_layout
from handsim import HandModel
from poses import sample_poses
from track import solve_pose


def main() -> None:
    rng = np.random.default_rng(0)
    glove = attach(load_layout("dense19"), HandModel.named("M"))
    qpos = sample_poses(glove.model, 100, rng=rng)  # (100, 27)
    markers, _ = glove.markers(qpos)  # (100, 19, 3) [m]
    observed = markers + rng.normal(0.0, 0.0003, markers.shape)
    observed[rng.random((100, 19)) < 0.1] = np.nan  # a tenth is missing
    fit = solve_pose(glove, observed)
    off = np.linalg.norm(glove.markers(fit.qpos)[0] - markers, axis=-1)  # (100, 19) [m]
    missing = np.isnan(observed[..., 0])
    print(f"RMS distance from the observed markers: {1e3 * np.median(fit.rms):.2f} mm (median frame)")
    print(f"observed markers: {1e3 * off[~missing].mean():.2f} mm off the truth")
    print(f"missing markers: {1e3 * off[missing].mean():.2f} mm off the truth")


if __name__ == "__main__":
    main()
