"""Write a pose sampler of your own, and sample poses and motions.

    python examples/08_sample_your_own_poses.py

A sampler is a function that draws joint angles for one hand. Its poses need not be valid: `sample_poses`
moves those that leave a joint's range or penetrate the hand towards rest.
"""

from __future__ import annotations

import numpy as np

from handsim import HandModel, HandMotion, join_qpos
from poses import MotionConfig, PoseSampler, load_gestures, sample_motion, sample_poses, validate


def pointing(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> np.ndarray:
    """The pointing gesture with normal noise of 0.1 rad on every joint angle, (T, 20) [rad]."""
    return load_gestures()["point"] + rng.normal(0.0, 0.1, (num_poses, 20))


def main() -> None:
    rng, model = np.random.default_rng(0), HandModel.named("L")
    sampler: PoseSampler = pointing
    drawn = join_qpos(sampler(model, 200, rng=rng))  # (200, 27)
    qpos = sample_poses(model, 200, sampler, rng=rng)  # (200, 27)
    for name, poses in (("drawn", drawn), ("sampled", qpos)):
        deepest = 1e3 * model.penetration(poses).max()
        print(f"{name}: {100 * validate(model, poses).mean():.0f} % valid, at most {deepest:.1f} mm deep")
    config = MotionConfig(rate=60.0)  # [Hz]
    motion: HandMotion = sample_motion(model, 2.0, config, rng=rng)  # between random poses
    fastest = np.rad2deg(np.abs(motion.speeds()).max())
    print(f"{len(motion.qpos)} frames at {motion.rate:g} Hz, joints move at up to {fastest:.0f} degrees/s")
    print("valid in every frame:", validate(model, motion.qpos).all())


if __name__ == "__main__":
    main()
