"""Solvers of a hand's pose from labeled markers, which `benchmarks.speed` times: ours and others'.

A random 120 Hz motion is followed, every frame from the pose that the same solver found for the one before.
For the comparison each marker of dense19 is bound to one bone, because a site of MuJoCo is; all stop where a
step brings the markers less than a micron nearer. mink takes part where it is installed (`pip install
"mink[daqp]"`).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import time
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from scipy.optimize import least_squares

from benchmarks.record import timed
from gloves import Attachment, GloveFit, load_layout
from gloves.fit import attach_markers
from handsim import HandModel, join_qpos
from handsim.hand.model import build_spec, skinned_jacobian
from handsim.kernels import move
from handsim.space.transforms import random_quaternions
from poses import sample_motion
from poses.shapes import sample_valid_angles
from track.kinematics.pose_solver import PoseSolver

Solver = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, int]]
SMALL = 1e-12  # [m^2] by which the summed squares may still fall when a solver stops
MOST = 50
NOISE = 3e-4  # of markers [m]
HAS_MINK = importlib.util.find_spec("mink") is not None


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


def mink_tasks(model: HandModel, glove: Attachment) -> Solver:
    """A position task for each marker; daqp solves the quadratic program."""
    import mink

    compiled, sites = with_sites(model, glove)
    configuration = mink.Configuration(compiled)
    tasks = [mink.FrameTask(name, "site", 1.0, 0.0) for name in glove.layout.names]

    def solve(target: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, int]:
        configuration.update(start)
        for task, place in zip(tasks, target, strict=True):
            # A pose's error is its distance in space only where the orientation is met.
            rotation = configuration.get_transform_frame_to_world(task.frame_name, "site").rotation()
            task.set_target(mink.SE3.from_rotation_and_translation(rotation, place))
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


def turning(vector: np.ndarray) -> np.ndarray:
    """Turning rate in the turned frame by the rate of a rotation vector."""
    angle = np.linalg.norm(vector)
    if angle < 1e-8:
        return np.eye(3)
    cross = np.cross(np.eye(3), vector / angle).T * -1.0
    return np.eye(3) + (np.cos(angle) - 1.0) / angle * cross + (1.0 - np.sin(angle) / angle) * cross @ cross


def follow(
    solve: Solver, model: HandModel, glove: Attachment, qpos: np.ndarray, targets: np.ndarray
) -> tuple[list[float], float]:
    """How a solver follows a motion, each frame from the pose before: times [s], median RMS distance [m]."""
    solve(targets[0], qpos[0])
    poses, times = [qpos[0]], []
    for target in targets[1:]:
        begun = time.perf_counter()
        pose, _ = solve(target, poses[-1])
        times.append(time.perf_counter() - begun)
        poses.append(pose)
    bones = model.forward_kinematics(np.array(poses[1:]))
    squares = ((glove.centers(model, bones) - targets[1:]) ** 2).sum(axis=-1)
    return times, float(np.median(np.sqrt(squares.mean(axis=1))))


def from_nothing(model: HandModel, glove: Attachment, count: int, rng: np.random.Generator) -> list[float]:
    """Times to find random valid poses anywhere [s]."""
    qpos = join_qpos(
        sample_valid_angles(model, count, rng=rng),
        position=rng.normal(size=(count, 3)),
        quaternion=random_quaternions(count, rng=rng),
    )
    targets = glove.centers(model, model.forward_kinematics(qpos))
    targets += NOISE * rng.standard_normal(targets.shape)
    solver = PoseSolver(GloveFit(model, glove))
    return _times(lambda frame: solver.solve(targets[frame : frame + 1]), count)


def from_eight_starts(
    model: HandModel, glove: Attachment, qpos: np.ndarray, rng: np.random.Generator
) -> list[float]:
    """Times of eight starts of one frame together, 2 degrees and 3 cm off [s]."""
    targets = np.repeat(glove.centers(model, model.forward_kinematics(qpos)), 8, axis=0)
    starts = move(np.repeat(qpos, 8, axis=0), 0.03 * rng.standard_normal((len(targets), 26)))
    solver = PoseSolver(GloveFit(model, glove))
    eight = [slice(8 * frame, 8 * frame + 8) for frame in range(len(qpos))]
    return _times(lambda frame: solver.solve(targets[eight[frame]], starts[eight[frame]]), len(qpos))


def _times(job: Callable[[int], object], count: int) -> list[float]:
    """Times of a job for each number below a count [s], the first left out."""
    return [timed(functools.partial(job, number)) for number in range(count)][1:]


def times(seeds: Sequence[int], frames: int) -> Iterator[tuple[str, str, list[float]]]:
    """A key, what it is, and times [s]: motions that each solver follows, one a seed, and ours alone."""
    contestants: dict[str, tuple[str, Callable[[HandModel, Attachment], Solver]]] = {
        "ours": ("our solver", ours),
        "numpy": ("the same steps, MuJoCo's Jacobian, numpy", mujoco_marquardt),
        "scipy": ("scipy least_squares, lm", scipy_marquardt),
    }
    if HAS_MINK:
        contestants["mink"] = ("mink, daqp", mink_tasks)
    model = HandModel.named("M")
    skin = attach_markers(load_layout("dense19"), model)
    weights = np.zeros_like(skin.bone_weights)
    weights[np.arange(len(weights)), skin.bone_weights.argmax(axis=1)] = 1.0
    bound = dataclasses.replace(skin, bone_weights=weights)
    found: dict[str, tuple[str, list[float]]] = {}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        qpos = sample_motion(model, frames / 120.0, rng=rng).qpos
        noise = NOISE * rng.standard_normal((len(qpos), *skin.points.shape))
        jobs = [(key, what, solver, bound) for key, (what, solver) in contestants.items()]
        for key, what, solver, glove in [
            *jobs,
            ("ours_skin", "our solver, markers bound as skin is", ours, skin),
        ]:
            targets = glove.centers(model, model.forward_kinematics(qpos)) + noise
            took, rms = follow(solver(model, glove), model, glove, qpos, targets)
            told = f"a pose from the frame before, {what}, {1e3 * rms:.4f} mm RMS"
            found.setdefault(f"solver_{key}", (told, []))[1].extend(took)
        eight = from_eight_starts(model, skin, qpos, rng)
        found.setdefault("solver_eight", ("a pose, our solver, eight starts", []))[1].extend(eight)
        cold = from_nothing(model, skin, frames, rng)
        found.setdefault("solver_cold", ("a pose from nothing, our solver", []))[1].extend(cold)
    for key, (what, seconds) in found.items():
        yield key, what, seconds
