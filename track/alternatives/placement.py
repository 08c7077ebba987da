"""How well labeled points fit a hand whose markers may sit elsewhere than the layout says.

Size, proportions, poses and marker places are solved together. An error that repeats counts once: a wrong
place costs one offset, not one residual per frame, and neighbors share an offset.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.fit import GloveFit
from handsim.arrays import Doubles, Flags
from handsim.hand.model import HandModel
from track.calibration.energy import (
    COARSE_RELINEARIZE,
    QUICK_GAIN,
    QUICK_OPTIONS,
    Estimate,
    Problem,
    first_estimate,
    levenberg_marquardt,
    user_hand,
)
from track.calibration.hand_parameters import attachment_at, shape_at
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver

NUM_COMPARED: Final = 10
"""Number of compared frames of a hand, whose errors are about independent."""
COMPLETE_SHARE: Final = 0.75
"""A compared frame shows this share of the usual number of markers."""
_HEIGHT_SPREAD: Final = 0.0015  # [m] standard deviation of a marker's height above the layout's
_OFFSET_SCALE: Final = 0.0035  # [m] scale of a marker's offset from the layout along the skin
_FREEDOM: Final = 2.0  # degrees of freedom of the t-distribution of offsets
_SHARED_SPREAD: Final = 0.008  # [m] standard deviation of the offset that neighbors share
_NEIGHBOR_DISTANCE: Final = 0.035  # [m] distance within which they share it
_NUGGET: Final = 1e-8  # [m^2] keeps the covariance of shared offsets regular
_FIRST_WEIGHT: Final = 0.1  # weight of the offsets in the first round; it is small to reach distant places
_WEIGHTING_ROUNDS: Final = 3  # rounds of weighting offsets
_STEPS_OF_ROUND: Final = 3  # steps of the solver per round
_REWEIGHTING_ROUNDS: Final = 12  # iterations of offsets and weights after each round


class Placement(NamedTuple):
    """A right hand and the places of its markers, fitted to some frames."""

    problem: Problem
    start: GloveFit
    """The hand in the glove as designed."""
    estimate: Estimate
    offsets: Float[np.ndarray, "M 3"]
    """Offset of each marker from its place in the layout [m]; zero for markers that are never seen."""
    cost: float
    """Negative log-likelihood, up to a constant."""

    @property
    def hand(self) -> GloveFit:
        """The hand with its markers where they are."""
        return user_hand(self.start, self.problem, self.estimate)


def are_complete(counts: Int[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    """Whether frames that show these numbers of a hand's markers are compared."""
    usual = float(np.median(counts[counts > 0])) if counts.any() else 0.0
    return np.asarray(counts >= max(FEWEST_MARKERS, COMPLETE_SHARE * usual))


def place_markers(seen: Float[np.ndarray, "F M 3"], start: GloveFit, left_open: float = 1.0) -> Placement:
    """Fit a hand and the places of its markers.

    Args:
        seen: Labeled points of a right hand [m], NaN where missing.
        start: A right hand in the glove as designed, of about the right size; or the hand of a person.
        left_open: Standard deviations of the hand's shape around that of `start`, as a share of people's.
    """
    options = {**QUICK_OPTIONS, "relinearize": COARSE_RELINEARIZE}
    problem, estimate = first_estimate(start, seen, PoseSolver(start).solve(seen).qpos, **options)
    problem.position_spread, problem.height_spread = _OFFSET_SCALE, _HEIGHT_SPREAD
    problem.precision = problem.precision / left_open**2
    return _placed(problem, start, estimate)


def place_again(seen: Float[np.ndarray, "F M 3"], base: Placement) -> Placement:
    """Fit the same hand with other labels of the same points, starting from its shape."""
    shape = shape_at(base.problem.shape, base.estimate.parameters)
    start, design = base.estimate, base.problem.design
    designed = attachment_at(base.start.layout, design, shape)
    qpos = PoseSolver(GloveFit(HandModel(shape), designed)).solve(seen).qpos
    estimate = dataclasses.replace(start, points=designed.points, coordinates=design, qpos=qpos)
    return _placed(base.problem.with_targets(seen), base.start, estimate)


def _placed(problem: Problem, start: GloveFit, estimate: Estimate) -> Placement:
    """Solve hand and places, and compute their cost."""
    there: Bool[np.ndarray, "M"] = np.asarray(problem.present.any(axis=0))
    covariance = _shared_covariance(start.attachment.points, there)
    weights = np.full(len(there), _FIRST_WEIGHT)
    problem.design_shift = np.zeros((len(there), 3))
    for _ in range(_WEIGHTING_ROUNDS):
        problem.place_weights = weights
        estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _STEPS_OF_ROUND, None, QUICK_GAIN)
        offsets = fit.design_residuals + problem.design_shift
        problem.design_shift, weights = _shared_offsets(offsets, covariance)
    fit = problem.fit(estimate)
    off, shift = fit.design_residuals, problem.design_shift
    weighted = np.einsum("mi,mij,mj->", off, problem.position_precision(fit), off)
    smooth = np.einsum("mi,mi->", shift, np.linalg.solve(covariance + _NUGGET * np.eye(len(off)), shift))
    cost = 0.5 * (fit.cost - weighted + smooth) + offset_cost(off[there]).sum()
    return Placement(problem, start, estimate, np.where(there[:, None], offsets, 0.0), float(cost))


def offset_cost(off: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
    """Negative log-likelihood of the offset of a marker from its place [m], with heavy tails."""
    squares = (off**2).sum(axis=-1) / (_FREEDOM * _OFFSET_SCALE**2)
    return np.asarray(0.5 * (_FREEDOM + 3.0) * np.log1p(squares))


def _shared_offsets(off: Doubles, covariance: Doubles) -> tuple[Doubles, Doubles]:
    """The part (M, 3) of offsets that neighbors share, by its covariance, and the rest's weights (M,)."""
    shared = np.zeros_like(off)
    for _ in range(_REWEIGHTING_ROUNDS):
        weights = (_FREEDOM + 3.0) / (_FREEDOM + ((off - shared) ** 2).sum(axis=1) / _OFFSET_SCALE**2)
        shared = covariance @ np.linalg.solve(covariance + np.diag(_OFFSET_SCALE**2 / weights), off)
    return shared, weights


def _shared_covariance(points: Doubles, of: Flags) -> Float[np.ndarray, "M M"]:
    """Covariance of the shared offsets of some markers at rest positions [m]; zero for the others."""
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    near = _SHARED_SPREAD**2 * np.exp(-0.5 * squares / _NEIGHBOR_DISTANCE**2)
    return np.where(of[:, None] & of, near, 0.0)
