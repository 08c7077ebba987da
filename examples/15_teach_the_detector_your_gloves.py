"""Teach the hand detector your gloves, with a video of a tracked take.

    python examples/15_teach_the_detector_your_gloves.py [TAKE VIDEO SAMPLES]     # 20,000 samples, say

It learns from the first half of the video, beside drawn pictures; the second half tells what that brought.
Without arguments it shows the steps on a drawn video, with 64 samples, too few to learn anything.
"""

import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from film import HandDetector, annotate_film, train_detector
from handsim import Camera, look_at
from render import draw
from train import simulate_take


def short_video(folder: Path) -> tuple[Path, Path]:  # by a camera that nobody knows
    take = simulate_take(num_frames=960, seed=5)
    middle = np.nanmedian(take.keypoints().reshape(-1, 3), axis=0)
    K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
    camera = Camera("phone", (640, 480), K, look_at(middle + np.array([0.7, -0.3, 0.5]), middle))
    frames = draw(take, camera=camera, frames=range(0, 960, 12), dress="glove", passes=("rgb",), vary="shard")
    video = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, camera.size)
    for frame in frames:
        video.write(np.ascontiguousarray(frame.rgb[..., ::-1]))
    video.release()
    take.save(folder / "take.npz")
    return folder / "take.npz", folder / "video.mp4"


def share_found(detector: HandDetector, file: Path) -> float:
    """Share of the keypoints that are found within a tenth of their hand's box [%]."""
    content, near = json.loads(file.read_text("utf-8")), []
    pictures = {image["id"]: file.parent / "images" / image["file_name"] for image in content["images"]}
    for one in content["annotations"]:
        picture = np.ascontiguousarray(cv2.imread(str(pictures[one["image_id"]]))[..., ::-1])
        (hand,) = detector.refine(picture, [one["bbox"]], [one["side"]])
        away = np.linalg.norm(hand.keypoints - np.reshape(one["keypoints"], (21, 3))[:, :2], axis=1)
        near += (away < 0.1 * max(one["bbox"][2:])).tolist()
    return 100.0 * float(np.mean(near))


with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary)
    take, video = map(Path, sys.argv[1:3]) if sys.argv[1:] else short_video(folder)
    photographs = folder / "photographs"
    found = annotate_film(take, video, photographs, "coco", passes=("rgb",), workers=1)
    print(f"{found.residual():.1f} px off; {found.left_out()}")
    content, files = json.loads((photographs / "annotations.json").read_text("utf-8")), []
    middle = content["images"][len(content["images"]) // 2]["id"]
    for late in (False, True):
        hands = [one for one in content["annotations"] if (one["image_id"] >= middle) == late]
        images = [one for one in content["images"] if (one["id"] >= middle) == late]
        files.append(photographs / f"half{late}.json")
        files[-1].write_text(json.dumps(content | {"images": images, "annotations": hands}))
    samples = int(sys.argv[3]) if sys.argv[1:] else 64
    taught = train_detector(folder / "taught", start="shipped", photographs=files[0], samples=samples)
    shares = (share_found(HandDetector.load(one), files[1]) for one in (None, taught))
    print("keypoints found before and after: {:.1f} % {:.1f} %".format(*shares))
