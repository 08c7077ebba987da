"""Levenberg-Marquardt over all poses, marker positions, contact points and one hand shape.

A frame's pose shares no residual with another frame's pose. Poses are therefore eliminated frame by frame
(Schur complement), which leaves one system for shape and markers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GloveFit
from handsim.hand.model import HandModel
from track.calibration.contacts import contact_weights, slide_contacts
from track.calibration.energy import Estimate, Fit, NormalEquations, Problem
from track.calibration.hand_parameters import shape_at
from track.calibration.skin_coordinates import attachment_at

Progress = Callable[[int, float, float], None]
"""Called after each step: its number, `marker_rms` and `contact_gap` [m] (NaN: no contacts yet)."""
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-8
_MORE, _LESS, _LEAST_RAISED = 10.0, 0.2, 1e-6  # factors of the damping after a failed step and a good one
_MOST_TRIALS: Final = 8
SMALL_GAIN: Final = 1e-4
"""Share of the energy; a step that gains less is the last one."""


def levenberg_marquardt(
    problem: Problem,
    estimate: Estimate,
    steps: int,
    most: int,
    progress: Progress | None,
    small_gain: float = SMALL_GAIN,
) -> tuple[Estimate, Fit, int]:
    """Minimize the energy until a step gains less than a share of it, or step number `most` has been made.

    Returns the estimate, its fit, and the number of the last step; `steps` were made before.
    """
    fit, damping, better = problem.fit(estimate), _FIRST_DAMPING, True
    while better and steps < most:
        before = fit.cost
        estimate, fit, damping, better = _step(problem, estimate, fit, damping)
        steps += 1
        if progress is not None:
            progress(steps, marker_rms(problem, fit), contact_gap(estimate, fit))
        if abs(before - fit.cost) < small_gain * before:
            break
    return estimate, fit, steps


def marker_rms(problem: Problem, fit: Fit) -> float:
    """Median over frames of the markers' RMS distance [m]; wrong labels hardly change it."""
    squares = (fit.residuals**2).sum(axis=(1, 2)) / problem.present.sum(axis=1)
    return float(np.sqrt(np.median(squares)))


def contact_gap(estimate: Estimate, fit: Fit) -> float:
    """Weighted RMS gap of the contacts [m], NaN without any."""
    if estimate.contacts is None or fit.geometry is None:
        return float("nan")
    weights = contact_weights(fit.geometry, estimate.contacts.fingers)
    return float(np.sqrt((weights * fit.geometry.gaps**2).sum() / max(weights.sum(), 1e-12)))


def user_hand(right: GloveFit, problem: Problem, estimate: Estimate) -> GloveFit:
    """The right hand of an estimate in its glove.

    Args:
        right: A right hand in the same glove.
        estimate: Shape and markers.
    """
    shape = shape_at(problem.shape, estimate.parameters)
    return GloveFit(HandModel(shape), attachment_at(right.attachment.layout, estimate.coordinates, shape))


def eliminate_poses(
    equations: NormalEquations, damping: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Schur complement of the poses, with `damping` times the diagonal of their blocks added to it.

    Returns:
        The reduced system with its gradient as the last column (S, S + 1), and the poses' blocks solved for
        the shared unknowns and the gradient (F, 26, S + 1).
    """
    pose = equations.pose.copy()
    diagonal = np.arange(pose.shape[1])
    pose[:, diagonal, diagonal] *= 1.0 + damping
    right = np.concatenate([equations.mixed, equations.pose_gradient[..., None]], axis=2)
    solved = np.linalg.solve(pose, right)
    flat = equations.mixed.reshape(-1, equations.mixed.shape[2])
    reduced = np.concatenate([equations.shared, equations.shared_gradient[:, None]], axis=1)
    reduced -= flat.T @ solved.reshape(len(flat), -1)
    return reduced, solved


def shared_covariance(problem: Problem, estimate: Estimate, fit: Fit) -> Float[np.ndarray, "S S"]:
    """Covariance of the shared unknowns, whatever the poses are: the inverse of the reduced system."""
    reduced, _ = eliminate_poses(problem.normal_equations(estimate, fit), 0.0)
    return np.linalg.inv(reduced[:, :-1])


def _step(
    problem: Problem, estimate: Estimate, fit: Fit, damping: float
) -> tuple[Estimate, Fit, float, bool]:
    """One step: the new estimate, its fit, the next damping, and whether the energy fell."""
    equations = problem.normal_equations(estimate, fit)
    for _ in range(_MOST_TRIALS):
        reduced, solved = eliminate_poses(equations, damping)
        system, gradient = reduced[:, :-1].copy(), reduced[:, -1]
        diagonal = np.arange(len(system))
        system[diagonal, diagonal] += damping * equations.shared[diagonal, diagonal]
        shared = -np.linalg.solve(system, gradient)
        poses = -solved[..., -1] - solved[..., :-1] @ shared
        trial = problem.apply_step(estimate, poses, shared)
        trial_fit = problem.fit(trial)
        if trial_fit.cost < fit.cost:
            return *_with_slid_contacts(problem, trial, trial_fit), max(_LESS * damping, _LEAST_DAMPING), True
        damping = max(_MORE * damping, _LEAST_RAISED)
    return estimate, fit, damping, False


def _with_slid_contacts(problem: Problem, estimate: Estimate, fit: Fit) -> tuple[Estimate, Fit]:
    """The estimate after its contact points have slid on the skin, and its fit."""
    if estimate.contacts is None:
        return estimate, fit
    contacts = slide_contacts(estimate.contacts, fit.model, fit.bones[estimate.contacts.frames])
    slid = dataclasses.replace(estimate, contacts=contacts)
    return slid, problem.fit(slid)
