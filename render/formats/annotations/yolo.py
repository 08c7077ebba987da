"""Pose labels of ultralytics' YOLO: a text per picture, a line per hand, and `data.yaml`.

A line is the class, the box (center and size) and 21 x (x, y, flag), all as shares of the picture's width and
height from its corner; a flag is 0 outside the picture, 1 hidden, 2 seen. There is one class, because
ultralytics mirrors pictures while it trains, which makes a right hand a left one; its keypoints keep their
numbers.
"""

from __future__ import annotations

import json
from typing import Final

import numpy as np

from handsim.hand.model import KEYPOINT_NAMES
from handsim.hand.shape import NUM_KEYPOINTS
from render.formats.annotations.common import is_seen, keypoint_flags
from render.frames import HandTruth, RenderedFrame

_CLASS: Final = 0


def label_lines(frame: RenderedFrame) -> str:
    """The text of a picture's labels: one line per visible hand, none where there is no hand."""
    return "".join(f"{_line(hand, frame.camera.size)}\n" for hand in frame.hands if is_seen(hand))


def data_yaml() -> str:
    """The text of `data.yaml`; paths count from its own folder."""
    return "\n".join(
        (
            "# For ultralytics: yolo pose train data=data.yaml model=yolo11n-pose.pt",
            "train: images",
            "# The same pictures: render others with another --seed and name their folder here.",
            "val: images",
            f"kpt_shape: [{NUM_KEYPOINTS}, 3]",
            f"flip_idx: {list(range(NUM_KEYPOINTS))}",
            "names: {0: hand}",
            f"kpt_names: {{0: {json.dumps(KEYPOINT_NAMES)}}}",
            "",
        )
    )


def _line(hand: HandTruth, size: tuple[int, int]) -> str:
    corner, extent = hand.box[:2], hand.box[2:]
    box = np.concatenate([(corner + 0.5 * extent) / size, extent / size])
    flags = keypoint_flags(hand, size)
    points = np.where(flags[:, None] > 0, hand.keypoints / size, 0.0)
    rows = (f"{x:.6f} {y:.6f} {flag}" for (x, y), flag in zip(points.tolist(), flags.tolist(), strict=True))
    return " ".join([str(_CLASS), *(f"{value:.6f}" for value in box.tolist()), *rows])
