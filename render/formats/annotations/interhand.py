"""InterHand2.6M: `_data.json` (COCO's fields), `_camera.json` and `_joint_3d.json`, in millimeters.

Its 42 joints are 21 of the right hand and 21 of the left, tip first and wrist last. Projections count pixels
from the first one's center, boxes from the picture's corner. A dataset is one capture, "0". Its cameras are
called by numerals, "0", "1", ..., because its loader takes `int` of them; the file has one pose per camera,
so a camera that moves becomes many. Each picture has our name of its camera beside the numeral.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import DatasetError
from handsim.hand.shape import DIGITS, NUM_KEYPOINTS, SIDES, Side
from handsim.space.camera import Camera
from render.formats.annotations import coco
from render.formats.annotations.common import by_side, centered_K, is_seen, rounded, to_json
from render.formats.annotations.joint_orders import to_order
from render.frames import HandTruth, RenderedFrame

SPLIT: Final = "train"
CAPTURE: Final = 0
_ORDER: Final[tuple[Side, Side]] = (SIDES[1], SIDES[0])  # right, left


def picture_record(frame: RenderedFrame, file_name: str) -> dict[str, Any]:
    """The picture, its camera and its joints, still without numbers.

    Raises:
        HandSimError: The camera's lens is not a pinhole, or two hands are of the same side.
    """
    hands = by_side(frame)
    seen = [hand.box for hand in frame.hands if is_seen(hand)]
    joints, valid = _joints(hands)
    kind = "interacting" if len(hands) == 2 else next(iter(hands), "right")
    return {
        "image": {
            "file_name": file_name,
            "width": frame.camera.size[0],
            "height": frame.camera.size[1],
            "capture": CAPTURE,
            "subject": CAPTURE,
            "seq_name": "handsim",
            "frame_idx": frame.number,
        },
        "annotation": {
            "bbox": rounded(_union(seen), 3),
            "joint_valid": valid,
            "hand_type": kind,
            "hand_type_valid": 1,
            "category_id": 1,
            "iscrowd": 0,
        }
        if seen
        else None,
        "camera_name": frame.camera.name,
        "camera": _camera(frame.camera),
        "joints": {
            "world_coord": joints,
            "joint_valid": [[value] for value in valid],
            "hand_type": kind,
            "hand_type_valid": True,
        },
    }


class Cameras:
    """Numerals of the poses that cameras have, in the order of pictures: the same pose, the same one."""

    def __init__(self) -> None:
        self._numerals: dict[str, str] = {}
        self._records: dict[str, Any] = {}

    def numeral(self, record: dict[str, Any]) -> str:
        """What the camera of a record of `picture_record` is called."""
        pose = to_json([record["camera_name"], record["camera"]])
        numeral = self._numerals.setdefault(pose, str(len(self._numerals)))
        self._records[numeral] = record["camera"]
        return numeral

    def table(self) -> dict[str, Any]:
        """Content of `_camera.json`."""
        fields = ("campos", "camrot", "focal", "princpt")
        table = {
            field: {numeral: camera[field] for numeral, camera in self._records.items()} for field in fields
        }
        return {str(CAPTURE): table}


def numbered(
    records: Iterable[dict[str, Any]], cameras: Cameras
) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Images and their annotations with COCO's numbers; annotations are of pictures, not of hands."""

    def with_cameras() -> Iterator[dict[str, Any]]:
        for record in records:
            names = {"camera": cameras.numeral(record), "camera_name": record["camera_name"]}
            annotations = [] if record["annotation"] is None else [record["annotation"]]
            yield {"image": names | record["image"], "annotations": annotations}

    return coco.numbered(with_cameras())


def frames_once(records: Iterable[dict[str, Any]]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Joints of every frame number, however many cameras saw it."""
    known: dict[int, int] = {}
    for record in records:
        number, joints = record["image"]["frame_idx"], record["joints"]
        seal = hash(to_json(joints))
        if number not in known:
            known[number] = seal
            yield number, joints
        elif known[number] != seal:
            raise DatasetError(
                f"two pictures of frame {number} have different hands; interhand holds one take a folder"
            )


def skeleton_lines() -> str:
    """`skeleton.txt`: name, index and parent's index of the 42 joints."""
    lines = ["# joint_name joint_id joint_parent_id"]
    for side_number, side in enumerate(_ORDER):
        first, letter = NUM_KEYPOINTS * side_number, side[0]
        for digit_number, digit in enumerate(DIGITS):
            name = "pinky" if digit == "little" else digit
            for step in range(4):
                index = first + 4 * digit_number + step
                parent = index + 1 if step < 3 else first + NUM_KEYPOINTS - 1
                lines.append(f"{letter}_{name}{4 - step} {index} {parent}")
        lines.append(f"{letter}_wrist {first + NUM_KEYPOINTS - 1} -1")
    return "\n".join(lines) + "\n"


def _joints(hands: dict[Side, HandTruth]) -> tuple[list[list[float]], list[int]]:
    """42 joints in the world [mm], zero for a hand that is not there, and which of them are."""
    joints, valid = np.zeros((2 * NUM_KEYPOINTS, 3)), np.zeros(2 * NUM_KEYPOINTS, dtype=int)
    for number, side in enumerate(_ORDER):
        if side in hands:
            rows = slice(NUM_KEYPOINTS * number, NUM_KEYPOINTS * (number + 1))
            joints[rows], valid[rows] = 1e3 * to_order(hands[side].keypoints_world, "interhand"), 1
    return rounded(joints, 6), valid.tolist()


def _camera(camera: Camera) -> dict[str, Any]:
    K = centered_K(camera)
    return {
        "campos": (1e3 * camera.T_world_camera[:3, 3]).tolist(),
        "camrot": camera.T_world_camera[:3, :3].T.tolist(),
        "focal": [K[0, 0], K[1, 1]],
        "princpt": K[:2, 2].tolist(),
    }


def _union(boxes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Smallest box (left, top, width, height) around some."""
    if not boxes:
        return np.zeros(4)
    corners = np.array(boxes)
    low, high = corners[:, :2].min(axis=0), (corners[:, :2] + corners[:, 2:]).max(axis=0)
    return np.concatenate([low, high - low])
