"""A digit's own forward kinematics against the whole hand's."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS, SIDES, bones_of
from handsim.kernels.chain import pose_digit_axes
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses.contact import digit_parts
from poses.shapes import HIGH, LOW


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("digit", range(5))
def test_a_digit_is_where_the_hand_has_it(side, digit, rng):
    model = HandModel.named("L", side=side)
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
