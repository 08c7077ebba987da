"""How valid motions are: the deepest overlaps of hands and objects in the twins of the paper's captures.

    python -m benchmarks.validity [--frames N --seeds 3]

All twins at full length, or N frames. Overlaps are of the capsules that stand for flesh, and of an object's
parts, as MuJoCo collides them; poses allow 1 mm, what skin gives way.
"""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.record import describe, report, run
from gloves import Take
from handsim.hand.capsules import overlap_between
from handsim.hand.model import HandModel
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices
from poses.grasps import object_penetration
from train import simulate_take
from train.simulation.scenes import KINDS


def two_hands_penetration(
    right: HandModel, left: HandModel, right_qpos: np.ndarray, left_qpos: np.ndarray
) -> np.ndarray:
    """Deepest overlap (T,) of any capsule of one hand with any of the other [m]; 0 where hands are apart."""
    bones = right.forward_kinematics(right_qpos), left.forward_kinematics(left_qpos)
    return np.maximum(overlap_between(right.capsules, bones[0], left.capsules, bones[1]), 0.0)


def overlaps(take: Take) -> tuple[float, float, float]:
    """Deepest in themselves, between hands, and with the object [mm]."""
    right, left = models = [hand.model for hand in take.hands]
    qpos = [hand.qpos for hand in take.moving_hands()]
    own = max(model.penetration(values).max() for model, values in zip(models, qpos, strict=True))
    between = two_hands_penetration(right, left, *qpos).max()
    thing = 0.0
    for number, body in enumerate(take.bodies):
        poses, held = pose_matrices(take.body_poses[:, number]), named_object(body.name)
        thing = max(
            object_penetration(model, held, values, poses).max()
            for model, values in zip(models, qpos, strict=True)
        )
    return 1e3 * own, 1e3 * between, 1e3 * thing


def main(frames: int | None = None, seeds: int = 3, save: str | None = None) -> None:
    print(describe("mujoco", "numba", "scipy"))
    print("deepest overlap [mm] of a hand in itself, hand in hand, hand in object")
    found = []
    for kind, seed in itertools.product(KINDS, range(seeds)):
        found.append(overlaps(simulate_take(kind=kind, num_frames=frames, seed=seed)))
        print(f"  {kind:16s} seed {seed}: " + ", ".join(f"{one:.3f}" for one in found[-1]), flush=True)
    what = ("a hand in itself", "hand in hand", "hand in object")
    worst = zip(("itself", "hands", "object"), what, np.max(found, axis=0), strict=True)
    report(save, {key: (f"twins, the worst: {words} [mm]", value) for key, words, value in worst})


if __name__ == "__main__":
    run(main, __doc__)
