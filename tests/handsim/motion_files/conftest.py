from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import sample_shape
from handsim.motion_files.hands_in_motion import HandsInMotion, MovingHand, MovingThing
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices

FRAMES = 13


@pytest.fixture
def motion(rng: np.random.Generator) -> HandsInMotion:
    """Two hands and a pen at 60 Hz that turn through all directions; the left hand and the pen have gaps."""
    hands = []
    for side in ("right", "left"):
        model = HandModel(sample_shape(side=side, rng=rng))
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
        hands.append(MovingHand(model, qpos))
    rows = np.concatenate([rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 4))], axis=1)
    rows[7:9] = np.nan
    pen = MovingThing("pen", named_object("pen"), pose_matrices(rows))
    unknown = MovingThing("my wand", None, pose_matrices(rows[::-1]))
    return HandsInMotion(60.0, 100.0 + np.arange(FRAMES) / 60.0, tuple(hands), (pen, unknown))
