"""COCO keypoints (`annotations.json`) and YOLO's labels beside them: docs/formats.md.

COCO's keypoints count pixels from the first one's center, boxes from the picture's corner. YOLO's shares of a
picture count from its corner.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from handsim._version import full_version
from handsim.hand.model import KEYPOINT_NAMES, SKELETON
from handsim.hand.shape import NUM_KEYPOINTS
from handsim.motion_files.motion import OPENXR_JOINTS
from handsim.space.transforms import rotation_quaternions
from render.formats.records import (
    CENTER,
    body_records,
    is_seen,
    keypoint_flags,
    rounded,
    run_lengths,
    shifted_K,
    to_json,
)
from render.formats.shards import LABELS, FolderWriter, json_list, one_sentence, save_text, write_file
from render.frames import Doubles, Flags, HandTruth, RenderedFrame
from render.skin.look import tone_name, typology_angle

_ABOUT: Final = "Hands drawn by handsim; keypoints count pixels from the first one's center"
CATEGORY: Final[dict[str, Any]] = {
    "id": 1,
    "name": "hand",
    "supercategory": "hand",
    "keypoints": list(KEYPOINT_NAMES),
    "skeleton": [[start + 1, end + 1] for start, end in SKELETON],  # COCO counts keypoints from one
}
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
    keypoints = keypoint_triples(hand.keypoints, hand.visible, frame.camera.size)
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
        record["openxr_keypoints"] = keypoint_triples(pixels, hand.openxr_visible, frame.camera.size)
        record["openxr_poses"] = rounded(np.concatenate([joints[:, :3, 3], turns], axis=1), 9)
    if hand.mano:
        record["mano"] = hand.mano
    if hand.tracking:
        record["tracking"] = {k: x if k == "status" else rounded(x, 6) for k, x in hand.tracking.items()}
    looks = frame.choices.get("people", ())
    if number < len(looks):
        angle = typology_angle(looks[number]["skin"]["lightness"], looks[number]["skin"]["yellowness"])
        record["look"] = looks[number]
        record["skin_tone"] = {"class": tone_name(angle), "typology_angle": round(angle, 3)}
    return record


def keypoint_triples(pixels: Doubles, visible: Flags, size: tuple[int, int]) -> list[Any]:
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


class CocoWriter(FolderWriter):
    """`images/shard-00000/KEY.jpg`, `depth/shard-00000/KEY.png` ..., and `annotations.json` beside them."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = picture_record(frame, f"{name}/{frame.key}.jpg")
        record["image"] |= self._add_pictures(folder, frame, name)
        return record

    def finish(self) -> list[Path]:
        """Write `annotations.json`."""
        path = self.folder / "annotations.json"
        with one_sentence(self.folder, "writing the annotations"):
            save_text(path, _coco_file(self._records(), self.folder))
        return [path]


class YoloWriter(CocoWriter):
    """COCO's folder with `labels/shard-00000/KEY.txt`, and `data.yaml`, which ultralytics trains from."""

    def _add(self, folder: Path, frame: RenderedFrame, name: str) -> dict[str, Any]:
        record = super()._add(folder, frame, name)
        write_file(folder / LABELS / f"{frame.key}.txt", label_lines(frame).encode())
        return record

    def finish(self) -> list[Path]:
        """Write `annotations.json` and `data.yaml`."""
        path = self.folder / "data.yaml"
        with one_sentence(self.folder, "writing data.yaml"):
            save_text(path, [_DATA_YAML])
        return [*super().finish(), path]


def _coco_file(records: Iterable[dict[str, Any]], folder: Path) -> Iterator[str]:
    """Pieces of a COCO file; annotations wait in a file of the folder, so that memory need not hold them."""
    # Without a date, so that the same frames give the same bytes.
    info = {"description": _ABOUT, "version": full_version()}
    yield f'{{"info":{to_json(info)},\n"licenses":[],\n"images":'
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
    yield f'\n],\n"categories":{to_json([CATEGORY | known])}}}\n'
