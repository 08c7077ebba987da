"""Messages hold what the tracker found and a name for every number, also as JSON and MessagePack."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES
from track.live_message import FORMATS, document_format, frame_document, header_document

DECODE = {"json": json.loads, "msgpack": msgpack.unpackb}


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(number=st.integers(0, 2**40), seed=st.integers(0, 99), lost=st.booleans(), points=st.integers(0, 9))
def test_a_frame_comes_back(name, message, number, seed, lost, points):
    one = message(number, seed=seed, lost=lost, points=points)
    there = DECODE[name](document_format(name, points=True).frame(one))
    assert there == frame_document(one, points=True)
    assert (there["type"], there["schema"], there["number"]) == ("frame", 1, number)
    assert there["time"] == one.time and there["silent"] is False
    for hand, sent in zip(there["hands"], one.hands, strict=True):
        assert (hand["side"], hand["status"]) == (sent.side, str(sent.status))
        if sent.has_pose:
            np.testing.assert_allclose(hand["wrist"]["position"], sent.position, atol=6e-7)
            np.testing.assert_allclose(hand["wrist"]["quaternion"], sent.quaternion, atol=6e-7)
            np.testing.assert_allclose(hand["angles"], sent.angles, atol=6e-7)
            np.testing.assert_allclose(hand["positions"], sent.positions, atol=6e-7)
            np.testing.assert_allclose(hand["angle_spread"], sent.angle_spread, atol=6e-7)
            np.testing.assert_allclose(hand["position_spread"], sent.position_spread, atol=6e-7)
        else:
            assert hand["wrist"] is hand["angles"] is hand["positions"] is None
            assert hand["angle_spread"] is hand["position_spread"] is None
    assert (there["bodies"][0]["pose"] is None) == lost
    np.testing.assert_allclose(np.reshape(there["points"], (-1, 3)), one.points, atol=6e-7)
    assert there["labels"] == one.labels.tolist()


@pytest.mark.parametrize("name", FORMATS)
def test_the_header_names_everything(name, message):
    header = message().header
    document = DECODE[name](document_format(name).header(header))
    assert (document["type"], document["schema"]) == ("header", 1)
    assert document["units"] == {"length": "m", "angle": "rad", "time": "s", "quaternion": "wxyz"}
    for key in ("sides", "angles", "positions", "bodies", "markers"):
        assert document[key] == list(getattr(header, key))


def test_a_frame_of_two_hands_takes_three_kilobytes_and_has_points_only_if_asked_for(message):
    assert not {"points", "labels"} & set(frame_document(message()))
    assert len(document_format("msgpack").frame(message())) < 3000
    assert len(document_format("json").frame(message())) < 3500


def test_the_page_shows_what_is_sent(message):
    """Keys and kinds of values in docs/live_output.md are those of real documents."""
    page = Path(__file__).parents[2] / "docs" / "live_output.md"
    shown = [json.loads(block) for block in re.findall(r"```json\n(.*?)```", page.read_text(), re.DOTALL)]
    one = message(lost=True)
    header, frame = header_document(one.header), frame_document(one)
    assert [set(block) for block in shown] == [set(header), set(frame)]
    assert shown[0]["source"] == header["source"] and shown[0]["units"] == header["units"]
    for key in ("sides", "angles", "positions", "markers"):
        assert shown[0][key][0] == header[key][0]
    for hand, real in zip(shown[1]["hands"], frame["hands"], strict=True):
        assert {key: type(value) for key, value in hand.items()} == {
            key: type(value) for key, value in real.items()
        }
    assert set(shown[1]["bodies"][0]) == set(frame["bodies"][0])


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
