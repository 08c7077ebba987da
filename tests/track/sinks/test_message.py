"""Messages hold what the tracker found, and names for every number."""

from __future__ import annotations

import numpy as np

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES


def test_every_number_has_a_name(message):
    one = message()
    header = one.header
    assert header.sides == tuple(hand.side for hand in one.hands) == ("right", "left")
    assert header.angles == JOINT_NAMES and one.hands[0].angles.shape == (len(header.angles),)
    assert one.hands[0].positions.shape == (len(header.positions), 3)
    assert header.bodies == tuple(body.name for body in one.bodies) == ("mug",)
    assert header.markers[0] == "right:" + load_layout("dense19").names[0]
    assert header.markers[19].startswith("left:") and header.markers[38].startswith("mug:")
    assert message(1).header is header


def test_joint_positions_are_those_of_the_pose(message):
    one = message()
    for hand in one.hands:
        qpos = np.concatenate([hand.position, hand.quaternion, hand.angles])
        bones = nominal_fit(load_layout("dense19"), "M", hand.side).model.forward_kinematics(qpos[None])[0]
        place = dict(zip(one.header.positions, hand.positions, strict=True))
        np.testing.assert_allclose(place["wrist"], hand.position, atol=1e-12)
        for joint, bone in (("thumb_CMC", "thumb_metacarpal"), ("index_PIP", "index_middle"),
                            ("little_DIP", "little_distal")):  # fmt: skip
            np.testing.assert_allclose(place[joint], bones[BONE_NAMES.index(bone), :3, 3], atol=1e-12)
        tip = np.linalg.inv(bones[BONE_NAMES.index("ring_distal")]) @ [*place["ring_tip"], 1.0]
        assert tip[0] > 0.015 and abs(tip[1:3]).max() < 1e-9, "ahead of its bone"


def test_a_lost_hand_has_no_numbers(message):
    one = message(lost=True)
    assert [hand.has_pose for hand in one.hands] == [True, False] and not one.bodies[0].has_pose
    lost = one.hands[1]
    for values in (lost.position, lost.quaternion, lost.angles, lost.positions):
        assert np.isnan(values).all()
