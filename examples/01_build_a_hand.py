"""Build a hand, move it, and look at its numbers.

    python examples/01_build_a_hand.py

Five named sizes or random people; the same angles give the mirrored pose on the other side.
"""

from __future__ import annotations

import numpy as np

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import EVERYBODY, sample_shape
from poses.shapes.library import gesture


def main() -> None:
    rng = np.random.default_rng(0)
    for model in (HandModel.named("S"), HandModel(sample_shape(EVERYBODY, side="left", rng=rng))):
        shape = model.shape
        print(f"{shape.side} hand, {1e3 * shape.length:.0f} x {1e3 * shape.breadth:.0f} mm")
        qpos = join_qpos(np.stack([gesture("spread"), gesture("fist")]))  # (2, 27)
        bones = model.forward_kinematics(qpos)  # T_world_bone, (2, 16, 4, 4)
        skin = model.skin(qpos)  # (2, V, 3)
        reach = 1e3 * np.linalg.norm(skin, axis=-1).max(axis=1)
        print(f"  {bones.shape[1]} bones, {skin.shape[1]} skin vertices")
        print(f"  reach: spread {reach[0]:.0f} mm, fist {reach[1]:.0f} mm")
        print(f"  MuJoCo model: nq {model.mj_model.nq}, nv {model.mj_model.nv}")


if __name__ == "__main__":
    main()
