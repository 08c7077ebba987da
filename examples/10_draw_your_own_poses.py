"""Draw your own poses through your own cameras, twice, and merge the pictures.

    python examples/10_draw_your_own_poses.py

The same on the command line (docs/rendering.md has the formats of both files):
`handsim render --poses poses.npz --cameras cameras.toml --hands right --out pictures --format coco`.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from handsim import HandModel
from poses import sample_poses
from render import PoseFile, RenderConfig, ViewConfig, merge_renderings, render_take

CAMERAS = """
[[camera]]
name = "front"
size = [320, 240]
focal = [300.0, 300.0]
lens = "brown"
coefficients = [-0.2, 0.05, 0.001, 0.0, 0.0]
position = [0.1, -0.5, 0.1]
target = [0.08, 0.0, 0.0]

[[camera]]
name = "above"
size = [320, 240]
focal = [300.0, 300.0]
position = [0.1, -0.1, 0.5]
target = [0.08, 0.0, 0.0]
"""


def main() -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "cameras.toml").write_text(CAMERAS)
        qpos = sample_poses(HandModel.named("M"), 6, rng=np.random.default_rng(0))  # (6, 27)
        hand_size = np.array([[0.19, 0.085], [0.17, 0.076]])  # length and breadth of two people [m]
        np.savez(folder / "poses.npz", qpos=qpos, person=[0, 0, 0, 1, 1, 1], hand_size=hand_size)
        view = ViewConfig(cameras=str(folder / "cameras.toml"))
        for seed in (0, 1):  # other light, backgrounds and skins
            config = RenderConfig(view=view, passes=("rgb", "ids"), seed=seed)
            render_take(PoseFile(folder / "poses.npz"), folder / f"run{seed}", ["coco"], config, workers=1)
        merge_renderings([folder / "run0", folder / "run1"], folder / "both")
        coco = json.loads((folder / "both" / "annotations.json").read_text())
    names = sorted({image["camera"] for image in coco["images"]})
    ids = {image["id"] for image in coco["images"]}
    print(f"{len(coco['images'])} pictures of the cameras {' and '.join(names)}, {len(ids)} ids")
    print(
        f"{len(coco['annotations'])} hands, keypoints of the first: {coco['annotations'][0]['keypoints'][:6]}"
    )


if __name__ == "__main__":
    main()
