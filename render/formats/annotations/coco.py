"""COCO keypoints: `annotations.json` for pycocotools, mmpose, detectron2 and other readers of COCO.

Keypoints count pixels from the first one's center, boxes from the picture's corner: this is how COCO's own
files and their readers have it. Beyond COCO's fields an image has its camera (`K` for such pixels, the lens,
the pose), who is in it and every random choice; an annotation has its side, its keypoints in the camera's
axes [m], its pose, its shape and its skin.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np

from handsim import __version__
from handsim.hand.model import KEYPOINT_NAMES, SKELETON
from handsim.space.camera import Camera
from render.formats.annotations.common import (
    CENTER,
    hand_mask,
    is_seen,
    keypoint_flags,
    rounded,
    run_lengths,
    shape_record,
    shifted_K,
)
from render.frames import HandTruth, RenderedFrame
from render.skin.look import SkinLook, tone_name

INFO: Final[dict[str, Any]] = {
    "description": "Hands drawn by handsim; keypoints count pixels from the first one's center",
    "version": __version__,
}
"""What a file tells of itself. It has no date, so that the same frames give the same bytes."""
CATEGORY: Final[dict[str, Any]] = {
    "id": 1,
    "name": "hand",
    "supercategory": "hand",
    "keypoints": list(KEYPOINT_NAMES),
    "skeleton": [[start + 1, end + 1] for start, end in SKELETON],  # COCO counts keypoints from one
}


def picture_record(frame: RenderedFrame, file_name: str) -> dict[str, Any]:
    """The picture and its hands, still without COCO's numbers."""
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
        "choices": frame.choices,
    }
    if "person" in frame.choices:
        image["person"] = frame.choices["person"]
    hands = [_hand_record(frame, number, hand) for number, hand in enumerate(frame.hands) if is_seen(hand)]
    return {"image": image, "annotations": hands}


def numbered(records: Iterable[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Images and their annotations with COCO's numbers, in the order of the records."""
    annotation_id = 0
    for image_id, record in enumerate(records, start=1):
        hands = []
        for hand in record["annotations"]:
            annotation_id += 1
            hands.append({"id": annotation_id, "image_id": image_id, **hand})
        yield {"id": image_id, **record["image"]}, hands


def _hand_record(frame: RenderedFrame, number: int, hand: HandTruth) -> dict[str, Any]:
    keypoints, known = _keypoints(frame.camera, hand)
    mask = hand_mask(frame, number)
    record = {
        "category_id": CATEGORY["id"],
        "keypoints": keypoints,
        "num_keypoints": known,
        "bbox": rounded(hand.box, 3),
        "area": float(hand.box[2] * hand.box[3]) if mask is None else int(mask.sum()),
        "iscrowd": 0,
        "side": hand.shape.side,
        "xyz": rounded(frame.camera.local(hand.keypoints_world), 9),
        "qpos": hand.qpos.tolist(),
        "shape": shape_record(hand.shape),
    }
    looks = frame.choices.get("people", ())
    if number < len(looks):
        angle = SkinLook(**looks[number]["skin"]).typology_angle
        record["look"], record["skin_tone"] = (
            looks[number],
            {"class": tone_name(angle), "typology_angle": round(angle, 3)},
        )
    if mask is not None:
        record["segmentation"] = {"size": list(mask.shape), "counts": run_lengths(mask)}
    return record


def _keypoints(camera: Camera, hand: HandTruth) -> tuple[list[float], int]:
    """COCO's 21 x (u, v, flag): 0 outside the picture, 1 hidden, 2 seen; and how many are not 0."""
    flags = keypoint_flags(hand, camera.size)
    pixels = np.where(flags[:, None] > 0, hand.keypoints - CENTER, 0.0)
    rows = zip(rounded(pixels, 5), flags.tolist(), strict=True)
    return [value for (u, v), flag in rows for value in (u, v, flag)], int((flags > 0).sum())
