"""How fast training sets are made, every ray from every marker to every camera cast.

    python benchmarks/generation.py [--frames 40960]

The floor of a frame is its rays: 19 markers x 16 cameras, each against 21 capsules. The first line after the
machine is the ray kernel alone on one core; the others are `handsim generate` whole: hands, skin, glove,
poses, contact, kinematics, rays, ghosts, files.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import describe

from gloves.attach import attach
from gloves.layout import load_layout
from gloves.visibility import free_rays
from handsim.cameras import named_rig
from handsim.model import HandModel, join_qpos
from handsim.transforms import random_quaternions
from poses.validity import sample_valid_angles
from train.synthesis import DatasetConfig, generate_dataset


def kernel_frames_per_second() -> float:
    rng = np.random.default_rng(0)
    model, rig = HandModel.named("M"), named_rig("figure5")
    angles = sample_valid_angles(model, 4000, rng=rng)
    qpos = join_qpos(angles, position=[0, 0, 1.1], quaternion=random_quaternions(4000, rng=rng))
    bones = model.forward_kinematics(qpos)
    markers, _ = attach(load_layout("dense19"), model).markers(model, bones)
    segments, radii = model.capsules.posed(bones), model.capsules.radii
    free_rays(markers[:1], rig.positions, segments[:1], radii)  # compile
    times = []
    for _ in range(5):
        start = time.perf_counter()
        free_rays(markers, rig.positions, segments, radii)
        times.append(time.perf_counter() - start)
    return 4000 / float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40_960)
    frames = parser.parse_args().frames
    print(describe("mujoco", "numba"))
    floor = kernel_frames_per_second()
    print(f"rays alone, one core: {floor:,.0f} frames/s, {floor * 304 / 1e6:.1f} million rays/s")
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            generate_dataset(DatasetConfig(num_frames=frames), Path(folder) / "set", workers=workers)
            speed = frames / (time.perf_counter() - start)
        paper = 170_330 / speed
        print(
            f"{workers} worker(s): {speed:,.0f} frames/s with 16 x 19 rays; "
            f"the paper's 170,330 take {paper:.0f} s"
        )


if __name__ == "__main__":
    main()
