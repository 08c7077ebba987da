"""Fit of the hand model to real people: one shape and one marker placement per person, one pose per frame.

    python -m benchmarks.hand_fit CAPTURES [--frames 400 --held-out 400 --seed 0]

CAPTURES is a folder of labeled dense19 captures, one sub-folder a person (right hands, *_right.trc). Shape
(bone lengths, knuckles, directions of digits) and marker places are fitted together with the poses of some
frames by Gauss-Newton with the poses eliminated; then other frames are fitted with shape and places held.
Priors keep the shape near the mean hand.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.people import right_hands
from benchmarks.record import describe, report, run
from gloves import GloveFit, MarkerLayout, load_layout
from gloves.fit import attach_markers
from handsim import HandModel, HandShape
from handsim.hand.model import skinned_jacobian
from handsim.hand.shape import shape_from_measures
from handsim.kernels import move
from track import PoseFit, solve_pose

ROUNDS = 12
STEP = 1e-5
NOISE = 0.00175  # [m] standard deviation of a coordinate in the data, which the priors are weighed against
# Standard deviations of the priors: log bone lengths, knuckles [m], directions (thumb first), places [m].
LENGTHS, KNUCKLES, DIRECTIONS, PLACES = 0.06, 0.004, np.deg2rad([15.0, 5.0, 5.0, 5.0, 5.0]), 0.006


class Person:
    """A hand and a glove that follow a vector of parameters, zero at the mean hand of the right size."""

    def __init__(self, shape: HandShape, layout: MarkerLayout) -> None:
        self.shape, self.layout = shape, layout
        model = HandModel(shape)
        self.glove = attach_markers(layout, model)
        self.bones = self.glove.bone_indices[:, 0]
        inverse = np.linalg.inv(model.rest_transforms)[self.bones]
        self.local = np.einsum("mij,mj->mi", inverse[:, :3, :3], self.glove.points) + inverse[:, :3, 3]
        spreads = [np.full(15, LENGTHS), np.full(15, KNUCKLES), np.repeat(DIRECTIONS, 3)]
        self.spread = np.concatenate([*spreads, np.full(3 * layout.num_markers, PLACES)])

    def wear(self, parameters: np.ndarray) -> GloveFit:
        """The hand and its glove for these parameters."""
        lengths, knuckles, directions = parameters[:45].reshape(3, 5, 3)
        shape = dataclasses.replace(
            self.shape,
            bone_lengths=self.shape.bone_lengths * np.exp(lengths),
            knuckles=self.shape.knuckles + knuckles,
            base_angles=self.shape.base_angles + directions,
        )
        model = HandModel(shape)
        local = self.local + parameters[45:].reshape(-1, 3)
        rest = model.rest_transforms[self.bones]
        points = np.einsum("mij,mj->mi", rest[:, :3, :3], local) + rest[:, :3, 3]
        return GloveFit(model, dataclasses.replace(self.glove, points=points))


def improve(person: Person, parameters: np.ndarray, fit: PoseFit) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of parameters and poses together, the poses eliminated frame by frame."""
    worn = person.wear(parameters)
    model, glove = worn.model, worn.attachment
    bones = model.forward_kinematics(fit.qpos)
    frames = len(fit.qpos)
    poses = skinned_jacobian(model, bones, glove.points, glove.bone_indices, glove.bone_weights)
    poses = poses.reshape(frames, -1, 26)
    base = glove.markers(model, bones)[0].reshape(frames, -1)
    shapes = np.empty((frames, base.shape[1], len(parameters)))
    for number in range(len(parameters)):
        nudged = parameters.copy()
        nudged[number] += STEP
        moved = person.wear(nudged).markers(fit.qpos)[0]
        shapes[..., number] = (moved.reshape(frames, -1) - base) / STEP
    residual = fit.residuals.reshape(frames, -1)
    normal = poses.transpose(0, 2, 1) @ poses + 1e-6 * np.eye(26)
    cross = poses.transpose(0, 2, 1) @ shapes
    gradient = np.einsum("tnv,tn->tv", poses, residual)
    solved = np.linalg.solve(normal, np.concatenate([cross, gradient[..., None]], axis=2))
    prior = frames * 0.02 * (NOISE / person.spread) ** 2
    left = np.einsum("tnp,tnq->pq", shapes, shapes) - np.einsum("tvp,tvq->pq", cross, solved[..., :-1])
    right = np.einsum("tnp,tn->p", shapes, residual) - np.einsum("tvp,tv->p", cross, solved[..., -1])
    change = -np.linalg.solve(left + np.diag(prior), right + prior * parameters)
    step = -solved[..., -1] - solved[..., :-1] @ change
    return parameters + change, move(fit.qpos, np.clip(step, -0.3, 0.3))


def fit_person(markers: np.ndarray, layout: MarkerLayout) -> tuple[Person, np.ndarray]:
    """Shape and places for one person's frames (T, 19, 3)."""
    first, second = layout.names.index("BackHand1"), layout.names.index("IndexMCP")
    size = np.linalg.norm(markers[:, first] - markers[:, second], axis=1).mean() / 0.0749  # of the mean hand
    person = Person(shape_from_measures(0.187 * size, 0.083 * size), layout)
    parameters = np.zeros(len(person.spread))
    fit = solve_pose(person.wear(parameters), markers)
    for _ in range(ROUNDS):
        parameters, qpos = improve(person, parameters, fit)
        fit = solve_pose(person.wear(parameters), markers, initial=qpos, iterations=10)
    return person, parameters


def main(
    captures: Path, frames: int = 400, held_out: int = 400, seed: int = 0, save: str | None = None
) -> None:
    print(describe("scipy"))
    rng, layout, everyone = np.random.default_rng(seed), load_layout("dense19"), []
    for name, markers in right_hands(captures, layout.names).items():
        chosen = rng.choice(len(markers), frames + held_out, replace=False)
        person, parameters = fit_person(markers[chosen[:frames]], layout)
        fit = solve_pose(person.wear(parameters), markers[chosen[frames:]])
        everyone.append(1e3 * fit.rms)
        print(f"{name}: 3D RMS median {np.median(everyone[-1]):.2f} mm, worst {everyone[-1].max():.2f} mm")
    rms = np.concatenate(everyone)
    what = f"fit of the hand to {len(rms)} other frames, 3D RMS median and p95 [mm]"
    report(save, {"all": (what, np.percentile(rms, [50, 95]))})


if __name__ == "__main__":
    run(main, __doc__)
