"""How quickly a hand's pose is found from labeled markers: ours, MuJoCo's Jacobian, SciPy, mink.

    OMP_NUM_THREADS=1 python -m benchmarks.inverse_kinematics [--frames 300 --noise 0.3 --hands 10 --seed 0]

A random 120 Hz motion is followed on one core, every frame from the pose that the same solver found for the
one before. For the comparison each marker of dense19 is bound to one bone, because a site of MuJoCo is; all
stop where a step brings the markers less than a micron nearer, and the residual is printed. Then what only
ours does: markers bound as the skin is, eight starts at once, and cold starts on many hands. mink is left out
where it is not installed.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import time
from collections.abc import Callable

import mujoco
import numpy as np
from scipy.optimize import least_squares

from benchmarks.record import describe
from gloves.attachment import Attachment, attach_markers
from gloves.fit import GloveFit
from gloves.layout import load_layout
from handsim.errors import PoseError
from handsim.hand.jacobian import skinned_jacobian
from handsim.hand.mjcf import build_spec
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import sample_shape
from handsim.hand.topology import SIDES
from handsim.kernels.integration import move
from handsim.space.transforms import random_quaternions
from poses.motion.motions import sample_motion
from poses.shapes.validity import resting_angles, sample_valid_angles
from track.kinematics.pose_solver import PoseSolver

Solver = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, int]]
SMALL = 1e-12  # [m^2] by which the summed squares may still fall when a solver stops
MOST = 50


def ours(model: HandModel, glove: Attachment) -> Solver:
    solver = PoseSolver(GloveFit(model, glove))

    def solve(target: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
        fit = solver.solve(target[None], start[None])
        return fit.qpos[0], int(fit.iterations[0])

    return solve


def with_sites(model: HandModel, glove: Attachment) -> tuple[mujoco.MjModel, list[int]]:
    compiled = build_spec(model.skeleton, model.capsules, sites=glove.sites(model)).compile()
    return compiled, [compiled.site(name).id for name in glove.layout.names]


def mujoco_marquardt(model: HandModel, glove: Attachment) -> Solver:
    """The same descent with MuJoCo's kinematics and Jacobians and numpy's solver."""
    compiled, sites = with_sites(model, glove)
    data, jacobian = mujoco.MjData(compiled), np.zeros((len(sites), 3, compiled.nv))

    def place(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(compiled, data)
        return data.site_xpos[sites]

    def solve(target: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
        qpos, damping = start.copy(), 1e-4
        miss = place(qpos) - target
        cost = (miss**2).sum()
        tried = 0
        while tried < MOST:
            tried += 1
            mujoco.mj_comPos(compiled, data)
            for number, site in enumerate(sites):
                mujoco.mj_jacSite(compiled, data, jacobian[number], None, site)
            slopes = jacobian.reshape(-1, compiled.nv)
            normal, gradient = slopes.T @ slopes, slopes.T @ miss.ravel()
            while True:
                damped = normal + np.diag(damping * normal.diagonal() + 1e-12)
                step = np.linalg.solve(damped, -gradient)
                trial = qpos.copy()
                mujoco.mj_integratePos(compiled, trial, step, 1.0)
                miss = place(trial) - target
                gain = cost - (miss**2).sum()
                if gain >= 0.0 or damping > 1e6:
                    break
                damping *= 10.0
            qpos, cost, damping = trial, cost - gain, max(0.1 * damping, 1e-10)
            if gain < SMALL:
                break
        return qpos, tried

    return solve


def scipy_marquardt(model: HandModel, glove: Attachment) -> Solver:
    """MINPACK's Levenberg-Marquardt with the analytic Jacobian in numpy."""

    def solve(target: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
        def misses(step: np.ndarray) -> np.ndarray:
            bones = model.forward_kinematics(move(start[None], step[None]))
            return (glove.centers(model, bones)[0] - target).ravel()

        def slopes(step: np.ndarray) -> np.ndarray:
            bones = model.forward_kinematics(move(start[None], step[None]))
            by_rate = skinned_jacobian(
                model, bones, glove.points, glove.bone_indices, glove.bone_weights
            ).reshape(-1, 26)
            by_rate[:, 3:6] = by_rate[:, 3:6] @ turning(step[3:6])
            return by_rate

        found = least_squares(misses, np.zeros(26), slopes, method="lm", ftol=4e-7, xtol=1e-6, gtol=1e-12)
        return move(start[None], found.x[None])[0], found.nfev

    return solve


def turning(vector: np.ndarray) -> np.ndarray:
    """Turning rate in the turned frame by the rate of a rotation vector."""
    angle = np.linalg.norm(vector)
    if angle < 1e-8:
        return np.eye(3)
    cross = np.cross(np.eye(3), vector / angle).T * -1.0
    return np.eye(3) + (np.cos(angle) - 1.0) / angle * cross + (1.0 - np.sin(angle) / angle) * cross @ cross


def mink_tasks(model: HandModel, glove: Attachment) -> Solver:
    """A position task a marker; the quadratic program is daqp's."""
    import mink

    compiled, sites = with_sites(model, glove)
    configuration = mink.Configuration(compiled)
    tasks = [mink.FrameTask(name, "site", 1.0, 0.0) for name in glove.layout.names]

    def solve(target: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
        configuration.update(start)
        for task, place in zip(tasks, target, strict=True):
            # A miss is told in the tangent space of poses, which is no plain distance unless nothing turns.
            turn = configuration.get_transform_frame_to_world(task.frame_name, "site").rotation()
            task.set_target(mink.SE3.from_rotation_and_translation(turn, place))
        before, tried = np.inf, 0
        while tried < MOST:
            tried += 1
            velocity = mink.solve_ik(configuration, tasks, 1.0, "daqp", damping=1e-9, limits=[])
            configuration.integrate_inplace(velocity, 1.0)
            cost = ((configuration.data.site_xpos[sites] - target) ** 2).sum()
            if abs(before - cost) < SMALL:
                break
            before = cost
        return configuration.q.copy(), tried

    return solve


def follow(
    name: str, solve: Solver, model: HandModel, glove: Attachment, qpos: np.ndarray, targets: np.ndarray
) -> None:
    """Print how a solver follows a motion."""
    solve(targets[0], qpos[0])
    poses, times, counts = [qpos[0]], [], []
    for target in targets[1:]:
        begun = time.perf_counter()
        pose, count = solve(target, poses[-1])
        times.append(1e3 * (time.perf_counter() - begun))
        poses.append(pose)
        counts.append(count)
    found = np.array(poses[1:])
    bones, true = model.forward_kinematics(found), model.forward_kinematics(qpos[1:])
    rms = 1e3 * np.sqrt(((glove.centers(model, bones) - targets[1:]) ** 2).sum(axis=-1).mean(axis=1))
    joints = 1e3 * np.linalg.norm((bones - true)[..., :3, 3], axis=-1).mean()
    angles = np.rad2deg(np.abs(found - qpos[1:])[:, 7:]).mean()
    print(
        f"{name:32} {np.median(times):7.3f} {np.percentile(times, 99):7.3f} ms {np.mean(counts):5.1f} steps, "
        f"RMS {np.median(rms):.6f} mm, worst {rms.max():.6f}, joints {joints:.5f} mm, angles {angles:.5f} deg"
    )


def somebody(rng: np.random.Generator, number: int) -> HandModel:
    while True:
        model = HandModel(sample_shape(side=SIDES[number % 2], rng=rng))
        try:
            resting_angles(model)
        except PoseError:
            continue
        return model


def tell_cold_starts(layout: str, hands: int, noise: float, rng: np.random.Generator) -> None:
    """Print how often a random valid pose is found from nowhere, and how long that takes."""
    excess, times = [], []
    for number in range(hands):
        model = somebody(rng, number)
        glove, count = attach_markers(load_layout(layout), model), 400
        qpos = join_qpos(
            sample_valid_angles(model, count, rng=rng),
            position=rng.normal(size=(count, 3)),
            quaternion=random_quaternions(count, rng=rng),
        )
        targets = glove.centers(model, model.forward_kinematics(qpos))
        targets += noise * rng.standard_normal(targets.shape)
        solver = PoseSolver(GloveFit(model, glove))
        best = solver.solve(targets, qpos).rms
        for frame in range(count):
            begun = time.perf_counter()
            fit = solver.solve(targets[frame : frame + 1])
            times.append(1e3 * (time.perf_counter() - begun))
            excess.append(fit.rms[0] - best[frame])
    found = np.array(excess) <= 1e-4
    within = (np.array(excess) <= 1e-3).mean()
    print(
        f"cold, {layout}, noise {1e3 * noise:g} mm: "
        f"{np.median(times):.3f} ms, p99 {np.percentile(times, 99):.3f}; of {len(found)} poses "
        f"{found.mean():.2%} within 0.1 mm RMS of the fit from the truth, "
        f"{within:.2%} within 1 mm"
    )


def tell_starts(model: HandModel, glove: Attachment, qpos: np.ndarray, rng: np.random.Generator) -> None:
    """Print how long eight starts of one frame take together."""
    targets = np.repeat(glove.centers(model, model.forward_kinematics(qpos)), 8, axis=0)
    solver, times = PoseSolver(GloveFit(model, glove)), []
    starts = move(np.repeat(qpos, 8, axis=0), 0.03 * rng.standard_normal((len(targets), 26)))
    for frame in range(0, len(targets), 8):
        begun = time.perf_counter()
        solver.solve(targets[frame : frame + 8], starts[frame : frame + 8])
        times.append(1e3 * (time.perf_counter() - begun))
    print(f"eight starts 2 degrees and 3 cm off at once: {np.median(times):.3f} ms, "
          f"p99 {np.percentile(times, 99):.3f} ms")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--noise", type=float, default=0.3, help="standard deviation [mm]")
    parser.add_argument("--hands", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    contestants = {"ours": ours, "LM, MuJoCo's Jacobian, numpy": mujoco_marquardt}
    contestants["scipy least_squares, lm"] = scipy_marquardt
    if importlib.util.find_spec("mink"):
        contestants["mink, daqp"] = mink_tasks
        print(describe("mujoco", "numba", "scipy", "mink", "daqp"))
    else:
        print(describe("mujoco", "numba", "scipy"), "\nmink is not installed and left out", sep="")
    rng = np.random.default_rng(arguments.seed)
    model = HandModel.named("M")
    qpos = sample_motion(model, arguments.frames / 120.0, rng=rng).qpos
    skin = attach_markers(load_layout("dense19"), model)
    bones, weights = skin.bone_indices.copy(), np.zeros_like(skin.bone_weights)
    weights[np.arange(len(weights)), skin.bone_weights.argmax(axis=1)] = 1.0
    bound = dataclasses.replace(skin, bone_indices=bones, bone_weights=weights)
    for noise in (0.0, 1e-3 * arguments.noise):
        shaken = noise * rng.standard_normal((len(qpos), *skin.points.shape))
        print(f"a motion of {len(qpos)} frames, noise {1e3 * noise:g} mm; p50, p99")
        for name, contestant in contestants.items():
            targets = bound.centers(model, model.forward_kinematics(qpos)) + shaken
            follow(name, contestant(model, bound), model, bound, qpos, targets)
        targets = skin.centers(model, model.forward_kinematics(qpos)) + shaken
        follow("ours, markers bound as skin is", ours(model, skin), model, skin, qpos, targets)
    tell_starts(model, skin, qpos, rng)
    for layout in ("dense19", "sparse13"):
        for noise in (0.0, 1e-3 * arguments.noise):
            tell_cold_starts(layout, arguments.hands, noise, rng)


if __name__ == "__main__":
    main()
