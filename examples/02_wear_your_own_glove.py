"""Describe a marker glove of your own, put it on a hand, and count the cameras that see each marker.

    python examples/02_wear_your_own_glove.py

A layout is a TOML file: a name, a bone and a position on the bone for each marker. `handsim glove new` writes
a commented one, and `handsim glove check` draws it on a hand.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gloves import GloveFit, MarkerLayout, attach, load_layout
from handsim import CameraRig, HandModel, HandSimError, join_qpos, load_rig
from poses import load_gestures

TIPS = {f"{digit}_tip": f"{digit}_distal" for digit in ("thumb", "index", "middle", "ring", "little")}
BACK = {"back_a": (0.35, 0.2), "back_b": (0.75, -0.1), "back_c": (0.25, -0.2)}  # along and across the palm


def eight_markers() -> str:
    marker = '[[marker]]\nname = "{}"\nbone = "{}"\nalong = {}\naround = 0.0\nacross = {}\n'
    tips = [marker.format(name, bone, 0.7, 0.0) for name, bone in TIPS.items()]
    back = [marker.format(name, "palm", *position) for name, position in BACK.items()]
    return "\n".join(['name = "eight"\nradius_mm = 3.2\n', *tips, *back])


def main() -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "eight.toml"
        path.write_text(eight_markers())
        layout: MarkerLayout = load_layout(path)
        try:
            load_layout(Path(folder) / "nine.toml")
        except HandSimError as error:  # every mistake of a user ends in one sentence
            print(str(error).replace(folder, "..."))
    glove: GloveFit = attach(layout, HandModel.named("M"))
    rig: CameraRig = load_rig("figure5")  # the paper's sixteen cameras
    gestures = load_gestures()
    names = ("spread", "relaxed", "fist")
    qpos = join_qpos(np.stack([gestures[name] for name in names]), position=[0.0, 0.0, 1.1])  # (3, 27)
    seen = glove.visible(qpos, rig)  # (3, 8, 16)
    for name, cameras in zip(names, seen.sum(axis=-1), strict=True):
        print(f"{name:8}", ", ".join(f"{m} {n}" for m, n in zip(layout.names, cameras, strict=True)))


if __name__ == "__main__":
    main()
