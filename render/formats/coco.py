"""COCO keypoints (`annotations.json`), YOLO's labels beside them, and InterHand2.6M's files: docs/formats.md.

COCO's keypoints and InterHand2.6M's projections count pixels from the first one's center, boxes from the
picture's corner. YOLO's shares of a picture count from its corner.

A dataset of InterHand2.6M is one capture, "0". Its cameras are called by numerals, because its loader calls
`int` on them, and have one pose each, so that a camera that moves becomes many.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from handsim import __version__
from handsim.errors import DatasetError
from handsim.hand.model import KEYPOINT_NAMES, SKELETON
from handsim.hand.shape import DIGITS, NUM_KEYPOINTS, SIDES, Side
from handsim.motion_files.motion import OPENXR_JOINTS
from handsim.space.transforms import rotation_quaternions
from render.formats.records import (
    CENTER,
    as_sensed,
    body_records,
    by_side,
    centered_K,
    is_seen,
    keypoint_flags,
    rounded,
    run_lengths,
    shifted_K,
    to_json,
    to_order,
    without_colors,
)
from render.formats.shards import _LABELS, FolderWriter, _write, json_list, one_sentence, save_text
from render.frames import Doubles, Flags, HandTruth, RenderedFrame
from render.skin.look import tone_name, typology_angle

INFO: Final[dict[str, Any]] = {  # without a date, so that the same frames give the same bytes
    "description": "Hands drawn by handsim; keypoints count pixels from the first one's center",
    "version": __version__,
}
CATEGORY: Final[dict[str, Any]] = {
    "id": 1,
    "name": "hand",
    "supercategory": "hand",
    "keypoints": list(KEYPOINT_NAMES),
    "skeleton": [[start + 1, end + 1] for start, end in SKELETON],  # COCO counts keypoints from one
}


def picture_record(frame: RenderedFrame, file_name: str) -> dict[str, Any]:
    """COCO's records of a picture and its hands, without ids."""
    camera = frame.camera
    image = {
        "file_name": file_name,
        "width": camera.size[0],
        "height": camera.size[1],
        "frame": frame.number,
        "time": frame.time,
        "camera": camera.name,
        "K": shifted_K(camera).tolist(),
        "lens": {"kind": camera.lens.kind, "coefficients": list(camera.lens.coefficients)},
        "T_world_camera": camera.T_world_camera.tolist(),
        "bodies": body_records(frame),
        "choices": frame.choices,
    }
    if "person" in frame.choices:
        image["person"] = frame.choices["person"]
    hands = [_hand_record(frame, number, hand) for number, hand in enumerate(frame.hands) if is_seen(hand)]
    return {"image": image, "annotations": hands}


def numbered(records: Iterable[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Images and their annotations with ids, in the order of the records."""
    annotation_id = 0
    for image_id, record in enumerate(records, start=1):
        hands = []
        for hand in record["annotations"]:
            annotation_id += 1
            hands.append({"id": annotation_id, "image_id": image_id, **hand})
        yield {"id": image_id, **record["image"]}, hands


def _hand_record(frame: RenderedFrame, number: int, hand: HandTruth) -> dict[str, Any]:
    """COCO's annotation of a hand, without ids."""
    keypoints = _triples(hand.keypoints, hand.visible, frame.camera.size)
    record = {
        "category_id": CATEGORY["id"],
        "keypoints": keypoints,
        "num_keypoints": sum(flag > 0 for flag in keypoints[2::3]),
        "bbox": rounded(hand.box, 3),
        "area": int(hand.mask.sum()),
        "segmentation": {"size": list(hand.mask.shape), "counts": run_lengths(hand.mask)},
        "iscrowd": 0,
        "side": hand.shape.side,
        "xyz": rounded(frame.camera.local(hand.keypoints_world), 9),
        "qpos": hand.qpos.tolist(),
        "shape": dataclasses.asdict(hand.shape),
    }
    if len(hand.openxr):
        joints = np.linalg.inv(frame.camera.T_world_camera) @ hand.openxr
        turns = np.roll(rotation_quaternions(joints[:, :3, :3]), -1, axis=1)
        pixels = frame.camera.project(hand.openxr[:, :3, 3])
        record["openxr_keypoints"] = _triples(pixels, hand.openxr_visible, frame.camera.size)
        record["openxr_poses"] = rounded(np.concatenate([joints[:, :3, 3], turns], axis=1), 9)
    if hand.tracking:
        record["tracking"] = {k: x if k == "status" else rounded(x, 6) for k, x in hand.tracking.items()}
    looks = frame.choices.get("people", ())
    if number < len(looks):
        angle = typology_angle(looks[number]["skin"]["lightness"], looks[number]["skin"]["yellowness"])
        record["look"] = looks[number]
        record["skin_tone"] = {"class": tone_name(angle), "typology_angle": round(angle, 3)}
    return record


def _triples(pixels: Doubles, visible: Flags, size: tuple[int, int]) -> list[Any]:
    """COCO's list u, v, flag, u, ... of keypoints (K, 2)."""
    flags = keypoint_flags(pixels, visible, size)
    known = rounded(np.where(flags[:, None] > 0, pixels - CENTER, 0.0), 5)
    return [x for uv, flag in zip(known, flags.tolist(), strict=True) for x in (*uv, flag)]


def label_lines(frame: RenderedFrame) -> str:
    """YOLO's text of a picture: one line per visible hand, none where there is no hand."""
    size, lines = np.array(frame.camera.size), []
    for hand in filter(is_seen, frame.hands):
        corner, extent = hand.box[:2], hand.box[2:]
        box = np.concatenate([(corner + 0.5 * extent) / size, extent / size]).tolist()
        flags = keypoint_flags(hand.keypoints, hand.visible, frame.camera.size)
        points = np.where(flags[:, None] > 0, hand.keypoints / size, 0.0).tolist()
        rows = (f"{x:.6f} {y:.6f} {flag}" for (x, y), flag in zip(points, flags.tolist(), strict=True))
        lines.append(" ".join(["0", *(f"{value:.6f}" for value in box), *rows]) + "\n")
    return "".join(lines)


_DATA_YAML: Final = f"""\
# For ultralytics: yolo pose train data=data.yaml model=yolo11n-pose.pt
train: images
# The same pictures: render others with another --seed and name their folder here.
val: images
kpt_shape: [{NUM_KEYPOINTS}, 3]
flip_idx: {list(range(NUM_KEYPOINTS))}
names: {{0: hand}}
kpt_names: {{0: {json.dumps(KEYPOINT_NAMES)}}}
"""


class CocoWriter(FolderWriter):
    """`images/shard-00000/KEY.jpg`, `depth/shard-00000/KEY.png` ..., and `annotations.json` beside them."""

    _record_of = staticmethod(picture_record)

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        if as_sensed(frame).rgb is None:
            raise without_colors(type(self).__name__.removesuffix("Writer").lower())
        record = self._record_of(frame, f"{name}/{frame.key}.jpg")
        record["image"] |= self._add_pictures(folder, frame, name)
        return record

    def finish(self) -> list[Path]:
        """Write `annotations.json`."""
        path = self.folder / "annotations.json"
        with one_sentence(self.folder, "writing the annotations"):
            save_text(path, _coco_file(self._records(), CATEGORY, self.folder))
        return [path]


class YoloWriter(CocoWriter):
    """COCO's folder with `labels/shard-00000/KEY.txt`, and `data.yaml`, which ultralytics trains from."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = super()._add(folder, frame, name)
        _write(folder / _LABELS / f"{frame.key}.txt", label_lines(frame).encode())
        return record

    def finish(self) -> list[Path]:
        """Write `annotations.json` and `data.yaml`."""
        path = self.folder / "data.yaml"
        with one_sentence(self.folder, "writing data.yaml"):
            save_text(path, [_DATA_YAML])
        return [*super().finish(), path]


def _coco_file(records: Iterable[dict[str, Any]], category: dict[str, Any], folder: Path) -> Iterator[str]:
    """Pieces of a COCO file; annotations wait in a file of the folder, so that memory need not hold them."""
    yield f'{{"info":{to_json(INFO)},\n"licenses":[],\n"images":'
    fields = set[str]()  # of all annotations
    with tempfile.TemporaryFile("w+", dir=folder, encoding="utf-8") as waiting:

        def images() -> Iterator[dict[str, Any]]:
            separator = "\n"
            for image, hands in numbered(records):
                for hand in hands:
                    fields.update(hand)
                    waiting.write(separator + to_json(hand))
                    separator = ",\n"
                yield image

        yield from json_list(images())
        yield ',\n"annotations":['
        waiting.seek(0)
        yield from waiting
    known = {"openxr_joints": OPENXR_JOINTS} if "openxr_poses" in fields else {}
    yield f'\n],\n"categories":{to_json([category | known])}}}\n'


SPLIT: Final = "train"
CAPTURE: Final = 0
_ORDER: Final[tuple[Side, Side]] = (SIDES[1], SIDES[0])  # right, left


def interhand_record(frame: RenderedFrame, file_name: str) -> dict[str, Any]:
    """The picture, its camera and its joints, without ids."""
    hands = by_side(frame)
    seen = [hand.box for hand in frame.hands if is_seen(hand)]
    annotation, (joints, valid), K = None, _joints(hands), centered_K(frame.camera)
    kind = "interacting" if len(hands) == 2 else next(iter(hands), "right")
    if seen:
        corners = np.array(seen)
        low, high = corners[:, :2].min(axis=0), (corners[:, :2] + corners[:, 2:]).max(axis=0)
        annotation = {
            "bbox": rounded(np.concatenate([low, high - low]), 3),
            "joint_valid": valid,
            "hand_type": kind,
            "hand_type_valid": 1,
            "category_id": 1,
            "iscrowd": 0,
        }
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
        "annotation": annotation,
        "camera_name": frame.camera.name,
        "camera": {
            "campos": (1e3 * frame.camera.T_world_camera[:3, 3]).tolist(),
            "camrot": frame.camera.T_world_camera[:3, :3].T.tolist(),
            "focal": [K[0, 0], K[1, 1]],
            "princpt": K[:2, 2].tolist(),
        },
        "joints": {
            "world_coord": joints,
            "joint_valid": [[value] for value in valid],
            "hand_type": kind,
            "hand_type_valid": True,
        },
    }


def _with_numerals(records: Iterable[dict[str, Any]], cameras: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Records for COCO's file; each pose of a camera is added to `cameras` with a numeral and a record."""
    for record in records:
        pose = to_json([record["camera_name"], record["camera"]])
        numeral, _ = cameras.setdefault(pose, (str(len(cameras)), record["camera"]))
        names = {"camera": numeral, "camera_name": record["camera_name"]}
        annotations = [] if record["annotation"] is None else [record["annotation"]]
        yield {"image": names | record["image"], "annotations": annotations}


def frames_once(records: Iterable[dict[str, Any]]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Joints of every frame, once for all of its cameras."""
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
    """42 joints in the world [mm], zero for an absent hand, and flags of those that are present."""
    joints, valid = np.zeros((2 * NUM_KEYPOINTS, 3)), np.zeros(2 * NUM_KEYPOINTS, dtype=int)
    for number, side in enumerate(_ORDER):
        if side in hands:
            rows = slice(NUM_KEYPOINTS * number, NUM_KEYPOINTS * (number + 1))
            joints[rows], valid[rows] = 1e3 * to_order(hands[side].keypoints_world, "interhand"), 1
    return rounded(joints, 6), valid.tolist()


class InterhandWriter(CocoWriter):
    """`images/train/shard-00000/KEY.jpg`, and InterHand2.6M's JSON files in `annotations/train`."""

    _record_of = staticmethod(interhand_record)

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, part=SPLIT)

    def finish(self) -> list[Path]:
        """Write the files in `annotations`."""
        annotations = self.folder / "annotations"
        start = annotations / SPLIT / f"InterHand2.6M_{SPLIT}"
        cameras: dict[str, tuple[str, dict[str, Any]]] = {}

        def joints() -> Iterator[str]:
            yield f'{{"{CAPTURE}":{{'
            for index, (number, record) in enumerate(frames_once(self._records())):
                yield f'{"," if index else ""}\n"{number}":{to_json(record)}'
            yield "\n}}\n"

        category = {"id": 1, "name": "hand", "supercategory": "hand"}
        with one_sentence(self.folder, "writing the annotations"):
            save_text(Path(f"{start}_joint_3d.json"), joints())
            pictures = _with_numerals(self._records(), cameras)
            save_text(Path(f"{start}_data.json"), _coco_file(pictures, category, self.folder))
            fields = ("campos", "camrot", "focal", "princpt")
            table = {name: {number: one[name] for number, one in cameras.values()} for name in fields}
            save_text(Path(f"{start}_camera.json"), [to_json({str(CAPTURE): table}) + "\n"])
            save_text(annotations / "skeleton.txt", [skeleton_lines()])
        return [path for path in annotations.rglob("*") if path.is_file()]
