"""What is believed of a hand's hinges before its markers are asked.

Hinges wander as an Ornstein-Uhlenbeck process whose resting distribution is that of the gestures people make:
what is not seen for a while spreads to there, and not beyond; and as neighboring fingers bend together,
those that are seen tell of those that are not.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from handsim.hand.topology import NUM_JOINTS
from poses.shapes.library import LIBRARIES, gestures_of
from track.kinematics.small_systems import eliminate, invert_positive, solve_positive

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_WANDERING: Final = 1.0  # [s] after which little is known of a hinge
_OWN_WAYS: Final = np.deg2rad(6.0)  # spread of every hinge beyond what the gestures say
_LEAST: Final = np.deg2rad(0.5)  # spread of a hinge that was just seen


class HingeBelief(NamedTuple):
    """A normal distribution of the hinges."""

    angles: Float[np.ndarray, "20"]
    """Their mean [rad]."""
    covariance: Float[np.ndarray, "20 20"]
    """[rad^2]."""
    precision: Float[np.ndarray, "20 20"]
    """Its inverse."""

    @property
    def spread(self) -> Float[np.ndarray, "20"]:
        """Standard deviation of each hinge [rad]."""
        spread: NDArray[np.float64] = np.sqrt(np.diag(self.covariance))
        return spread


@cache
def resting_angles() -> Float[np.ndarray, "20"]:
    """Mean of the hinges over all gestures [rad]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    angles: NDArray[np.float64] = gestures.mean(axis=0)
    return angles


@cache
def resting_covariance() -> Float[np.ndarray, "20 20"]:
    """Of the hinges over all gestures [rad^2]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    covariance: NDArray[np.float64] = np.cov(gestures.T) + _OWN_WAYS**2 * np.eye(NUM_JOINTS)
    return covariance


def rest() -> HingeBelief:
    """What is believed of a hand of which nothing is known."""
    covariance = resting_covariance()
    return HingeBelief(resting_angles(), covariance, np.linalg.inv(covariance))


def foresee(
    angles: Float[np.ndarray, "20"], covariance: Float[np.ndarray, "20 20"], span: float
) -> HingeBelief:
    """What is believed some time after the hinges were known so well.

    Args:
        angles: Where they are coming to [rad].
        covariance: How well they were known [rad^2].
        span: The time since then [s].
    """
    belief = HingeBelief(angles, np.empty_like(covariance), np.empty_like(covariance))
    _foresee(covariance, resting_covariance(), np.exp(-2.0 * max(span, 0.0) / _WANDERING), belief)
    return belief


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _foresee(known: Any, resting: Any, kept: Any, belief: Any) -> None:
    for row in range(len(known)):
        for column in range(len(known)):
            belief.covariance[row, column] = kept * known[row, column] + (1.0 - kept) * resting[row, column]
        belief.covariance[row, row] += _LEAST**2
    belief.precision[:] = belief.covariance
    invert_positive(belief.precision)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def believe_digit(belief: Any, told: Any, pull: Any, digit: Any, angles: Any, trust: Any) -> None:
    """What the other digits say of one.

    Args:
        belief: What was believed of the hinges before the markers were asked.
        told: What the markers tell of the hinges, see `Expectation.told`.
        pull: See `Expectation.pull`.
        digit: Which digit.
        angles: Its angles (4,) [rad], filled.
        trust: Their precision (4, 4) [1/rad^2], filled.
    """
    count = len(pull)
    order, system, rest = np.empty(count, dtype=np.int64), np.empty((count, count)), np.zeros(count)
    place = 0
    for hinge in range(count):  # the digit's own hinges last, so that the others are eliminated from them
        own = hinge // 4 == digit
        order[count - 4 + hinge % 4 if own else place] = hinge
        place += not own
    for row in range(count):
        one = order[row]
        for column in range(count):
            system[row, column] = belief.precision[one, order[column]]
        if row < count - 4:
            rest[row] = pull[one]
            for column in range(count):
                rest[row] -= told[one, order[column]] * belief.angles[order[column]]
            for column in range(count - 4):
                system[row, column] += told[one, order[column]]
    eliminate(system, rest, 0, count - 4)
    trust[:] = system[count - 4 :, count - 4 :]
    solve_positive(system[count - 4 :, count - 4 :], rest[count - 4 :])
    for row in range(4):
        angles[row] = belief.angles[4 * digit + row] + rest[count - 4 + row]
