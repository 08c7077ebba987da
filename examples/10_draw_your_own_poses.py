"""Draw your own poses before your own cameras: in memory, and into files, which are merged.

    python examples/10_draw_your_own_poses.py

On the command line poses and cameras are files (docs/rendering.md):
`handsim render --poses poses.npz --cameras cameras.toml --hands right --out pictures --format coco`.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from handsim import Camera, HandModel, look_at
from poses import sample_poses
from render import RenderConfig, draw, merge_renderings, render_take

K = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])


def camera(name: str, position: tuple[float, float, float]) -> Camera:
    """A camera at a position [m] that looks at the hand."""
    return Camera(name, (320, 240), K, look_at(np.array(position), np.array([0.08, 0.0, 0.0])))


def main() -> None:
    model = HandModel.named("M")
    qpos = sample_poses(model, 6, rng=np.random.default_rng(0))  # (6, 27)
    cameras = [camera("front", (0.1, -0.5, 0.1)), camera("above", (0.1, -0.1, 0.5))]
    for frame in draw(qpos, model=model, camera=cameras, frames=[0], seed=0):
        keypoint = np.round(frame.hands[0].keypoints[8])
        print(f"{frame.key}: colors {frame.rgb.shape}, the index finger's tip at {keypoint} px")
    with TemporaryDirectory() as name:
        folder = Path(name)
        for seed in (0, 1):  # other light, backgrounds and skins
            config = RenderConfig(passes=("rgb", "ids"), seed=seed)
            out, person = folder / f"run{seed}", [0, 0, 0, 1, 1, 1]
            render_take(
                qpos, out, "coco", config, people=["L", "S"], person=person, camera=cameras, workers=1
            )
        merge_renderings([folder / "run0", folder / "run1"], folder / "both")
        coco = json.loads((folder / "both" / "annotations.json").read_text())
    ids = {image["id"] for image in coco["images"]}
    print(f"{len(coco['images'])} pictures, {len(ids)} ids, {len(coco['annotations'])} hands")


if __name__ == "__main__":
    main()
