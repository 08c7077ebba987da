"""A hand's shape and poses and the places of its markers, fitted together to frames of a new glove."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.fit import GloveFit
from track.calibration.energy import (
    COARSE_RELINEARIZE,
    GESTURES_OF_USER,
    first_estimate,
    levenberg_marquardt,
    user_hand,
)
from track.kinematics.pose_solver import PoseSolver

FLESH: Final = 0.003
"""Standard deviation of a marker against its bone [m] in a first fit, before residuals are known."""
_LEAST_FLESH: Final = 0.001  # [m] lower bound: a fit absorbs errors that repeat, so residuals are too small
_PLACE_SPREAD: Final = 0.02  # [m] standard deviation of a marker along the skin from a roughly known place
_HEIGHT_SPREAD: Final = 0.0015  # [m] standard deviation of a marker's height over the skin
_ROBUST_SCALE, _OUTLIER_DISTANCE = 0.02, 0.03  # [m] robust scales of markers and poses
_MOST_STEPS: Final = 20
ROUGH, FINE = 3e-2, 1e-3
"""A fit ends once a step gains a smaller share of its energy."""


class FittedPlaces(NamedTuple):
    """A right hand with its markers where a capture shows them."""

    hand: GloveFit
    cost: float
    """Energy of the fit."""
    residuals: Float[np.ndarray, "M"]
    """Root mean square distance of each marker from its place [m]."""


def fit_places(
    points: Float[np.ndarray, "F M 3"], glove: GloveFit, *, flesh: float, gain: float = ROUGH
) -> FittedPlaces:
    """Fit a right hand and the places of its markers to their points [m], NaN where missing.

    Args:
        points: Points of the markers in some frames.
        glove: A hand in the glove, to begin with.
        flesh: Standard deviation of a marker against its bone [m].
        gain: Share of the energy that a step must gain; with less the fit ends.
    """
    poses = PoseSolver(glove, outlier_distance=_OUTLIER_DISTANCE).solve(points).qpos
    options = {"noise": flesh, "robust_scale": _ROBUST_SCALE, "relinearize": COARSE_RELINEARIZE}
    problem, estimate = first_estimate(glove, points, poses, gestures=GESTURES_OF_USER, **options)
    problem.position_spread, problem.height_spread = _PLACE_SPREAD, _HEIGHT_SPREAD
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _MOST_STEPS, None, gain)
    squares = (fit.residuals**2).sum(axis=2).sum(axis=0) / np.maximum(problem.present.sum(axis=0), 1)
    return FittedPlaces(user_hand(glove, problem, estimate), fit.cost, np.sqrt(squares))


def shown_flesh(residuals: Float[np.ndarray, "M"]) -> float:
    """Standard deviation of markers against their bones [m], from the residuals [m] of a good fit."""
    return max(_LEAST_FLESH, float(np.sqrt(np.mean(residuals**2))))
