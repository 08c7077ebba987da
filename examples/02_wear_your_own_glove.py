"""Describe a marker glove of your own, put it on a hand, and ask which cameras see it.

    python examples/02_wear_your_own_glove.py

The same layout as a file: `handsim glove new my_glove.toml`, then `handsim glove check my_glove.toml`.
"""

from __future__ import annotations

import numpy as np

from gloves.attachment import attach_markers
from gloves.layout import MarkerLayout, MarkerPlace
from gloves.optics.visibility import visible_cameras
from handsim.hand.model import HandModel, join_qpos
from handsim.space.cameras import named_rig
from poses.shapes.library import gesture


def main() -> None:
    tips = [
        MarkerPlace(f"{digit}_tip", f"{digit}_distal", along=0.7, around=0.0)
        for digit in ("thumb", "index", "middle", "ring", "little")
    ]
    back = [
        MarkerPlace("back_a", "palm", along=0.35, around=0.0, across=0.2),
        MarkerPlace("back_b", "palm", along=0.75, around=0.0, across=-0.1),
        MarkerPlace("back_c", "palm", along=0.25, around=0.0, across=-0.2),
    ]
    layout = MarkerLayout("eight", (*tips, *back), radius=0.0032)
    model = HandModel.named("M")
    names = ("spread", "relaxed", "fist")
    qpos = join_qpos(np.stack([gesture(name) for name in names]), position=[0.0, 0.0, 1.1])
    bones = model.forward_kinematics(qpos)
    markers, normals = attach_markers(layout, model).markers(model, bones)  # (3, 8, 3) each
    seen = visible_cameras(
        markers, normals, named_rig("figure5"), model.capsules.posed(bones), model.capsules.radii
    )  # (3, 8, 16)
    for name, cameras in zip(names, seen.sum(axis=-1), strict=True):
        print(f"{name:8}", ", ".join(f"{m} {n}" for m, n in zip(layout.names, cameras, strict=True)))


if __name__ == "__main__":
    main()
