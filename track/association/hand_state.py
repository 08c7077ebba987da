"""What a tracker remembers of a hand: its pose and motion, and by how much each marker tends to miss it.

A hand that is not quite the user's misses its markers by the same few millimeters in every frame, seen from
the bones that carry them. Once that habit is known, a marker is expected where the pose and its habit put it,
which is nearly as sharp for an uncalibrated hand as for a calibrated one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from gloves.fit import GloveFit
from handsim.hand.topology import BONES, DIGITS, NUM_JOINTS
from handsim.kernels.integration import move, velocity_of
from track.association.digit_hypotheses import DigitTrust, digit_ranges
from track.association.point_matching import worth_of
from track.kinematics.joint_prior import HingeBelief, foresee, rest, resting_covariance
from track.kinematics.marker_prediction import Expectation
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

_FIRST_SHARE, _FIRST_SPREAD = 1.2, (0.0015, 0.006)
"""Spread of a marker around where a hand just found has it: share of the fit's RMS; least and most [m]."""
_AS_EVER: Final = 0.002  # [m] RMS of a hand that is found again with its habits
_LEAST_SPREAD: Final = 0.0005  # [m] so much a marker trembles that is seen by few cameras
_UNEVEN: Final = 0.3  # of the hand's usual miss: so much it changes as the hand moves
_DOUBT: Final = 0.5  # [s] unseen after which a marker may miss its place by the hand's usual miss again
_MEMORY: Final = 120.0  # frames that a habit is averaged over
_KNOWN: Final = 30.0  # frames after which a hand's habits are known
_NOISE: Final = 0.001  # [m] of markers around a fitted pose
_WRIST: Final = ((0.001, 10.0), (np.deg2rad(1.5), 100.0))
"""Of its place and its orientation: spread at once [m, rad], unforeseen acceleration [m/s^2, rad/s^2]."""
_FADING: Final = 0.7  # of the speed of a digit that lacks markers, from frame to frame
_SMOOTHING: Final = 0.6  # share of the newest speed
_RETURN: Final = 0.01  # [s] over the time for which a marker was hidden: its chance to be back in a frame
_RETURNS: Final = (0.01, 0.65)  # least and most of that chance
_ELSEWHERE: Final = -7.0  # log chance of a marker that was seen while the point was there already
_STRAY_LIFE: Final = 0.1  # [s] that a stray point lives, on average
_MOST_AGE: Final = 3.0  # log odds that a point's age may come to
_LONGEST_GLIDE: Final = 0.05  # [s] that a motion is carried on for


class Coming(NamedTuple):
    """A hand before its markers are asked."""

    qpos: Float[np.ndarray, "27"]
    hinges: HingeBelief
    wrist_spread: tuple[float, float]
    """Standard deviations of the wrist's place [m] and orientation [rad]."""


class Estimate(NamedTuple):
    """A pose that was fitted to a frame's markers."""

    qpos: Float[np.ndarray, "27"]
    rms: float
    """3D RMS distance over the markers that are there [m]."""
    residuals: Float[np.ndarray, "M 3"]
    """Model minus marker [m], NaN where a marker is missing."""
    expected: Expectation

    @property
    def places(self) -> Float[np.ndarray, "M 3"]:
        """Where the pose has the markers [m]."""
        return self.expected.places

    @property
    def covariances(self) -> Float[np.ndarray, "M 3 3"]:
        """How far the markers may be from there [m^2]."""
        return self.expected.covariances


class HandMemory:
    """One hand of the user as a tracker remembers it.

    Args:
        hand: The hand and its glove.
    """

    def __init__(self, hand: GloveFit) -> None:
        self.hand = hand
        self.solver = PoseSolver(hand)
        self.qpos: NDArray[np.float64] | None = None
        self.time = 0.0
        self.rms = np.nan
        """Of the last pose, its habits being known [m]."""
        self._now = 0.0
        count = self.num_markers = hand.attachment.layout.num_markers
        bones = hand.attachment.main_bones
        self.digits = np.array([BONES[bone].digit for bone in bones])
        self._speed = np.zeros(6 + NUM_JOINTS)
        self._habit = np.zeros((count, 3))
        self._variance = np.full(count, _FIRST_SPREAD[1] ** 2)
        self._usual_miss = 0.0
        self.variance = self._variance.copy()
        """Of each marker around its place [m^2], as `predict` last had it."""
        self._learned = np.zeros(count)
        self._seen = np.zeros(count)
        self.adapted = self.solver.hand
        self._designed = self.adapted.places[:, 0].copy()
        self._ranges = digit_ranges(self.adapted)
        self._hinges = resting_covariance()
        self._rest = rest()
        self.proven = np.zeros(len(DIGITS), dtype=bool)
        """Digits that have had a firm name since the hand was found."""
        self.places = np.full((count, 3), np.nan)

    def predict(self, time: float) -> Coming:
        """What is coming if the hand moves on as it did.

        Only for a hand that has a pose.
        """
        assert self.qpos is not None
        self._now = time
        span = time - self.time
        doubt = self._usual_miss * np.minimum((time - self._seen) / _DOUBT, 1.0)
        self.variance = self._variance + doubt**2
        moved: NDArray[np.float64] = move(self.qpos[None], min(span, _LONGEST_GLIDE) * self._speed[None])[0]
        shift, turn = (at_once + 0.5 * gain * span**2 for at_once, gain in _WRIST)
        return Coming(moved, foresee(moved[7:], self._hinges, span), (shift, turn))

    def fit(
        self, targets: Float[np.ndarray, "M 3"], start: Float[np.ndarray, "27"], coming: Coming
    ) -> Estimate:
        """The pose of labeled markers [m]; what they leave open is as it was coming.

        With fewer than four of them it is the coming pose, and has no RMS.
        """
        qpos, rms, residuals = coming.qpos, np.nan, np.full_like(targets, np.nan)
        if np.isfinite(targets[:, 0]).sum() >= FEWEST_MARKERS:
            fit = self.solver.follow(
                targets,
                start,
                coming.hinges.angles,
                coming.hinges.spread,
                coming.qpos[:7],
                coming.wrist_spread,
            )
            qpos, rms, residuals = fit.qpos[0], float(fit.rms[0]), fit.residuals[0]
        expected = self.solver.expect(
            qpos,
            targets,
            coming.hinges,
            wrist_spread=coming.wrist_spread,
            variance=self.variance,
            noise=_NOISE,
        )
        return Estimate(expected.qpos, rms, residuals, expected)

    def trust(self, coming: Coming, estimate: Estimate) -> tuple[DigitTrust, DigitTrust]:
        """What new points of a digit are measured by, and those of one that has not yet had a firm name.

        What a doubtful name made of such a digit must not speak for that name.
        """
        slack = 2.5 * np.sqrt(self.variance) + np.sqrt((self._habit**2).sum(axis=1))
        worth = worth_of(self.variance)
        firm = DigitTrust(coming.hinges, estimate.expected, self.variance, worth, slack, self._ranges)
        return firm, firm._replace(belief=self._rest)

    @property
    def spread(self) -> float | None:
        """Of the markers around their places, in each direction [m]; None while little is known of it."""
        if np.median(self._learned) < _KNOWN:
            return None
        return max(float(np.sqrt(np.median(self._variance))), _NOISE)

    def chances(self, born: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P M"]:
        """Log chance of each marker to come back when it did, were it the point that was born then [s].

        It counts against that of a stray, which would hardly have lived for so long.
        """
        gap = born[:, None] - self._seen
        chance: NDArray[np.float64] = np.log(np.clip(_RETURN / np.maximum(gap, 1e-3), *_RETURNS))
        chance[gap < 0.0] = _ELSEWHERE
        age = np.maximum(self._now - born, 0.0)[:, None]
        return chance + np.minimum(age / _STRAY_LIFE, _MOST_AGE)

    def begin(
        self, qpos: Float[np.ndarray, "27"], targets: Float[np.ndarray, "M 3"], time: float
    ) -> Estimate:
        """Take up a hand that has just been found; if its habits still hold, they are kept."""
        self._speed[:] = 0.0
        self._seen[:] = time
        self.proven[:] = False
        nothing = Coming(qpos, self._rest, (1.0, 1.0))
        estimate = self.fit(targets, qpos, nothing)
        if not (self._learned.any() and estimate.rms < _AS_EVER):
            self._habit[:], self._learned[:], self._variance[:] = 0.0, 0.0, 0.0
            self._adapt()
            estimate = self.fit(targets, qpos, nothing)
            self._variance[:] = np.clip(_FIRST_SHARE * estimate.rms, *_FIRST_SPREAD) ** 2
        self._take(estimate, time)
        return estimate

    def rms_as_designed(self, estimate: Estimate) -> float:
        """RMS distance of the markers from where the hand as it was given would have them [m]."""
        expected = estimate.expected
        return float(_rms_without_habits(estimate.residuals, expected.turns, self._habit))

    def carry_on(self, estimate: Estimate, firm: Bool[np.ndarray, "M"], time: float) -> None:
        """Take over the pose of the next frame, and what it says of the habits of firmly named markers."""
        assert self.qpos is not None
        qpos, span = estimate.qpos, time - self.time
        if span > 0.0:
            self._speed += _SMOOTHING * (velocity_of(self.qpos, qpos, span) - self._speed)
        self._take(estimate, time)
        self.proven[self.digits[firm & (self.digits >= 0)]] = True
        self._learn(estimate, firm)

    def _take(self, estimate: Estimate, time: float) -> None:
        self.qpos, self.time, self.places = estimate.qpos, time, estimate.places
        self.rms = estimate.rms
        self._hinges = estimate.expected.hinges
        there = np.isfinite(estimate.residuals[:, 0])
        missing = np.bincount(self.digits[~there & (self.digits >= 0)], minlength=len(DIGITS))
        self._speed[6:].reshape(len(DIGITS), -1)[missing > 0] *= _FADING
        self._seen[there] = time

    def _learn(self, estimate: Estimate, firm: Bool[np.ndarray, "M"]) -> None:
        expected = estimate.expected
        _learn_habits(estimate.residuals, expected.turns, firm, self._learned, self._habit, self._variance)
        self._adapt()

    def _adapt(self) -> None:
        self._usual_miss = _adapt_places(
            self._learned, self._habit, self._variance, self._designed, self.adapted.places
        )


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _learn_habits(residuals: Any, turns: Any, firm: Any, learned: Any, habit: Any, variance: Any) -> None:
    """Average what firmly named markers are off by, as their bones see it, and how much that varies."""
    off = np.empty(3)
    for marker in range(len(residuals)):
        if not firm[marker] or np.isnan(residuals[marker, 0]):
            continue
        learned[marker] = min(learned[marker] + 1.0, _MEMORY)
        square = 0.0
        for i in range(3):
            off[i] = 0.0
            for j in range(3):
                off[i] += turns[marker, j, i] * residuals[marker, j]
            habit[marker, i] += off[i] / learned[marker]
            square += off[i] ** 2
        variance[marker] += (square - variance[marker]) / learned[marker]


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _adapt_places(learned: Any, habit: Any, variance: Any, designed: Any, places: Any) -> Any:
    """Move the hand's markers to where their habits have them; returns how far they are off usually."""
    square, count = 0.0, 0
    for marker in range(len(learned)):
        for i in range(3):
            places[marker, 0, i] = designed[marker, i] - habit[marker, i]
            square += habit[marker, i] ** 2 if learned[marker] > 0.0 else 0.0
        count += learned[marker] > 0.0
    square /= max(count, 1)
    for marker in range(len(learned)):
        variance[marker] = max(variance[marker], _LEAST_SPREAD**2 + _UNEVEN**2 * square)
    return np.sqrt(square)


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _rms_without_habits(residuals: Any, turns: Any, habit: Any) -> Any:
    square, count = 0.0, 0
    for marker in range(len(residuals)):
        if np.isnan(residuals[marker, 0]):
            continue
        count += 1
        for i in range(3):
            off = residuals[marker, i]
            for j in range(3):
                off += turns[marker, i, j] * habit[marker, j]
            square += off * off
    return np.sqrt(square / count)
