"""What is believed of a hand's hinges before its markers are asked.

Hinges wander as an Ornstein-Uhlenbeck process whose resting distribution is that of the gestures people make:
what is not seen for a while spreads to there, and not beyond; and as neighbouring fingers bend together,
those that are seen tell of those that are not.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.topology import NUM_JOINTS
from poses.library import LIBRARIES, gestures_of
from track.expectation import Expectation

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
def resting_covariance() -> Float[np.ndarray, "20 20"]:
    """Of the hinges over all gestures [rad^2]."""
    gestures = np.concatenate([gestures_of(library) for library in LIBRARIES])
    covariance: NDArray[np.float64] = np.cov(gestures.T) + _OWN_WAYS**2 * np.eye(NUM_JOINTS)
    return covariance


def foresee(
    angles: Float[np.ndarray, "20"], covariance: Float[np.ndarray, "20 20"], span: float
) -> HingeBelief:
    """What is believed some time after the hinges were known so well.

    Args:
        angles: Where they are coming to [rad].
        covariance: How well they were known [rad^2].
        span: The time since then [s].
    """
    kept = np.exp(-2.0 * max(span, 0.0) / _WANDERING)
    spread = kept * covariance + (1.0 - kept) * resting_covariance() + _LEAST**2 * np.eye(NUM_JOINTS)
    return HingeBelief(angles, spread, np.linalg.inv(spread))


def belief_of_digit(
    belief: HingeBelief, seen: Expectation, digit: int
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4 4"]]:
    """What the other digits say of one: its angles [rad] and their precision [1/rad^2]."""
    hinges = slice(4 * digit, 4 * digit + 4)
    told, pull = seen.told.copy(), seen.pull - seen.told @ belief.angles
    told[hinges], told[:, hinges], pull[hinges] = 0.0, 0.0, 0.0
    covariance = np.linalg.inv(belief.precision + told)
    angles = belief.angles[hinges] + covariance[hinges] @ pull
    return angles, np.linalg.inv(covariance[hinges, hinges])
