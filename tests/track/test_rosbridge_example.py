"""The example of a sink for ROS 2, against a server that takes rosbridge's protocol literally."""

from __future__ import annotations

import importlib
import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from websockets.sync.server import serve

from handsim.hand.shape import JOINT_NAMES
from tests.waiting import wait_for
from track.output.sinks import open_sink

FIELDS = {
    "sensor_msgs/msg/JointState": {"header", "name", "position", "velocity", "effort"},
    "tf2_msgs/msg/TFMessage": {"transforms"},
}


class Server:
    """Takes what clients publish: topics are advertised with their types before, and messages are whole."""

    def __init__(self, port: int = 0) -> None:
        self.types: dict[str, str] = {}
        self.got: list[tuple[str, dict]] = []
        self.clients: list = []
        self._server = serve(self._talk, "127.0.0.1", port)
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _talk(self, client) -> None:
        self.clients.append(client)
        for text in client:
            operation = json.loads(text)
            if operation["op"] == "advertise":
                assert set(operation) == {"op", "topic", "type"} and operation["type"] in FIELDS
                self.types[operation["topic"]] = operation["type"]
            else:
                assert operation["op"] == "publish" and set(operation) == {"op", "topic", "msg"}
                assert set(operation["msg"]) == FIELDS[self.types[operation["topic"]]]
                self.got.append((operation["topic"], operation["msg"]))

    def of(self, topic: str) -> list[dict]:
        return [message for name, message in list(self.got) if name == topic]

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self._server.shutdown()
        for client in self.clients:
            client.close()


@pytest.fixture
def address(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    importlib.invalidate_caches()
    return "rosbridge:Rosbridge?host=127.0.0.1&port={}&up={}"


def seconds(stamp: dict) -> float:
    assert isinstance(stamp["sec"], int) and isinstance(stamp["nanosec"], int) and stamp["nanosec"] < 1e9
    return stamp["sec"] + 1e-9 * stamp["nanosec"]


@pytest.mark.parametrize("up", ["z", "y"])
def test_transforms_and_joints_are_those_of_the_hand(up, address, message):
    one = message(3, seed=4)
    with Server() as server:
        sink = open_sink(address.format(server.port, up))
        began = time.time()
        sink.send(one)
        wait_for(lambda: len(server.got) == 3)
        ended = time.time()
        sink.close()
    transforms = {one["child_frame_id"]: one for one in server.of("/tf")[0]["transforms"]}
    assert set(transforms) == {"right_palm", "left_palm", "mug"}
    z_up = Rotation.from_euler("x", 90 if up == "y" else 0, degrees=True)
    for name, thing in (("right_palm", one.hands[0]), ("left_palm", one.hands[1]), ("mug", one.bodies[0])):
        pose = transforms[name]["transform"]
        there = [pose["translation"][axis] for axis in "xyz"]
        np.testing.assert_allclose(there, z_up.apply(thing.position), atol=1e-12)
        turn = Rotation.from_quat([pose["rotation"][axis] for axis in "xyzw"])
        own = z_up * Rotation.from_quat(thing.quaternion, scalar_first=True)
        assert (turn.inv() * own).magnitude() < 1e-9
        assert transforms[name]["header"]["frame_id"] == "world"
    assert np.isnan([one.lag, one.latency]).all(), (
        "its age is not known, so that it is stamped when it is sent"
    )
    for hand in one.hands:
        (joints,) = server.of(f"/handsim/{hand.side}/joint_states")
        assert tuple(joints["name"]) == JOINT_NAMES
        assert joints["position"] == hand.angles.tolist()
        assert joints["velocity"] == hand.angle_velocities.tolist()
        assert began - 1e-3 <= seconds(joints["header"]["stamp"]) <= ended + 1e-3


def test_stamps_go_on_as_the_cameras_clock_and_what_is_lost_is_left_out(address, message):
    with Server() as server:
        sink = open_sink(address.format(server.port, "z"))
        for number in range(20):
            sink.send(message(number, lost=number == 19))
            wait_for(lambda number=number: sink.published == number + 1)
        wait_for(lambda: len(server.got) == 20 + 20 + 19)
        sink.close()
    stamps = [seconds(one["transforms"][0]["header"]["stamp"]) for one in server.of("/tf")]
    np.testing.assert_allclose(np.diff(stamps), 1 / 120, atol=2e-3)
    assert [one["child_frame_id"] for one in server.of("/tf")[-1]["transforms"]] == ["right_palm"]
    assert len(server.of("/handsim/left/joint_states")) == 19


def test_the_server_may_come_late_and_come_back(address, message, monkeypatch):
    with Server() as first:
        port = first.port
    sink = open_sink(address.format(port, "z"))
    monkeypatch.setattr("rosbridge.RETRY", 0.05)
    for number in range(5):
        sink.send(message(number))
    assert sink.dropped >= 3 and not sink.published
    for _ in range(2):
        with Server(port) as server:

            def arrived(server=server) -> bool:
                sink.send(message(7))
                return len(server.of("/tf")) > 2

            wait_for(arrived)
            assert server.types["/tf"] == "tf2_msgs/msg/TFMessage"
    sink.close()
