"""How well labeled points fit a hand whose markers may sit elsewhere than the layout says.

Size, proportions, poses and places are solved together. An error that repeats counts once: a wrong place
costs as one offset, not as one residual in each frame, and neighbors share an offset.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from handsim.hand.model import HandModel
from track.calibration.energy import (
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

FRAMES: Final = 10
"""Compared frames of a hand, whose errors are about independent."""
COMPLETE: Final = 0.75
"""A compared frame shows this share of the usual number of markers."""
_RELINEARIZE: Final = 0.2  # A smaller value changes no probability by more than 0.01.
_LIFT: Final = 0.0015  # [m] standard deviation of a marker's height above the layout's
_GLUED: Final = 0.0035  # [m] scale of the offset of a marker along the skin
_TAILS: Final = 2.0  # degrees of freedom of the t-distribution of offsets
_SHARED: Final = 0.008  # [m] standard deviation of the offset that neighbors share
_NEIGHBORHOOD: Final = 0.035  # [m] distance within which they share it
_NUGGET: Final = 1e-8  # [m^2] keeps the covariance of shared offsets regular
_FIRST_WEIGHT: Final = 0.1  # of the offsets in the first round, so that a far place is reached
_ROUNDS: Final = 3  # of weighting offsets
_STEPS: Final = 3  # of the solver in each
_REWEIGHTED: Final = 12  # iterations of offsets and weights after each


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
    """Whether frames that show so many markers of a hand are compared."""
    usual = float(np.median(counts[counts > 0])) if counts.any() else 0.0
    return np.asarray(counts >= max(FEWEST_MARKERS, COMPLETE * usual))


def place_markers(seen: Float[np.ndarray, "F M 3"], start: GloveFit, left_open: float = 1.0) -> Placement:
    """Fit a hand and the places of its markers.

    Args:
        seen: Labeled points of a right hand [m], NaN where missing.
        start: A right hand in the glove as designed, of about the right size; or the hand of a person.
        left_open: Standard deviations of the hand's shape from that of `start`, as a share of people's.
    """
    options = {**QUICK_OPTIONS, "relinearize": _RELINEARIZE}
    problem, estimate = first_estimate(start, seen, PoseSolver(start).solve(seen).qpos, **options)
    problem.position_spread, problem.height_spread = _GLUED, _LIFT
    problem.precision = problem.precision / left_open**2
    return _placed(problem, start, estimate)


def place_again(seen: Float[np.ndarray, "F M 3"], base: Placement) -> Placement:
    """Fit the same hand with other labels of the same points, starting from its shape."""
    shape = shape_at(base.problem.shape, base.estimate.parameters)
    designed = attachment_at(base.start.layout, base.problem.design, shape)
    qpos = PoseSolver(GloveFit(HandModel(shape), designed)).solve(seen).qpos
    estimate = dataclasses.replace(
        base.estimate, points=designed.points, coordinates=base.problem.design, qpos=qpos
    )
    return _placed(base.problem.with_targets(seen), base.start, estimate)


def _placed(problem: Problem, start: GloveFit, estimate: Estimate) -> Placement:
    """Solve hand and places, and rate them."""
    there: Bool[np.ndarray, "M"] = np.asarray(problem.present.any(axis=0))
    covariance = _covariance(start.attachment.points, there)
    weights = np.full(len(there), _FIRST_WEIGHT)
    problem.design_shift = np.zeros((len(there), 3))
    for _ in range(_ROUNDS):
        problem.place_weights = weights
        estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _STEPS, None, QUICK_GAIN)
        offsets = fit.design_residuals + problem.design_shift
        problem.design_shift, weights = _smooth_part(offsets, covariance)
    fit = problem.fit(estimate)
    off, shift = fit.design_residuals, problem.design_shift
    weighted = np.einsum("mi,mij,mj->", off, problem.position_precision(fit), off)
    smooth = np.einsum("mi,mi->", shift, np.linalg.solve(covariance + _NUGGET * np.eye(len(off)), shift))
    cost = 0.5 * (fit.cost - weighted + smooth) + offset_cost(off[there]).sum()
    return Placement(problem, start, estimate, np.where(there[:, None], offsets, 0.0), float(cost))


def offset_cost(off: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
    """Negative log-likelihood of the offset of a marker from its place [m], with heavy tails."""
    return np.asarray(0.5 * (_TAILS + 3.0) * np.log1p((off**2).sum(axis=-1) / (_TAILS * _GLUED**2)))


def _smooth_part(
    off: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M"]]:
    """The part of offsets that neighbors share, given their covariance, and the weights of the rest."""
    shared = np.zeros_like(off)
    for _ in range(_REWEIGHTED):
        weights = (_TAILS + 3.0) / (_TAILS + ((off - shared) ** 2).sum(axis=1) / _GLUED**2)
        shared = covariance @ np.linalg.solve(covariance + np.diag(_GLUED**2 / weights), off)
    return shared, weights


def _covariance(points: NDArray[np.float64], of: NDArray[np.bool_]) -> Float[np.ndarray, "M M"]:
    """Covariance of the shared offsets of some markers at rest positions [m]; zero for the others."""
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    near = _SHARED**2 * np.exp(-0.5 * squares / _NEIGHBORHOOD**2)
    return np.where(of[:, None] & of, near, 0.0)
