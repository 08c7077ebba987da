"""A browser's half of the viewer: it reads what is sent to the page and keeps what the page would show."""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from gloves import RigidBody, Take, load_layout
from gloves.fit import nominal_fit
from gloves.takes.take import COASTING, LOST, TRACKED
from handsim import join_qpos
from handsim.space.objects import named_object
from handsim.space.transforms import random_quaternions
from poses import sample_poses
from tests.waiting import wait_for
from track.streams import LOOPBACK
from track.viewer import opened_server

FRAMES = 30
_MARKS = itertools.count()


class Page:
    """What a browser knows: nodes by name, their poses, their bones' poses, and the panel's elements."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.nodes: dict[str, dict] = {}
        self.places: dict[str, np.ndarray] = {}
        self.turns: dict[str, np.ndarray] = {}
        self.bones: dict[str, dict[int, dict]] = defaultdict(lambda: defaultdict(dict))
        self.hidden: set[str] = set()
        self.panel: dict[str, dict] = {}
        self.camera: dict[str, np.ndarray] = {}
        self.counts: Counter[str] = Counter()
        self.bytes = 0
        self._server, self._mark = server, ""
        self._socket = connect(
            f"ws://{server.get_host()}:{server.get_port()}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            compression=None,
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.send("ViewerCameraMessage", wxyz=(1, 0, 0, 0), position=(1, 1, 1), fov=1.0, near=0.1, far=10.0,
                  image_height=100, image_width=100, look_at=(0, 0, 0), up_direction=(0, 0, 1))  # fmt: skip
        self.settle()

    def send(self, kind: str, **values: object) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def press(self, label: str, value: object = True) -> None:
        """Give an element of the panel a value, as a person does."""
        (uuid,) = [uuid for uuid, props in self.panel.items() if props.get("label") == label]
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def settle(self, quiet: float = 0.3) -> None:
        """Wait until all that the server was to send is here, and nothing more comes."""
        mark = f"mark {next(_MARKS)}"
        self._server.gui.set_panel_label(mark)  # sent after all that waits
        self.wait(lambda: self._mark == mark)
        seen = -1
        while seen != self.bytes:
            seen = self.bytes
            time.sleep(quiet)

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until something is so."""
        wait_for(condition)

    def says(self, words: str) -> bool:
        """Whether a text of the panel has these words."""
        return any(words in props.get("_markdown", "") for props in list(self.panel.values()))

    def close(self) -> None:
        self._socket.close()
        self._thread.join()

    def skin(self, name: str) -> np.ndarray:
        """The vertices of a skinned mesh as the page's graphics card computes them [m]."""
        shapes = {"vertices": 3, "bone_positions": 3, "bone_wxyzs": 4, "skin_indices": 4, "skin_weights": 4}
        props = {key: self.nodes[name][key].reshape(-1, width) for key, width in shapes.items()}
        bind = rigid(props["bone_positions"], props["bone_wxyzs"])
        poses = bind.copy()
        for number, bone in self.bones[name].items():
            place = bone.get("position", props["bone_positions"][number])
            poses[number] = rigid(place, bone.get("wxyz", props["bone_wxyzs"][number]))
        world = rigid(self.places[name], self.turns[name])
        motion = (world @ poses @ np.linalg.inv(bind))[props["skin_indices"]]
        homogeneous = np.insert(props["vertices"], 3, 1.0, axis=1)
        moved = np.einsum("vwij,vj->vwi", motion, homogeneous)
        return np.einsum("vw,vwi->vi", props["skin_weights"], moved)[:, :3]

    def _listen(self) -> None:
        try:
            while True:
                raw = self._socket.recv()
                for message in decoded(raw):
                    self._take(message)
                self.bytes += len(raw)
        except ConnectionClosed:
            return

    def _take(self, message: dict) -> None:
        kind, name = message["type"], message.get("name")
        if kind == "SetGuiPanelLabelMessage":
            self._mark = message["label"]
            return
        self.counts[kind] += 1
        if kind == "SetBonePositionMessage":
            self.bones[name][message["bone_index"]]["position"] = message["position"]
        elif kind == "SetBoneOrientationMessage":
            self.bones[name][message["bone_index"]]["wxyz"] = message["wxyz"]
        elif kind == "SetPositionMessage":
            self.places[name] = np.array(message["position"])
        elif kind == "SetOrientationMessage":
            self.turns[name] = np.array(message["wxyz"])
        elif kind == "SetSceneNodeVisibilityMessage":
            (self.hidden.discard if message["visible"] else self.hidden.add)(name)
        elif kind in ("SetCameraPositionMessage", "SetCameraLookAtMessage"):
            key = "look_at" if "LookAt" in kind else "position"
            self.camera[key] = np.array(message[key])
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(name, None)
        elif kind == "SceneNodeUpdateMessage":
            self.nodes[name] |= message["updates"]
        elif kind == "GuiUpdateMessage":
            self.panel[message["uuid"]] |= message["updates"]
        elif "uuid" in message and "props" in message:
            self.panel[message["uuid"]] = message["props"] | {"value": message.get("value")}
        elif name is not None and "props" in message:
            self.nodes[name] = dict(message["props"])


def decoded(raw: bytes) -> list[dict]:
    """The messages of a packet, with their arrays, which are flat."""
    length = int.from_bytes(raw[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))
    buffers, start = [], 16 + length
    for size in content["binaryBufferLengths"]:
        start += -start % 8
        buffers.append(raw[start : start + size])
        start += size

    def restored(value: object) -> object:
        if isinstance(value, dict) and "__binary_index" in value:
            return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
        if isinstance(value, dict):
            return {key: restored(entry) for key, entry in value.items()}
        return value

    return [restored(message) for message in content["messages"]]


def rigid(position: np.ndarray, wxyz: np.ndarray) -> np.ndarray:
    """Transforms (..., 4, 4), by the textbook's formula for a rotated vector."""
    q = np.asarray(wxyz, dtype=np.float64)
    w, v = q[..., :1], q[..., 1:]
    T = np.zeros((*q.shape[:-1], 4, 4))
    for axis, unit in enumerate(np.eye(3)):
        T[..., :3, axis] = unit + 2 * w * np.cross(v, unit) + 2 * np.cross(v, np.cross(v, unit))
    T[..., :3, 3], T[..., 3, 3] = position, 1.0
    return T


@pytest.fixture(scope="session")
def _poses() -> np.ndarray:
    rng = np.random.default_rng(7)
    angles = sample_poses(nominal_fit(load_layout("dense19"), "M", "right").model, 2 * FRAMES, rng=rng)
    qpos = join_qpos(
        np.asarray(angles)[:, -20:],
        position=rng.uniform(-0.3, 0.3, (2 * FRAMES, 3)) + [0, 0, 1.1],
        quaternion=random_quaternions(2 * FRAMES, rng=rng),
    )
    return qpos.reshape(FRAMES, 2, 27)


@pytest.fixture
def tracked(_poses) -> Take:
    """Two hands in wild poses, the left one lost in the last frames; a controller, lost in the first one."""
    layout = load_layout("dense19")
    hands = tuple(nominal_fit(layout, size, side) for size, side in (("L", "right"), ("M", "left")))
    status = np.full((FRAMES, 2), TRACKED, dtype=np.int8)
    status[10, 0], status[-5:, 1] = COASTING, LOST
    qpos = np.where((status == LOST)[..., None], np.nan, _poses)
    markers = np.stack([hand.markers(_poses[:, number])[0] for number, hand in enumerate(hands)], axis=1)
    markers = np.where((status == LOST)[..., None, None], np.nan, markers)
    filled = np.zeros((FRAMES, 2, 19), dtype=bool)
    filled[:, 0, 4] = True
    points = np.where(filled[..., None], np.nan, markers).reshape(FRAMES, 38, 3)
    points = np.concatenate([points, np.full((FRAMES, 1, 3), 0.9)], axis=1)
    labels = np.where(np.isfinite(points[..., 0]), np.append(np.arange(38), -1), -1)
    confidence = np.where(np.isfinite(points[..., 0]), 0.99, np.nan)
    confidence[20, 3] = 0.4
    bodies = np.tile([0.1, 0.2, 1.0, 1.0, 0.0, 0.0, 0.0], (FRAMES, 1, 1))
    bodies[0] = np.nan
    body_status = np.where(np.isnan(bodies[..., 0]), LOST, TRACKED).astype(np.int8)
    controller = named_object("controller")
    return Take(
        rate=120.0,
        times=np.arange(FRAMES) / 120.0,
        hands=hands,
        qpos=qpos,
        status=status,
        rms=np.where(status == LOST, np.nan, 1e-3),
        points=points,
        ids=np.where(labels >= 0, labels, -1).astype(np.int32),
        labels=labels.astype(np.int16),
        confidence=confidence,
        bodies=(RigidBody("controller", controller.marker_names, controller.markers),),
        body_poses=bodies,
        body_status=body_status,
        body_rms=np.full((FRAMES, 1), np.nan),
        settings={"tracker": {}},
    )


@pytest.fixture
def simulated(tracked) -> Take:
    """The same hands as a simulated take's truth."""
    qpos = np.where(np.isnan(tracked.qpos), tracked.qpos[:1], tracked.qpos)
    pen = named_object("pen")
    return Take.of_truth(
        tracked.hands,
        qpos,
        tracked.points,
        tracked.ids,
        tracked.labels,
        rate=120.0,
        bodies=[RigidBody("pen", pen.marker_names, pen.markers)],
        body_poses=np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (FRAMES, 1, 1)),
        settings={"rig": "six"},
    )


@pytest.fixture
def server():
    with opened_server(LOOPBACK, 0, "test") as running:
        yield running


@pytest.fixture
def page_of():
    """Opens pages, and closes them at the end."""
    pages: list[Page] = []

    def opened(running: viser.ViserServer) -> Page:
        pages.append(Page(running))
        return pages[-1]

    yield opened
    for page in pages:
        page.close()
