"""Keypoints that MediaPipe Hands finds on photographs of single hands, as a reference for networks.

    python -m benchmarks.photograph_reference PHOTOS reference.json

Runs in an environment with mediapipe 0.10.14 and opencv-python-headless; handsim is not needed. Each
photograph is enlarged until it has 400 pixels and continued around its border, because the detector looks for
hands that do not fill the picture. The file holds {"folder/name.jpg": {"points": [[x, y], ...21], "side":
"left" or "right", "score": 0 to 1}} in pixels of the photograph, for those with a hand in them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

SIDE: Final = 400  # of an enlarged photograph [px]
AROUND: Final = 0.35  # border [share of the side]
ENDINGS: Final = (".jpg", ".jpeg", ".png")


def keypoints(hands: Any, rgb: np.ndarray) -> dict[str, Any] | None:
    """The surest hand of a photograph (H, W, 3), with points (21, 2) [px]; None without one."""
    scale = SIDE / max(rgb.shape[:2])
    large = cv2.resize(np.ascontiguousarray(rgb), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    border = np.rint(AROUND * np.array(large.shape[:2])).astype(int)
    rows, columns = (int(n) for n in border)
    whole = cv2.copyMakeBorder(large, rows, rows, columns, columns, cv2.BORDER_REPLICATE)
    found = hands.process(whole)
    if not found.multi_hand_landmarks:
        return None
    sides = [side.classification[0] for side in found.multi_handedness]
    best = max(range(len(sides)), key=lambda number: sides[number].score)
    shares = np.array([(p.x, p.y) for p in found.multi_hand_landmarks[best].landmark])
    points = (shares * whole.shape[1::-1] - border[::-1]) / scale
    mirrored = {"Left": "right", "Right": "left"}  # the detector names sides as in a mirror
    return {
        "points": points.tolist(),
        "side": mirrored[sides[best].label],
        "score": float(sides[best].score),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    import mediapipe  # not a dependency of handsim

    hands = mediapipe.solutions.hands.Hands(static_image_mode=True, max_num_hands=1)
    files = sorted(path for path in options.photos.rglob("*") if path.suffix.lower() in ENDINGS)
    pictures = {path.relative_to(options.photos).as_posix(): cv2.imread(str(path)) for path in files}
    found = {name: keypoints(hands, bgr[..., ::-1]) for name, bgr in pictures.items() if bgr is not None}
    sure = {name: one for name, one in found.items() if one is not None}
    options.out.write_text(json.dumps(sure))
    print(f"hands in {len(sure)} of {len(files)} photographs")


if __name__ == "__main__":
    main()
