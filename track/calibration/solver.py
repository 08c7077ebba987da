"""Levenberg-Marquardt over poses, marker places, contact points and one hand shape together.

A frame's pose meets no other frame's, so poses are eliminated frame by frame (Schur complement), which leaves
one system for shape and markers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from track.calibration.contacts import slide_contacts, trust
from track.calibration.energy import Equations, Fit, Guess, Problem

if TYPE_CHECKING:
    from numpy.typing import NDArray

Progress = Callable[[int, float, float], None]
"""Called after each step: its number, `marker_rms` and `contact_gap` [m] (NaN: no touches yet)."""
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-8
_MORE, _LESS, _LEAST_RAISED = 10.0, 0.2, 1e-6  # what a step that failed and one that worked make of it
_MOST_TRIALS: Final = 8
_SMALL_GAIN: Final = 1e-4  # of the energy, after which steps end


def descend(
    problem: Problem, guess: Guess, steps: int, most: int, progress: Progress | None
) -> tuple[Guess, Fit, int]:
    """Step until the energy hardly falls any more, or there have been `most` steps.

    Returns:
        The guess, its fit, and the number of the last step.
    """
    fit, damping, better = problem.fit(guess), _FIRST_DAMPING, True
    while better and steps < most:
        before = fit.cost
        guess, fit, damping, better = _step(problem, guess, fit, damping)
        steps += 1
        if progress is not None:
            progress(steps, marker_rms(problem, fit), contact_gap(guess, fit))
        if abs(before - fit.cost) < _SMALL_GAIN * before:
            break
    return guess, fit, steps


def marker_rms(problem: Problem, fit: Fit) -> float:
    """Median over frames of the markers' RMS distance [m], which wrong labels hardly change."""
    squares = (fit.misses**2).sum(axis=(1, 2)) / problem.there.sum(axis=1)
    return float(np.sqrt(np.median(squares)))


def contact_gap(guess: Guess, fit: Fit) -> float:
    """RMS gap of the trusted touches [m], NaN without any."""
    if guess.contacts is None or fit.meeting is None:
        return float("nan")
    say = trust(fit.meeting, guess.contacts.fingers)
    return float(np.sqrt((say * fit.meeting.gaps**2).sum() / max(say.sum(), 1e-12)))


def eliminate(equations: Equations, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Equations of what is shared (S, S + 1), the poses eliminated, and how poses follow (F, 26, S + 1)."""
    pose = equations.pose.copy()
    every = np.arange(pose.shape[1])
    pose[:, every, every] *= 1.0 + damping
    right = np.concatenate([equations.mixed, equations.pose_gradient[..., None]], axis=2)
    solved = np.linalg.solve(pose, right)
    flat = equations.mixed.reshape(-1, equations.mixed.shape[2])
    reduced = np.concatenate([equations.shared, equations.shared_gradient[:, None]], axis=1)
    reduced -= flat.T @ solved.reshape(len(flat), -1)
    return reduced, solved


def _step(problem: Problem, guess: Guess, fit: Fit, damping: float) -> tuple[Guess, Fit, float, bool]:
    """One step down: the new guess, its fit, the damping to go on with, and whether it is any better."""
    equations = problem.equations(guess, fit)
    for _ in range(_MOST_TRIALS):
        reduced, solved = eliminate(equations, damping)
        system, gradient = reduced[:, :-1].copy(), reduced[:, -1]
        every = np.arange(len(system))
        system[every, every] += damping * equations.shared[every, every]
        shared = -np.linalg.solve(system, gradient)
        poses = -solved[..., -1] - solved[..., :-1] @ shared
        trial = problem.moved(guess, poses, shared)
        trial_fit = problem.fit(trial)
        if trial_fit.cost < fit.cost:
            return *_slid(problem, trial, trial_fit), max(_LESS * damping, _LEAST_DAMPING), True
        damping = max(_MORE * damping, _LEAST_RAISED)
    return guess, fit, damping, False


def _slid(problem: Problem, guess: Guess, fit: Fit) -> tuple[Guess, Fit]:
    """The guess with its contact points slid."""
    if guess.contacts is None:
        return guess, fit
    contacts = slide_contacts(guess.contacts, fit.model, fit.bones[guess.contacts.frames])
    slid = dataclasses.replace(guess, contacts=contacts)
    return slid, problem.fit(slid)
