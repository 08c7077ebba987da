"""Inverse kinematics from labeled markers: the paper's E_IK (Han et al. 2018, section 4.3) for one hand.

Frames are solved one by one, each from its own start; a missing marker is NaN. Two terms determine what the
markers leave open: a soft limit of each hinge's range, and a prior on digits that lack a marker or have fewer
than three: weakly towards the resting angles, and towards predicted angles where these are given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from gloves.fit import GloveFit
from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.shape import DIGITS, NUM_JOINTS, NUM_QPOS
from track.kinematics.frame_fits import FEWEST_MARKERS, fit_frames
from track.kinematics.joint_prior import JointPrior
from track.kinematics.levenberg_marquardt import MARKER_NOISE
from track.kinematics.marker_kinematics import HandArrays, hand_arrays
from track.kinematics.marker_prediction import (
    MarkerPrediction,
    empty_prediction,
    predict_markers,
    world_markers,
)
from track.kinematics.starting_poses import StartingShapes, starting_shapes

_MOST_STEPS: Final = 30  # from each start
_CONVERGED: Final = (1e-6 / MARKER_NOISE) ** 2  # of the cost: one marker nearer by a micron
_ACCURATE: Final = (3e-5 / MARKER_NOISE) ** 2  # of the cost, in real time: all markers nearer by 30 um
_NO_WRIST: Final = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # a pose, with precision zero


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Poses and how well they fit."""

    qpos: Float[np.ndarray, "T 27"]
    """The poses."""
    rms: Float[np.ndarray, "T"]
    """3D RMS distance over the markers that are present [m]."""
    residuals: Float[np.ndarray, "T M 3"]
    """Model minus marker [m], NaN where a marker is missing."""
    iterations: Int[np.ndarray, "T"]
    """Steps tried, over all starts of a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class AnglePrior:
    """Independent normal priors of the hinges, for digits that lack a marker or have under three."""

    angles: Float[np.ndarray, "*T 20"]
    """Mean angles [rad], for each frame or for all."""
    spread: ArrayLike
    """Their standard deviation [rad]: one number, or an array that broadcasts with the angles."""


class PoseSolver:
    """Solves poses of one hand in one glove; precomputes what does not depend on the frame.

    Args:
        outlier_distance: Scale [m] of a robust loss (Geman and McClure 1987), so that a wrong label does not
            bend the hand; it needs a good start. Plain least squares when not given.

    Raises:
        ArgumentError: `outlier_distance` is not positive.
    """

    def __init__(
        self,
        fit: GloveFit,
        *,
        outlier_distance: float | None = None,
    ) -> None:
        if outlier_distance is not None and not outlier_distance > 0.0:
            raise ArgumentError(f"outlier_distance is {outlier_distance:g} m, expected a positive distance")
        self.hand: HandArrays = hand_arrays(fit)
        """The hand and its glove; a change of its marker positions takes effect in the next solution."""
        self._shapes: StartingShapes = starting_shapes(fit)
        self._robust_scale = 0.0 if outlier_distance is None else outlier_distance**-2
        parts = (*range(len(DIGITS)), -1)  # the palm last
        self._on_part = np.array([(self.hand.digits == number).sum() for number in parts])

    def solve(
        self,
        targets: Float[np.ndarray, "T M 3"],
        initial: Float[np.ndarray, "T 27"] | None = None,
        *,
        prior: AnglePrior | None = None,
        iterations: int | None = None,
    ) -> PoseFit:
        """Poses whose markers are nearest to labeled ones, each frame by itself.

        Args:
            targets: Labeled markers in the glove's order [m]; NaN where missing.
            initial: Poses to start from; a hand put together from a few shapes when not given, and where that
                does not end within 0.5 mm RMS, each of those shapes, of which the best is kept.
            prior: Distribution of the hinges.
            iterations: Steps at most from each start; 30 when not given.

        Raises:
            ArgumentError: `targets`, `initial` or `prior` do not fit the glove or each other, or a frame has
                fewer than 4 markers.
        """
        # Copies, because a kernel is compiled anew for arrays that are read-only or not contiguous.
        targets = np.array(targets, dtype=np.float64, order="C")
        if targets.ndim != 3 or targets.shape[1:] != self._shapes.markers.shape[1:]:
            raise ArgumentError(
                f"targets have shape {targets.shape}, expected (T, {self._shapes.markers.shape[1]}, 3)"
            )
        starts = np.empty((0, NUM_QPOS))
        if initial is not None:
            starts = np.array(check_array("initial", initial, (None, NUM_QPOS)), order="C")
            if starts.shape != (len(targets), NUM_QPOS):
                raise ArgumentError(
                    f"initial has shape {starts.shape}, expected ({len(targets)}, {NUM_QPOS})"
                )
        angles, precision = _rows(prior, len(targets))
        steps = _MOST_STEPS if iterations is None else iterations
        wrong, fit = self._run(targets, starts, angles, precision, _NO_WRIST, steps, _CONVERGED)
        if wrong >= 0:
            present = int(np.isfinite(targets[wrong]).all(axis=-1).sum())
            if present < FEWEST_MARKERS:
                raise ArgumentError(
                    f"frame {wrong} has {present} markers, expected at least {FEWEST_MARKERS}"
                )
            raise ArgumentError(
                f"initial has a quaternion of length zero in frame {wrong}, expected an orientation"
            )
        return fit

    def solve_frame(
        self,
        target: Float[np.ndarray, "M 3"],
        start: Float[np.ndarray, "27"],
        angles: Float[np.ndarray, "20"],
        spread: Float[np.ndarray, "20"],
        wrist: Float[np.ndarray, "7"],
        wrist_spread: tuple[float, float],
    ) -> PoseFit:
        """`solve` for one frame from a near start, without checks of the arguments: for loops in real time.

        Args:
            target: Labeled markers [m], at least four; NaN where missing.
            start: A pose near the solution.
            angles: Mean of the hinges [rad], see `AnglePrior`.
            spread: Standard deviation of the hinges [rad].
            wrist: Predicted position [m] and orientation (wxyz) of the wrist: a prior where the palm lacks a
                marker or has under three.
            wrist_spread: Standard deviations of that position [m] and orientation [rad].
        """
        wrist_prior = np.concatenate([wrist, np.array(wrist_spread) ** -2.0])
        precision, one = spread[None] ** -2.0, (target[None], start[None], angles[None])
        return self._run(*one, precision, wrist_prior, _MOST_STEPS, _ACCURATE)[1]

    def _run(
        self,
        targets: NDArray[np.float64],
        starts: NDArray[np.float64],
        angles: NDArray[np.float64],
        precision: NDArray[np.float64],
        wrist: NDArray[np.float64],
        iterations: int,
        small_gain: float,
    ) -> tuple[int, PoseFit]:
        """Index of the first frame that cannot be solved (or -1), and the fits; see `fit_frames`."""
        wrong, *arrays = fit_frames(
            self.hand,
            self._shapes,
            self._on_part,
            targets,
            starts,
            angles,
            precision,
            wrist,
            self._robust_scale,
            iterations,
            small_gain,
        )
        return wrong, PoseFit(*arrays)

    def marker_positions(self, qpos: Float[np.ndarray, "27"]) -> Float[np.ndarray, "M 3"]:
        """Positions of a pose's markers in the world [m]."""
        positions = np.empty((len(self.hand.digits), 3))
        world_markers(self.hand, np.array(qpos, dtype=np.float64), positions)
        return positions

    def predict_markers(
        self,
        qpos: Float[np.ndarray, "27"],
        target: Float[np.ndarray, "M 3"],
        joint_prior: JointPrior,
        *,
        wrist_spread: tuple[float, float],
        variance: Float[np.ndarray, "M"],
        noise: float,
    ) -> MarkerPrediction:
        """Positions and covariances of a fitted pose's markers; see `marker_prediction.predict_markers`."""
        predicted = empty_prediction(len(self.hand.digits))
        predict_markers(
            self.hand, self._on_part, qpos, target, joint_prior, wrist_spread, variance, noise, predicted
        )
        return predicted


def solve_pose(
    fit: GloveFit,
    targets: Float[np.ndarray, "T M 3"],
    *,
    initial: Float[np.ndarray, "T 27"] | None = None,
    iterations: int | None = None,
) -> PoseFit:
    """Poses of a hand whose markers are nearest to labeled ones, each frame by itself.

    Args:
        fit: The hand in its glove.
        targets: Labeled markers in the glove's order [m]; NaN where missing.
        initial: Poses to start from [m, rad]; a few general ones when not given.
        iterations: Steps at most from each start.

    Returns:
        Poses (T, 27) [m, rad], RMS distances (T,) [m] and residuals (T, M, 3) [m].

    Raises:
        ArgumentError: The arrays do not fit the glove or each other, or a frame has fewer than 4 markers.
    """
    return PoseSolver(fit).solve(targets, initial, iterations=iterations)


def _rows(prior: AnglePrior | None, frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean angles [rad] and precisions [1/rad^2] of a prior, one row per frame or no rows."""
    if prior is None:
        return np.empty((0, NUM_JOINTS)), np.empty((0, NUM_JOINTS))
    spread = np.asarray(prior.spread, dtype=np.float64)
    if not (spread > 0.0).all():
        raise ArgumentError(f"prior.spread is {spread.min():g} rad, expected positive angles")
    angles = check_array("prior.angles", prior.angles, (NUM_JOINTS,))
    try:
        return (
            np.array(np.broadcast_to(angles, (frames, NUM_JOINTS)), order="C"),
            np.array(np.broadcast_to(spread**-2, (frames, NUM_JOINTS)), order="C"),
        )
    except ValueError:
        raise ArgumentError(
            f"prior has angles of shape {angles.shape} and spread of shape {spread.shape}, "
            f"expected shapes that broadcast to ({frames}, {NUM_JOINTS})"
        ) from None
