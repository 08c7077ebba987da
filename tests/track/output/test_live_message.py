"""Messages hold what the tracker found and a name for every number, also as JSON and MessagePack."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pythonosc.osc_bundle import OscBundle
from scipy.spatial.transform import Rotation

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim import HandModel, join_qpos
from handsim.errors import ArgumentError
from handsim.hand.model import hand_keypoints
from handsim.hand.shape import BONE_NAMES, DIGITS, JOINT_NAMES
from handsim.motion_files.motion import OPENXR_JOINTS
from handsim.space.transforms import rotation_quaternions
from tests.sentences import error_names
from track import RigidTemplate, Status, StreamedFrame, TrackedBody, TrackedFrame, TrackedHand
from track.output.lab_streaming import channels_of, sample_of
from track.output.live_message import (
    FORMATS,
    LARGEST_DATAGRAM,
    Content,
    MessageEncoder,
    document_format,
    frame_document,
    header_document,
    in_axes,
)
from track.output.osc import osc_format
from track.output.sinks import open_sink

DECODE = {"json": json.loads, "msgpack": msgpack.unpackb}
# In words: what a receiver of each program takes for forward, left and up, and its unit [m].
BY_WORDS = {
    "ros": ((1, 0, 0), (0, 1, 0), (0, 0, 1), 1.0),
    "openxr": ((0, 0, -1), (-1, 0, 0), (0, 1, 0), 1.0),
    "opengl": ((0, 0, -1), (-1, 0, 0), (0, 1, 0), 1.0),
    "unity": ((0, 0, 1), (-1, 0, 0), (0, 1, 0), 1.0),
    "unreal": ((1, 0, 0), (0, -1, 0), (0, 0, 1), 0.01),
}


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(number=st.integers(0, 2**40), seed=st.integers(0, 99), lost=st.booleans(), points=st.integers(0, 9))
def test_a_frame_comes_back(name, message, number, seed, lost, points):
    one = message(number, seed=seed, lost=lost, points=points)
    (sent,) = document_format(name, Content(points=True)).frame(one)
    there = DECODE[name](sent)
    assert there == frame_document(one, Content(points=True))
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
    (sent,) = document_format(name).header(header)
    document = DECODE[name](sent)
    assert (document["type"], document["schema"]) == ("header", 1)
    assert document["units"] == {"length": "m", "angle": "rad", "time": "s", "quaternion": "wxyz"}
    for key in ("sides", "angles", "positions", "digits", "bodies", "markers"):
        assert document[key] == list(getattr(header, key))


def test_a_frame_of_two_hands_takes_three_kilobytes_and_has_points_only_if_asked_for(message):
    assert not {"points", "labels"} & set(frame_document(message()))
    assert sum(map(len, document_format("msgpack").frame(message()))) < 3000
    assert sum(map(len, document_format("json").frame(message()))) < 3500


def put_together(parts: list[dict]) -> dict:
    """The message of which these are the parts, by docs/live_output.md and without handsim's code."""
    whole, hands = {}, {}
    for number, part in enumerate(parts, start=1):
        assert part.pop("part") == number and part.pop("parts") == len(parts)
        for hand in part.get("hands", []):
            mine = hands.setdefault(hand["side"], {})
            mine |= {
                name: mine[name] + value if name == "joints" and mine.get(name) else value
                for name, value in hand.items()
            }
        for name, value in part.items():
            if name != "hands":
                whole[name] = whole.get(name, []) + value if isinstance(value, list) else value
    return whole | ({"hands": list(hands.values())} if hands else {})


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("name", FORMATS)
def test_parts_of_at_most_1400_bytes_hold_everything_between_them(name, lost, message):
    content = Content(points=True, joints=True, velocities=True, axes="unreal")
    largest = 0
    for points in (0, 40, 300):
        one = message(2**31, seed=points, lost=lost, points=points)
        header, frame = header_document(one.header, content), frame_document(one, content)
        divided = document_format(name, content, largest=LARGEST_DATAGRAM)
        for sent, expected in ((divided.header(one.header), header), (divided.frame(one), frame)):
            largest = max(largest, *map(len, sent))
            parts = [DECODE[name](part) for part in sent]
            if "hands" in expected:  # whoever needs poses alone needs no other part
                poses = [hand for part in parts for hand in part.get("hands", []) if "wrist" in hand]
                assert [set(hand) for hand in poses] == [
                    {"side", "status", "seen", "digits", "wrist", "angles", "positions"}
                ] * 2
            whole = put_together(parts)
            assert whole == {key: value for key, value in expected.items() if value != []}
    assert 1000 < largest <= LARGEST_DATAGRAM


def test_velocities_are_those_of_the_moving_hand(message):
    """The hand is moved on by MuJoCo's integrator, and its joints are compared."""
    import mujoco

    one = message(seed=3)
    for hand in one.hands:
        model = nominal_fit("dense19", "M", hand.side).model
        qpos = np.concatenate([hand.position, hand.quaternion, hand.angles])
        velocity = tracked_velocity(hand)
        later = qpos.copy()
        mujoco.mj_integratePos(model.mj_model, later, velocity, 1e-5)
        moved = (hand_keypoints(model, later[None]) - hand_keypoints(model, qpos[None]))[0] / 1e-5
        np.testing.assert_allclose(hand.find_velocities(), moved, atol=1e-3)
        np.testing.assert_array_equal(hand.angle_velocities, velocity[6:])
    document = frame_document(one, Content(velocities=True, axes="unreal"))["hands"][0]
    there = one.hands[0].find_velocities() * [100.0, -100.0, 100.0]
    np.testing.assert_allclose(document["velocities"], there, atol=1e-6)
    assert np.shape(document["angle_velocities"]) == (20,)
    lost = frame_document(message(lost=True), Content(velocities=True))["hands"][1]
    assert lost["velocities"] is lost["angle_velocities"] is None


def tracked_velocity(hand):
    """The velocity that the message was made with."""
    return hand.find_velocities.args[1].velocity


@pytest.mark.parametrize("program", ["world", "ros", "unity", "unreal"])
def test_the_unit_of_length_may_be_chosen(program, message):
    one = message(seed=5)
    sent = {
        unit: frame_document(one, Content(joints=True, axes=program, unit=unit))["hands"][0]
        for unit in ("m", "cm")
    }
    for name in ("positions", "position_spread"):
        np.testing.assert_allclose(100.0 * np.array(sent["m"][name]), sent["cm"][name], atol=6e-5)
    assert sent["m"]["wrist"]["quaternion"] == sent["cm"]["wrist"]["quaternion"]
    assert header_document(one.header, Content(axes=program, unit="cm"))["units"]["length"] == "cm"


def test_latency_counts_from_exposure(message):
    one = message()
    assert np.isnan(one.latency) and frame_document(one)["latency"] is None, "it did not come live"
    now = time.monotonic()
    frame = StreamedFrame(1, 2.0, np.zeros((0, 3)), np.zeros(0, dtype=int), arrived=now - 0.5, latency=0.25)
    live = MessageEncoder([], []).encode(frame, TrackedFrame(2.0, (), np.zeros(0, dtype=int), np.zeros(0)))
    assert live.latency == pytest.approx(live.lag + 0.25) and live.lag >= 0.5


def test_the_page_shows_what_is_sent(message):
    """Keys and kinds of values in docs/live_output.md are those of real documents."""
    page = Path(__file__).parents[3] / "docs" / "live_output.md"
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


def test_fingers_without_markers_are_told():
    """Of the right hand only the palm and the index finger are seen."""
    fits = [nominal_fit("dense19", "M", side) for side in ("right", "left")]
    digits = fits[0].attachment.digits
    filled = np.flatnonzero((digits != 1) & (digits >= 0))
    qpos = join_qpos(np.zeros((1, 20)))[0]
    markers = np.zeros((19, 3))
    hands = [
        TrackedHand("right", Status.TRACKED, qpos, 0.001, markers, filled),
        TrackedHand("left", Status.INITIALIZED, qpos, 0.001, markers, filled[:0]),
    ]
    nobody = np.zeros(0, dtype=int)
    frame = StreamedFrame(0, 0.0, np.zeros((0, 3)), nobody)
    message = MessageEncoder(fits, []).encode(frame, TrackedFrame(0.0, tuple(hands), nobody, np.zeros(0)))
    right, left = frame_document(message)["hands"]
    assert right["digits"] == ["coasting", "tracked", "coasting", "coasting", "coasting"]
    assert right["seen"] == pytest.approx(1.0 - len(filled) / 19, abs=1e-3)
    assert (left["digits"], left["seen"]) == (["found"] * 5, 1.0)
    packets = osc_format().frame(message)
    got = {one.address: list(one.params) for one in OscBundle(packets[0])}
    assert len(packets) == 1 and got["/handsim/right/digits"] == right["digits"]
    assert got["/handsim/right/seen"] == [pytest.approx(right["seen"], abs=1e-3)]
    channels = [label for label, _, _ in channels_of(message.header)]
    sample = dict(zip(channels, sample_of(message), strict=True))
    assert [sample[f"right_{digit}_status"] for digit in DIGITS] == [2.0, 0.0, 2.0, 2.0, 2.0]
    assert sample["right_seen"] == pytest.approx(right["seen"], abs=1e-3)


@pytest.mark.parametrize("lost", [(), ("elbow",), ("arm", "elbow")])
def test_wrists_with_a_forearm_have_angles(lost):
    places = np.array([[-0.06, 0.02, 0.03], [-0.10, -0.025, 0.028], [-0.14, 0.022, 0.033]])
    arm = RigidTemplate("arm", ("A", "B", "C"), places, None, "right", has_axes=True)
    elbow = RigidTemplate("elbow", ("D", "E", "F"), places, elbow="right")
    fits = [nominal_fit("dense19", "M", side) for side in ("right", "left")]
    turn = Rotation.from_euler("YZ", [0.3, -0.2]).as_quat(scalar_first=True)  # flexion, ulnar deviation
    pronated = Rotation.from_euler("x", 1.1).as_quat(scalar_first=True)
    qpos = join_qpos(np.zeros((1, 20)), quaternion=turn)[0]
    nothing = np.zeros((19, 3)), np.zeros(0, dtype=int)
    hands = tuple(TrackedHand(fit.side, Status.TRACKED, qpos, 0.001, *nothing) for fit in fits)
    bodies = tuple(
        TrackedBody(name, Status.TRACKED, np.zeros(3), np.full(4, np.nan) if name in lost else pose, 0.001)
        for name, pose in (("arm", [1.0, 0.0, 0.0, 0.0]), ("elbow", pronated))
    )
    frame, nobody = StreamedFrame(0, 0.0, np.zeros((0, 3)), nothing[1]), nothing[1]
    tracked = TrackedFrame(0.0, hands, nobody, np.zeros(0), bodies)
    one = MessageEncoder(fits, [arm, elbow]).encode(frame, tracked)
    assert one.header.wrist_angles == ("wrist_flexion", "wrist_radial_deviation", "forearm_pronation")
    expected = np.array([np.nan if "arm" in lost else 0.3, np.nan if "arm" in lost else -0.2, 1.1])
    expected[2] = np.nan if lost else 1.1
    np.testing.assert_allclose(one.hands[0].wrist_angles, expected, atol=1e-12)
    assert np.isnan(one.hands[1].wrist_angles).all(), "the left hand has no forearm"
    sent = frame_document(one, Content(axes="unity"))["hands"][0]["wrist_angles"]
    assert sent == [None if np.isnan(angle) else round(angle, 6) for angle in expected]
    assert header_document(one.header)["wrist_angles"] == list(one.header.wrist_angles)
    got = {part.address: list(part.params) for part in OscBundle(osc_format().frame(one)[0])}
    assert ("/handsim/right/wrist_angles" in got) == ("arm" not in lost)
    np.testing.assert_allclose(got.get("/handsim/right/wrist_angles", expected), expected, atol=1e-6)
    assert "/handsim/left/wrist_angles" not in got
    labels = [label for label, _, _ in channels_of(one.header)]
    sample = dict(zip(labels, sample_of(one), strict=True))
    np.testing.assert_allclose([sample[f"right_{name}"] for name in one.header.wrist_angles], expected)


def test_without_axes_or_an_elbow_fewer_angles_are_named():
    places = np.array([[-0.06, 0.02, 0.03], [-0.10, -0.025, 0.028], [-0.14, 0.022, 0.033]])
    arm = RigidTemplate("arm", ("A", "B", "C"), places, None, "right", has_axes=True)
    assert MessageEncoder([], [arm]).header.wrist_angles == ("wrist_flexion", "wrist_radial_deviation")
    plain = MessageEncoder([], [dataclasses.replace(arm, has_axes=False)]).header
    assert plain.wrist_angles == () and "wrist_angles" not in header_document(plain)


def test_hands_that_are_not_measured_are_told_everywhere(message):
    for state in ("", "being measured"):
        one = dataclasses.replace(message(), size_state=state)
        assert frame_document(one)["size_state"] == state
        (bundle,) = osc_format().frame(one)
        told = [list(part.params) for part in OscBundle(bundle) if part.address == "/handsim/size_state"]
        assert told == [[state]] * bool(state)
        labels = [label for label, _, _ in channels_of(one.header)]
        assert sample_of(one)[labels.index("measured")] == (not state)


def as_openxr(position, rotation):
    """A pose in OpenXR's axes (x right, y up, z backward), of a world whose x is forward and z up."""
    turn = Rotation.from_matrix([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    return turn.apply(position), turn * rotation


def as_unity(position, rotation):
    """Unity's OpenXR plugin negates z of positions, and x and y of quaternions."""
    (x, y, z), turned = as_openxr(position, rotation)
    a, b, c, w = turned.as_quat()
    return np.array([x, y, -z]), np.array([w, -a, -b, c])


def as_unreal(position, rotation):
    """Unreal is ROS with y to the right, in centimeters: y of positions, x and z of quaternions negated."""
    a, b, c, w = rotation.as_quat()
    return 100.0 * np.array([position[0], -position[1], position[2]]), np.array([w, -a, b, -c])


BY_HAND = {
    "ros": lambda position, rotation: (position, rotation.as_quat(scalar_first=True)),
    "openxr": lambda *pose: (as_openxr(*pose)[0], as_openxr(*pose)[1].as_quat(scalar_first=True)),
    "opengl": lambda *pose: (as_openxr(*pose)[0], as_openxr(*pose)[1].as_quat(scalar_first=True)),
    "unity": as_unity,
    "unreal": as_unreal,
}


@pytest.mark.parametrize("up", ["z", "y"])
@pytest.mark.parametrize("program", BY_HAND)
def test_poses_are_those_of_each_program(program, up, message):
    z_up = Rotation.from_euler("x", 90 if up == "y" else 0, degrees=True)
    one = message(3, seed=4)
    document = frame_document(one, Content(points=True, joints=True, axes=program, up=up))
    ours = frame_document(one, Content(points=True, joints=True))
    assert len(document["hands"][0]["joints"]) == len(OPENXR_JOINTS)

    def check(sent, position, quaternion):
        expected = BY_HAND[program](
            z_up.apply(position), z_up * Rotation.from_quat(quaternion, scalar_first=True)
        )
        np.testing.assert_allclose(sent[:3], expected[0], atol=2e-4 if program == "unreal" else 2e-6)
        sign = np.sign(np.dot(sent[3:], expected[1]))
        np.testing.assert_allclose(sign * np.array(sent[3:]), expected[1], atol=5e-6)

    for sent, own in zip(document["hands"], ours["hands"], strict=True):
        for found, joint in zip(sent["joints"], own["joints"], strict=True):
            check(found, joint[:3], joint[3:])
        wrist, own_wrist = sent["wrist"], own["wrist"]
        check(wrist["position"] + wrist["quaternion"], own_wrist["position"], own_wrist["quaternion"])
        assert sent["angles"] == own["angles"]
        tip = dict(zip(one.header.positions, sent["positions"], strict=True))["index_tip"]
        at = OPENXR_JOINTS.index("INDEX_TIP")
        np.testing.assert_allclose(tip, sent["joints"][at][:3], atol=2e-4 if program == "unreal" else 3e-6)
    unit = "cm" if program == "unreal" else "m"
    header = header_document(one.header, Content(joints=True, axes=program, up=up))
    assert header["axes"] == program and header["units"]["length"] == unit
    assert 0.003 < header["radii"][0][9] / (100.0 if unit == "cm" else 1.0) < 0.02


@pytest.mark.parametrize("up", ["z", "y"])
@pytest.mark.parametrize("forward", ["x", "-x", "y", "-y", "z", "-z"])
def test_a_hand_that_points_to_the_door_does_so_in_all_worlds(forward, up, message):
    """Positions agree to 0.01 mm and orientations to 0.1 degrees, in forward, left and up."""
    if forward[-1] == up:
        with error_names(ArgumentError, f"forward is {forward} where {up} points up"):
            open_sink(f"udp://127.0.0.1:9?up={up}&forward={forward}")
        return
    door = (-1.0 if forward[0] == "-" else 1.0) * np.eye(3)["xyz".index(forward[-1])]
    above = np.eye(3)["xyz".index(up)]
    hand = HandModel.named("M")
    pointing = np.stack([door, np.cross(above, door), above], axis=1)  # the hand's x, y and z
    qpos = join_qpos(np.zeros((1, 20)), position=0.4 * door, quaternion=rotation_quaternions(pointing[None]))
    positions = hand_keypoints(hand, qpos)[0]
    one = dataclasses.replace(
        message(0).hands[0], position=qpos[0, :3], quaternion=qpos[0, 3:7], positions=positions
    )
    one = dataclasses.replace(message(0), hands=(one,))
    for program, (*directions, unit) in BY_WORDS.items():
        sent = in_axes(one, Content(axes=program, up=up, forward=forward).program).hands[0]
        room = unit * sent.positions @ np.array(directions).T
        own = positions @ pointing  # where forward, left and up are the hand's own axes
        np.testing.assert_allclose(room, own, atol=1e-5)
        w, *xyz = sent.quaternion
        turned = Rotation.from_quat([*xyz, w]).as_matrix()
        # Left-handed programs mirror the hand's own axes, too: z in Unity, y in Unreal.
        mirror = {"unity": (1, 1, -1), "unreal": (1, -1, 1)}.get(program, (1, 1, 1))
        turned = np.array(directions) @ turned @ np.diag(mirror)
        assert np.degrees(Rotation.from_matrix(turned).magnitude()) < 0.1


def test_what_is_lost_has_no_pose_in_any_axes(message):
    one = in_axes(message(lost=True), Content(axes="unity").program)
    document = frame_document(message(lost=True), Content(joints=True, axes="unity"))
    assert [hand.has_pose for hand in one.hands] == [True, False] and not one.bodies[0].has_pose
    lost = one.hands[1]
    assert all(
        np.isnan(array).all() for array in (lost.position, lost.quaternion, lost.angles, lost.positions)
    )
    assert document["hands"][1]["wrist"] is document["hands"][1]["joints"] is None
    assert document["bodies"][0]["pose"] is None
