"""Draw pictures of a tracked capture, read them back, and see how far their keypoints are from the truth.

    python examples/07_draw_a_tracked_take.py

The same from the command line: `handsim render tracked.npz --out pictures --format coco`.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from gloves.captures.capture import Capture
from gloves.fit import nominal_fit
from handsim.hand.model import HandModel
from handsim.space.camera import Camera, preset
from render.cameras.viewpoints import ViewConfig
from render.formats.png_depth import read_depth
from render.frames.keypoints import hand_keypoints
from render.session import RenderConfig, render_take
from track.capture_tracking import track_capture
from track.tracker import Tracker
from train.labelers.storage import load_labeler
from train.simulation.takes import TakeConfig, simulate_take


def main() -> None:
    truth = simulate_take(TakeConfig(kind="hand-hand", num_frames=120))  # 1 s at 120 Hz
    columns = tuple(f"*{number}" for number in range(truth.points.shape[1]))
    capture = Capture(columns, truth.points, truth.rate)
    hands = [nominal_fit(hand.layout, "M", hand.side) for hand in truth.hands]  # nobody was calibrated
    config = RenderConfig(view=ViewConfig("orbit"), passes=("rgb", "depth"), every=20, seed=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tracked = track_capture(capture, Tracker(hands, load_labeler("dense19")))
        tracked.save(folder / "tracked.npz")
        count = render_take(folder / "tracked.npz", folder / "pictures", ["coco"], config, workers=1)
        coco = json.loads((folder / "pictures" / "annotations.json").read_text())
        print(f"{count} pictures, {len(coco['annotations'])} hands")
        for image in coco["images"]:
            file = folder / "pictures" / "images" / image["file_name"]
            depth = read_depth(file.with_suffix(".depth.png"))
            camera: Camera = preset("vga").at(np.array(image["T_world_camera"]))
            for hand in coco["annotations"]:
                if hand["image_id"] != image["id"]:
                    continue
                shown = np.array(hand["keypoints"]).reshape(21, 3)
                true = next(one for one in truth.hands if one.side == hand["side"])
                frame = image["frame"]
                points = hand_keypoints(HandModel(true.shape), true.qpos[frame : frame + 1])[0]
                # COCO counts pixels from the first one's center, cameras here from the picture's corner.
                off = np.linalg.norm(shown[:, :2] + 0.5 - camera.project(points), axis=1)[shown[:, 2] > 0]
                print(
                    f"frame {frame}, {hand['side']}: {int((shown[:, 2] == 2).sum())} of 21 keypoints seen, "
                    f"{np.mean(off):.1f} px off, hand at {1e3 * np.median(depth[depth > 0]):.0f} mm"
                )


if __name__ == "__main__":
    main()
