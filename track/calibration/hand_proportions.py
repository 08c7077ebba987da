"""A hand's proportions and the places of its markers from a few frames.

The unknowns and their priors are those of a calibration, without touches: what the frames do not tell stays
as it was.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.fit import GloveFit
from handsim.hand.topology import Side
from handsim.space.transforms import MIRROR
from track.calibration.energy import Estimate, Problem
from track.calibration.hand_parameters import NUM_PARAMETERS
from track.calibration.skin_coordinates import nearest_coordinates
from track.calibration.solver import levenberg_marquardt, user_hand
from track.kinematics.pose_solver import PoseSolver

_NOISE: Final = 0.003  # [m] twice that of real gloves: flesh repeats in frames that are much alike
_ROBUST_SCALE: Final = 0.015  # [m]
_STEPS: Final = 15


def fit_proportions(
    markers: Mapping[Side, Float[np.ndarray, "F M 3"]], start: GloveFit
) -> tuple[GloveFit, float]:
    """One shape for all hands of a user.

    Args:
        markers: Labeled markers of each hand in the glove's order [m]; NaN where missing, at least four seen
            in every frame.
        start: A right hand of about the right length and breadth in the glove as designed.

    Returns:
        The right hand in its glove, and the median over frames of the RMS distance of its markers [m].
    """
    seen = np.concatenate([some @ MIRROR if side == "left" else some for side, some in markers.items()])
    worn, shape = start.attachment, start.model.shape
    coordinates = nearest_coordinates(worn.points, shape)
    problem = Problem(shape, coordinates, worn.layout.heights, seen, noise=_NOISE, robust_scale=_ROBUST_SCALE)
    poses = PoseSolver(start).solve(seen).qpos
    estimate = Estimate(np.zeros(NUM_PARAMETERS), worn.points, coordinates, poses)
    estimate, _, _ = levenberg_marquardt(problem, estimate, 0, _STEPS, None)
    hand = user_hand(start, problem, estimate)
    return hand, float(np.median(PoseSolver(hand).solve(seen, estimate.qpos).rms))
