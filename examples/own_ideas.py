"""A pose sampler and a corruption of your own, as a module that handsim loads by name.

    python examples/own_ideas.py
    cd examples && handsim generate --sampler own_ideas:Pointing --num-frames 20000 --out set
    cd examples && handsim train set --corruption own_ideas:hide_a_side --out run

A package registers them under names of their own in its pyproject.toml:

    [project.entry-points."handsim.pose_samplers"]
    pointing = "own_ideas:Pointing"
    [project.entry-points."handsim.corruptions"]
    hide_a_side = "own_ideas:hide_a_side"
"""

from __future__ import annotations

import numpy as np

from handsim import HandModel
from poses import load_gestures, validate


class Pointing:
    """The pointing gesture with noise on every joint angle."""

    def __init__(self) -> None:
        self.gesture = load_gestures()["point"]  # (20,) [rad]

    def __call__(self, model: HandModel, num_poses: int, *, rng: np.random.Generator) -> np.ndarray:
        """Joint angles (T, 20) [rad]; invalid ones are moved towards rest."""
        return self.gesture + rng.normal(0.0, 0.1, (num_poses, 20))


def hide_a_side(markers: np.ndarray, *, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Lose the markers farthest along a random direction, and add a ghost to every second cloud.

    Markers are (B, M, 3) [m]. Points (B, N, 3) are NaN where there is none; labels (B, N) are -1 for a ghost.
    """
    batch, count = markers.shape[:2]
    along = (markers @ rng.normal(size=(batch, 3, 1)))[..., 0]
    points = markers.copy()
    points[along > np.quantile(along, 0.8, axis=1, keepdims=True)] = np.nan
    ghosts = rng.uniform(-0.1, 0.1, (batch, 1, 3))
    ghosts[::2] = np.nan
    labels = np.tile([*range(count), -1], (batch, 1))
    return np.concatenate([points, ghosts], axis=1), labels


def main() -> None:
    rng, model = np.random.default_rng(0), HandModel.named("M")
    qpos = np.zeros((100, 27))
    qpos[:, 3], qpos[:, 7:] = 1.0, Pointing()(model, 100, rng=rng)
    print(f"{100 * validate(model, qpos).mean():.0f} % of the poses are valid as they are drawn")
    points, labels = hide_a_side(rng.uniform(-0.1, 0.1, (4, 19, 3)), rng=rng)
    there = np.isfinite(points[..., 0])
    print(f"{there.sum()} of {there.size} points are there, {(labels[there] < 0).sum()} of them ghosts")


if __name__ == "__main__":
    main()
