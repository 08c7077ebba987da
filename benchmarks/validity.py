"""How valid motions are, frame by frame: the deepest overlaps, the angles out of range, the fastest wrists.

    python -m benchmarks.validity [--frames N --seeds 3 --people 5]

All twins of the paper's captures at full length (or N frames), and every script by people drawn at random for
ten seconds each. Overlaps are of the capsules that stand for flesh, and of an object's parts, as MuJoCo
collides them; poses allow 1 mm, what skin gives way.
"""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.record import describe, run, save_figures
from gloves import Take
from handsim import HandModel, HandSimError, sample_shape
from handsim.hand.shape import EVERYBODY
from handsim.space.objects import named_object
from handsim.space.transforms import pose_matrices, quaternion_matrix
from poses.grasps import object_penetration
from poses.motion import script_names, scripted_motion
from poses.shapes import HIGH, LOW
from poses.two_hands import two_hands_penetration
from train import simulate_take
from train.simulation.scenes import KINDS

SECONDS = 10.0
WORST = (
    ("itself", "a hand in itself [mm]"),
    ("hands", "hand in hand [mm]"),
    ("object", "hand in object [mm]"),
    ("wrist", "fastest wrist [m/s]"),
    ("turn", "fastest wrist [rad/s]"),
    ("joint", "fastest joint angle [rad/s]"),
)


def fastest(qpos: np.ndarray, rate: float) -> tuple[float, float, float]:
    """Wrist [m/s] and [rad/s], hinges [rad/s]."""
    turns = quaternion_matrix(qpos[:, 3:7])
    cosine = (np.einsum("tij,tij->t", turns[1:], turns[:-1]) - 1.0) / 2.0
    return (
        rate * float(np.linalg.norm(np.diff(qpos[:, :3], axis=0), axis=1).max()),
        rate * float(np.arccos(np.clip(cosine, -1.0, 1.0)).max()),
        rate * float(np.abs(np.diff(qpos[:, 7:], axis=0)).max()),
    )


def out_of_range(qpos: np.ndarray) -> int:
    angles = qpos[:, 7:]
    return int(((angles < LOW - 1e-9) | (angles > HIGH + 1e-9)).sum())


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


def twins(frames: int | None, seeds: int) -> np.ndarray:
    """The greatest value of each figure in `WORST`."""
    found = []
    print(
        "\ntwins: deepest overlap [mm] of a hand in itself, hand in hand, hand in object; angles out of "
        "range;"
    )
    print(
        "fastest wrist [m/s], [rad/s] and hinge [rad/s]; farthest wrist from the room's middle, an axis [m]"
    )
    for kind, seed in itertools.product(KINDS, range(seeds)):
        take = simulate_take(kind=kind, num_frames=frames, seed=seed)
        own, between, thing = overlaps(take)
        outside = sum(out_of_range(hand.qpos) for hand in take.moving_hands())
        speeds = np.max([fastest(hand.qpos, take.rate) for hand in take.moving_hands()], axis=0)
        reach = max(np.abs(hand.qpos[:, :3] - [0.0, 0.0, 1.1]).max() for hand in take.moving_hands())
        print(
            f"  {kind:16s} seed {seed}, {take.num_frames} frames: {own:.3f}, {between:.3f}, {thing:.3f}; "
            f"{outside}; {speeds[0]:.2f}, {speeds[1]:.1f}, {speeds[2]:.1f}; {reach:.2f}"
        )
        found.append([own, between, thing, *speeds])
    return np.max(found, axis=0)


def scripts(people: int) -> None:
    print(
        f"\nscripts, {people} people, {SECONDS:g} s each: deepest overlap [mm], angles out of range, "
        "fastest hinge"
    )
    for name in script_names():
        deepest, outside, speed, failed = 0.0, 0, 0.0, 0
        for person in range(people):
            rng = np.random.default_rng(person)
            model = HandModel(sample_shape(EVERYBODY, side="right" if person % 2 else "left", rng=rng))
            try:
                motion = scripted_motion(model, name, SECONDS, rng=rng)
            except HandSimError:
                failed += 1
                continue
            deepest = max(deepest, 1e3 * model.penetration(motion.qpos).max())
            outside += out_of_range(motion.qpos)
            speed = max(speed, fastest(motion.qpos, motion.rate)[2])
        unable = f"; {failed} people cannot" if failed else ""
        print(f"  {name:20s} {deepest:.3f}, {outside}, {speed:.1f}{unable}")


def main(frames: int | None = None, seeds: int = 3, people: int = 5, save: str | None = None) -> None:
    print(describe("mujoco", "numba", "scipy"))
    worst = twins(frames, seeds)
    named = zip(WORST, worst, strict=True)
    save_figures(save, {key: (f"twins, the worst: {what}", value) for (key, what), value in named})
    scripts(people)


if __name__ == "__main__":
    run(main, __doc__)
