"""A sink of your own for ROS 2: tf and joint states, as JSON for a rosbridge server; no ROS is needed here.

On the machine with ROS, and on this one, where a hand that points forward, left and up tries it first:

    ros2 launch rosbridge_server rosbridge_websocket_launch.xml
    cd examples
    handsim doctor --send "rosbridge:Rosbridge?host=192.168.1.7"
    handsim track --live natnet://192.168.1.5 --send "rosbridge:Rosbridge?host=192.168.1.7&up=y" --out a.npz

Joints and frames are those of `handsim hand --side right --out right.urdf`. With `frame_prefix:=right_` and
`joint_states:=/handsim/right/joint_states`, robot_state_publisher shows the right hand.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from gloves import Status, attach
from handsim import HandModel, join_qpos
from track import LiveMessage, StreamedFrame, TrackedFrame, TrackedHand, open_sinks

RETRY = 1.0  # [s] between two attempts to connect
Topic = tuple[str, str, dict[str, Any]]  # name, type and message


class Rosbridge:
    """Publishes the newest frame when the server has taken the one before, and waits for the server."""

    def __init__(
        self, host: str = "localhost", port: str = "9090", up: str = "z", forward: str = "x"
    ) -> None:
        self.url, self.published, self.dropped = f"ws://{host}:{port}", 0, 0
        ahead, above = axis(forward), axis(up)  # to x forward, y left, z up (REP 103)
        self.upright = Rotation.from_matrix(np.stack([ahead, np.cross(above, ahead), above]))
        self.offset = math.nan  # [s] of ROS's time over the camera system's
        self.newest: LiveMessage | None = None
        self.changed, self.closed = threading.Condition(), False
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def send(self, message: LiveMessage) -> None:
        """Called by the tracker with every frame; it must not wait."""
        with self.changed:
            self.dropped += self.newest is not None
            self.newest = message
            self.changed.notify()

    def close(self) -> None:
        """Called at the end."""
        with self.changed:
            self.closed = True
            self.changed.notify()
        self.thread.join(2 * RETRY)

    def run(self) -> None:
        """Connect again and again."""
        while not self.closed:
            with suppress(OSError, WebSocketException):  # the server is not there, or has left
                self.publish()
            with self.changed:
                self.changed.wait_for(lambda: self.closed, RETRY)

    def publish(self) -> None:
        """Publish frame after frame until the connection ends."""
        advertised: set[str] = set()
        with connect(self.url, compression=None, open_timeout=RETRY) as server:
            while True:
                with self.changed:
                    self.changed.wait_for(lambda: self.newest is not None or self.closed)
                    message, self.newest = self.newest, None
                if message is None:
                    return
                for topic, kind, content in self.topics(message):
                    if topic not in advertised:
                        advertised.add(topic)
                        server.send(json.dumps({"op": "advertise", "topic": topic, "type": kind}))
                    server.send(json.dumps({"op": "publish", "topic": topic, "msg": content}))
                server.ping().wait(RETRY)  # nothing old waits in the network
                self.published += 1

    def topics(self, message: LiveMessage) -> Iterator[Topic]:
        """What is published of a frame; hands and bodies that are lost are left out."""
        stamp = self.stamp(message)
        header = {"stamp": {"sec": int(stamp), "nanosec": int(1e9 * (stamp % 1.0))}, "frame_id": "world"}
        hands = [hand for hand in message.hands if hand.has_pose]
        things: list[tuple[str, Any]] = [(f"{hand.side}_palm", hand) for hand in hands]
        things += [(body.name, body) for body in message.bodies if body.has_pose]
        transforms = []
        for name, thing in things:
            place = self.upright.apply(thing.position).tolist()
            turn = (self.upright * Rotation.from_quat(thing.quaternion, scalar_first=True)).as_quat().tolist()
            pose = {"translation": dict(zip("xyz", place, strict=True)),
                    "rotation": dict(zip("xyzw", turn, strict=True))}  # fmt: skip
            transforms.append({"header": header, "child_frame_id": name, "transform": pose})
        if transforms:
            yield "/tf", "tf2_msgs/msg/TFMessage", {"transforms": transforms}
        for hand in hands:
            known = np.isfinite(hand.angle_velocities).all()
            joints = {"name": list(message.header.angles), "position": hand.angles.tolist(), "effort": []}
            joints |= {"header": header, "velocity": hand.angle_velocities.tolist() if known else []}
            yield f"/handsim/{hand.side}/joint_states", "sensor_msgs/msg/JointState", joints

    def stamp(self, message: LiveMessage) -> float:
        """When the frame was exposed, in ROS's time [s]; it goes on as the cameras' clock does."""
        age = next((age for age in (message.latency, message.lag) if math.isfinite(age)), 0.0)
        ahead = time.time() - age - message.time - self.offset
        self.offset = self.offset + 0.001 * ahead if abs(ahead) < 0.5 else time.time() - age - message.time
        return message.time + self.offset


def axis(name: str) -> np.ndarray:
    """The direction of an axis, as x or -z."""
    return (-1.0 if name.startswith("-") else 1.0) * np.eye(3)["xyz".index(name[-1])]


def main() -> None:
    hand, none = attach("dense19", HandModel.named("M")), np.zeros(0, dtype=int)
    sink = Rosbridge()
    with open_sinks([sink]) as sinks:
        sinks.start([hand], [])
        for number in range(60):
            qpos = join_qpos(np.full((1, 20), 0.01 * number), position=np.array([0.0, 0.0, 1.0]))[0]
            shown = TrackedHand("right", Status.TRACKED, qpos, math.nan, np.zeros((19, 3)), none)
            frame = StreamedFrame(number, number / 60, np.zeros((0, 3)), none)
            sinks.send(frame, TrackedFrame(frame.time, (shown,), none, np.zeros(0)))
            time.sleep(1 / 60)
    print(f"{sink.published} frames published at {sink.url}, {sink.dropped} dropped")


if __name__ == "__main__":
    main()
