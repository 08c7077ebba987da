from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gloves import RigidBody, Take, attach, load_layout
from handsim import HandModel, join_qpos, sample_shape

FRAMES = 13


@pytest.fixture
def motion(rng: np.random.Generator) -> Take:
    """Two hands and a pen at 60 Hz that turn through all directions; the left hand and the pen have gaps."""
    hands, poses = [], []
    for side in ("right", "left"):
        shape = sample_shape(side=side, rng=rng)
        model = HandModel(dataclasses.replace(shape, arch=[0.1, 0.5]) if side == "right" else shape)
        ranges = model.skeleton.ranges
        angles = ranges[:, 0] + rng.random((FRAMES, 20)) * np.ptp(ranges, axis=1)
        steps = Rotation.from_rotvec(rng.normal(scale=0.6, size=(FRAMES, 3)))
        turns = [Rotation.random(rng=rng)]
        for step in steps[1:]:
            turns.append(turns[-1] * step)
        quaternions = Rotation.concatenate(turns).as_quat(scalar_first=True)
        quaternions *= rng.choice([-1.0, 1.0], size=(FRAMES, 1))  # either sign is the same rotation
        qpos = join_qpos(angles, position=rng.normal(size=(FRAMES, 3)), quaternion=quaternions)
        if side == "left":
            qpos[[0, 1, 5, 6]] = np.nan
        hands.append(attach(load_layout("dense19"), model))
        poses.append(qpos)
    rows = np.concatenate([rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 4))], axis=1)
    rows[7:9] = np.nan
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return Take.of_poses(
        hands,
        np.stack(poses, axis=1),
        rate=60.0,
        times=100.0 + np.arange(FRAMES) / 60.0,
        bodies=[RigidBody(name, (), np.empty((0, 3))) for name in ("pen", "my wand")],
        body_poses=np.stack([rows, rows[::-1]], axis=1),
    )
