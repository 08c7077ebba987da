"""Prior of a hand's hinge angles before its markers are used: a normal distribution of all 20 together.

The hinges follow an Ornstein-Uhlenbeck process whose resting distribution is that of the gestures people
make. A hinge that no marker shows for a while returns to that distribution, in its mean and in its spread.
Neighboring fingers bend together, so the covariance carries information from visible digits to hidden ones.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.shape import NUM_JOINTS
from handsim.kernels.kernel import kernel
from poses.shapes import LIBRARIES, gestures_of
from track.kinematics.levenberg_marquardt import eliminate, invert_positive, solve_positive

# Little is known of a hinge after it, so that a digit with one marker that was bent as few are finds back.
_JOINT_MEMORY: Final = 0.3  # [s] time constant of the process of the hinges
_JOINT_SPREAD: Final = float(np.deg2rad(0.5))  # least standard deviation of a predicted hinge
_GESTURE_MARGIN: Final = float(np.deg2rad(6.0))  # added to the gestures' spread, for poses that none shows


class JointPrior(NamedTuple):
    """A normal distribution of the hinges."""

    angles: Float[np.ndarray, "20"]
    """Mean [rad]."""
    covariance: Float[np.ndarray, "20 20"]
    """Covariance [rad^2]."""
    precision: Float[np.ndarray, "20 20"]
    """Inverse of the covariance [1/rad^2]."""

    @property
    def spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each hinge [rad]."""
        return np.sqrt(np.diag(self.covariance))


@cache
def resting_angles() -> Float[np.ndarray, "20"]:
    """Mean of the hinges over all gestures [rad]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    angles: NDArray[np.float64] = gestures.mean(axis=0)
    return angles


@cache
def resting_covariance() -> Float[np.ndarray, "20 20"]:
    """Covariance of the hinges over all gestures, and a margin for other poses [rad^2]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    return np.cov(gestures.T) + _GESTURE_MARGIN**2 * np.eye(NUM_JOINTS)


@cache
def resting_prior() -> JointPrior:
    """Prior of a hand without any history."""
    covariance = resting_covariance()
    return JointPrior(resting_angles(), covariance, np.linalg.inv(covariance))


def predict_joints(
    angles: Float[np.ndarray, "20"],
    covariance: Float[np.ndarray, "20 20"],
    span: float,
) -> JointPrior:
    """Prior of the hinges some time after they were estimated.

    Args:
        angles: Predicted angles [rad], by velocity alone; they return to those of a resting hand.
        span: Time since the estimate [s].
    """
    kept = np.exp(-max(span, 0.0) / _JOINT_MEMORY)
    mean = angles + (1.0 - kept) * (resting_angles() - angles)
    prior = JointPrior(mean, np.empty_like(covariance), np.empty_like(covariance))
    _predict_covariance(covariance, resting_covariance(), kept**2, prior)
    return prior


@kernel
def _predict_covariance(
    known: Float[np.ndarray, "20 20"],
    resting: Float[np.ndarray, "20 20"],
    kept: float,
    prior: JointPrior,
) -> None:
    """Fill covariance and precision of a prior: a share of what is known, the rest of a resting hand."""
    for row in range(len(known)):
        for column in range(len(known)):
            prior.covariance[row, column] = kept * known[row, column] + (1.0 - kept) * resting[row, column]
        prior.covariance[row, row] += _JOINT_SPREAD**2
    prior.precision[:] = prior.covariance
    invert_positive(prior.precision)


@kernel
def digit_prior(
    prior: JointPrior,
    information_matrix: Float[np.ndarray, "20 20"],
    information_vector: Float[np.ndarray, "20"],
    digit: int,
    angles: Float[np.ndarray, "4"],
    precision: Float[np.ndarray, "4 4"],
) -> None:
    """Fill mean and precision of one digit's hinges, given the others' markers; see `MarkerPrediction`."""
    count = len(information_vector)
    order, system, right_side = np.empty(count, dtype=np.int64), np.empty((count, count)), np.zeros(count)
    index = 0
    for hinge in range(count):  # the digit's own hinges last, so that the others are eliminated from them
        own = hinge // 4 == digit
        order[count - 4 + hinge % 4 if own else index] = hinge
        index += not own
    for row in range(count):
        one = order[row]
        for column in range(count):
            system[row, column] = prior.precision[one, order[column]]
        if row < count - 4:
            right_side[row] = information_vector[one]
            for column in range(count):
                right_side[row] -= information_matrix[one, order[column]] * prior.angles[order[column]]
            for column in range(count - 4):
                system[row, column] += information_matrix[one, order[column]]
    eliminate(system, right_side, 0, count - 4)
    precision[:] = system[count - 4 :, count - 4 :]
    solve_positive(system[count - 4 :, count - 4 :], right_side[count - 4 :])
    for row in range(4):
        angles[row] = prior.angles[4 * digit + row] + right_side[count - 4 + row]
