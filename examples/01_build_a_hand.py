"""Build a hand, move it, and print its measures.

    python examples/01_build_a_hand.py

A hand has one of five named sizes or the random shape of a person. Left hands are mirror images of right
ones: equal joint angles give mirrored poses.
"""

from __future__ import annotations

import numpy as np

from handsim import HandModel, HandShape, Population, join_qpos, sample_shape
from poses import load_gestures


def main() -> None:
    rng = np.random.default_rng(0)
    gestures = load_gestures()  # joint angles (20,) [rad] by name
    qpos = join_qpos(np.stack([gestures["spread"], gestures["fist"]]))  # (2, 27), the wrist at the origin
    child = sample_shape(Population(children=1.0), side="left", rng=rng)
    for model in (HandModel.named("S"), HandModel(child)):
        shape: HandShape = model.shape
        print(f"{shape.side} hand, {1e3 * shape.length:.0f} x {1e3 * shape.breadth:.0f} mm")
        bones = model.forward_kinematics(qpos)  # T_world_bone, (2, 16, 4, 4)
        skin = model.skin(qpos)  # (2, V, 3) [m]
        reach = 1e3 * np.linalg.norm(skin, axis=-1).max(axis=1)
        print(f"  {bones.shape[1]} bones, {skin.shape[1]} skin vertices")
        print(f"  distance of the farthest vertex: spread {reach[0]:.0f} mm, fist {reach[1]:.0f} mm")
        print(f"  MuJoCo model: nq {model.mj_model.nq}, nv {model.mj_model.nv}")


if __name__ == "__main__":
    main()
