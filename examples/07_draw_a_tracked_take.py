"""Draw pictures of a tracked capture, and measure how far their keypoints are from the truth.

    python examples/07_draw_a_tracked_take.py

Pictures are drawn in memory and into files. The command line does the latter too:
`handsim render tracked.npz --out pictures --format coco`.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from handsim import Camera
from render import RenderConfig, RenderedFrame, SkinLook, ViewConfig, draw, render_take
from track import track_capture
from train import simulate_take


def compare(frame: RenderedFrame, truth: RenderedFrame) -> None:
    camera: Camera = frame.camera
    for hand, true in zip(frame.hands, truth.hands, strict=True):
        off = np.linalg.norm(hand.keypoints - camera.project(true.keypoints_world), axis=1)[hand.visible]
        shown = frame.depth[frame.ids > 0]
        print(
            f"{frame.key}, {hand.shape.side}: {hand.visible.sum()} of 21 keypoints visible, "
            f"{np.mean(off):.1f} px off, hands at {1e3 * np.median(shown):.0f} mm"
        )


def main() -> None:
    truth = simulate_take(kind="hand-hand", num_frames=120)  # 1 s at 120 Hz
    tracked = track_capture(truth.capture(), glove="dense19")  # nobody was calibrated
    tone = SkinLook(lightness=45.0).typology_angle  # [deg]; people with skin about as dark as this
    config = RenderConfig(
        view=ViewConfig("orbit"),
        passes=("rgb", "depth", "ids"),
        tones=(tone - 5.0, tone + 5.0),
        every=40,
        seed=1,
    )
    drawn, true = draw(tracked, config=config), draw(truth, config=config)  # every 40th frame
    for pair in zip(drawn, true, strict=True):
        compare(*pair)
    with TemporaryDirectory() as folder:
        count = render_take(tracked, Path(folder) / "out", "coco", config, workers=1)
        coco = json.loads((Path(folder) / "out" / "annotations.json").read_text())
    print(f"{count} pictures, {len(coco['annotations'])} annotated hands")


if __name__ == "__main__":
    main()
