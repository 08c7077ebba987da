"""How exactly the fast paths agree with MuJoCo, and how valid sampled poses are.

    python -m benchmarks.agreement [--hands 50 --poses 2000]

Random people of both sides and all ages: kinematics against mj_kinematics, sight against mj_multiRay, ranges,
and the deepest self-penetration of any sampled pose.
"""

from __future__ import annotations

import mujoco
import numpy as np

from benchmarks.record import describe, report, run
from gloves import load_layout
from gloves.fit import attach_markers
from gloves.optics.visibility import free_rays
from handsim import HandModel, join_qpos, load_rig
from handsim.hand.shape import EVERYBODY
from handsim.space.transforms import random_quaternions
from poses.shapes import HIGH, LOW, sample_valid_angles
from train.simulation.training_frames import sample_hands

CHECKED = 20  # frames per hand that MuJoCo repeats


def blocked_rays(
    model: HandModel, data: mujoco.MjData, markers: np.ndarray, cameras: np.ndarray
) -> np.ndarray:
    """MuJoCo's answer for one frame: which rays (M, C) meet the hand before the camera."""
    blocked = np.zeros((len(markers), len(cameras)), dtype=bool)
    hits, distances = np.zeros(len(cameras), dtype=np.int32), np.zeros(len(cameras))
    for number, marker in enumerate(markers):
        rays = cameras - marker
        lengths = np.linalg.norm(rays, axis=1)
        unit = (rays / lengths[:, None]).ravel()
        mujoco.mj_multiRay(
            model.mj_model, data, marker, unit, None, 1, -1, hits, distances, None, len(cameras), 10.0
        )
        blocked[number] = (distances >= 0) & (distances < lengths)
    return blocked


def main(hands: int = 50, poses: int = 2000, save: str | None = None) -> None:
    print(describe("mujoco"))
    rng = np.random.default_rng(0)
    layout, cameras = load_layout("dense19"), load_rig("figure5").positions
    deepest = kinematics = 0.0
    outside = rays = disagreeing = 0
    for _ in range(hands):
        model = sample_hands(EVERYBODY, rng=rng)[rng.integers(2)]
        angles = sample_valid_angles(model, poses, rng=rng)
        outside += int(((angles < LOW) | (angles > HIGH)).any(axis=1).sum())
        deepest = max(deepest, float(model.penetration(join_qpos(angles)).max()))
        position = np.array([0.0, 0.0, 1.1]) + rng.uniform(-0.3, 0.3, size=(CHECKED, 3))
        quaternion = random_quaternions(CHECKED, rng=rng)
        qpos = join_qpos(angles[:CHECKED], position=position, quaternion=quaternion)
        bones = model.forward_kinematics(qpos)
        markers, _ = attach_markers(layout, model).markers(model, bones)
        free = free_rays(markers, cameras, model.capsules.posed(bones), model.capsules.radii)
        data = mujoco.MjData(model.mj_model)
        for frame, values in enumerate(qpos):
            data.qpos[:] = values
            mujoco.mj_kinematics(model.mj_model, data)
            kinematics = max(kinematics, float(np.abs(data.xpos[1:] - bones[frame, :, :3, 3]).max()))
            blocked = blocked_rays(model, data, markers[frame], cameras)
            rays, disagreeing = rays + blocked.size, disagreeing + int((blocked == free[frame]).sum())
    figures = {
        "outside": ("joint angles of the sampled poses out of range", outside),
        "kinematics": ("kinematics against mj_kinematics, largest difference [m]", kinematics),
        "rays": ("rays that agree with mj_multiRay, of all", [rays - disagreeing, rays]),
        "deepest": ("deepest self-penetration of the sampled poses [mm]", 1e3 * deepest),
    }
    report(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
