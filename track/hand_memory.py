"""What a tracker remembers of a hand: its pose and motion, and by how much each marker tends to miss it.

A hand that is not quite the user's misses its markers by the same few millimetres in every frame, seen from
the bones that carry them. Once that habit is known, a marker is expected where the pose and its habit put it,
which is nearly as sharp for an uncalibrated hand as for a calibrated one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.topology import BONES, DIGITS, NUM_JOINTS
from handsim.transforms import multiply_quaternions, quaternion_vectors
from track.digit_search import digit_ranges
from track.gloved_hand import gloved_hand
from track.inverse_kinematics import PoseFit, PoseSolver, Prediction, move
from track.user import UserHand

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

_FIRST_SPREAD: Final = 0.003  # [m] of a marker around where a hand not yet known has it
_LEAST_SPREAD: Final = 0.0005  # [m] so much a marker trembles that is seen by few cameras
_MEMORY: Final = 120.0  # frames that a habit is averaged over
_NOISE: Final = 0.001  # [m] of markers around a fitted pose
_SWAY: Final = (np.deg2rad(1.0), 150.0, np.deg2rad(40.0))
"""Spread of a hinge nobody sees: at once [rad], by an unforeseen acceleration [rad/s^2], at most [rad]."""
_ARC: Final = 0.04  # [m] radius of the arcs that markers move on
_FADING: Final = 0.7  # of the speed of a digit that lacks markers, from frame to frame
_SMOOTHING: Final = 0.6  # share of the newest speed
_LONGEST_GLIDE: Final = 0.05  # [s] that a motion is carried on for


class HandMemory:
    """One hand of the user as a tracker remembers it.

    Args:
        hand: The hand and its glove.
    """

    def __init__(self, hand: UserHand) -> None:
        self.hand = hand
        self.solver = PoseSolver(hand.model, hand.attachment)
        self.qpos: NDArray[np.float64] | None = None
        self.time = 0.0
        count = self.num_markers = hand.attachment.layout.num_markers
        bones = hand.attachment.bone_indices[np.arange(count), hand.attachment.bone_weights.argmax(axis=1)]
        self.digits = np.array([BONES[bone].digit for bone in bones])
        self._speed = np.zeros(6 + NUM_JOINTS)
        self._habit = np.zeros((count, 3))
        self.variance = np.full(count, _FIRST_SPREAD**2)
        self._learned = np.zeros(count)
        self._whole = np.zeros(len(DIGITS))
        self.adapted = gloved_hand(hand.model, hand.attachment)
        self._designed = self.adapted.places[:, 0].copy()
        self.ranges = digit_ranges(self.adapted)
        self._turns = np.zeros((count, 3, 3))
        self.places = np.full((count, 3), np.nan)

    def predict(self, time: float) -> Float[np.ndarray, "27"]:
        """The pose that is coming, if the hand moves on as it did.

        Only for a hand that has a pose.
        """
        assert self.qpos is not None
        ahead = min(time - self.time, _LONGEST_GLIDE)
        moved: NDArray[np.float64] = move(self.qpos[None], ahead * self._speed[None])[0]
        return moved

    def expect(
        self, qpos: Float[np.ndarray, "27"], there: Bool[np.ndarray, "M"], time: float
    ) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3 3"]]:
        """Where a pose fitted to some markers and the markers' habits have them [m], with covariances."""
        seen = self.solver.expect(qpos, there, spread=np.repeat(self.sway(time), 4), noise=_NOISE)
        self._turns = seen.turns
        places = seen.places - np.einsum("mij,mj->mi", seen.turns, self._habit)
        # An arc leaves its tangent: open along it means open across it, by the square over twice its radius.
        bend = np.trace(seen.covariances, axis1=1, axis2=2) / (2.0 * _ARC)
        return places, seen.covariances + (self.variance + bend**2)[:, None, None] * np.eye(3)

    def fit(self, targets: Float[np.ndarray, "M 3"], start: Float[np.ndarray, "27"], time: float) -> PoseFit:
        """Solve the pose; digits that lack markers are drawn to the start."""
        prediction = Prediction(start[7:], np.repeat(self.sway(time), 4))
        return self.solver.solve(targets[None], start[None], prediction=prediction)

    def sway(self, time: float) -> NDArray[np.float64]:
        """How far the hinges of each digit may be from where they were coming to."""
        at_once, gain, most = _SWAY
        sway: NDArray[np.float64] = np.minimum(at_once + 0.5 * gain * (time - self._whole) ** 2, most)
        return sway

    def begin(self, fit: PoseFit, time: float) -> None:
        """Take up a hand that has just been found."""
        self._speed[:] = 0.0
        self._take(fit, time)

    def carry_on(self, fit: PoseFit, time: float) -> None:
        """Take over the pose of the next frame and what it says of the markers' habits."""
        assert self.qpos is not None
        qpos, span = fit.qpos[0], time - self.time
        if span > 0.0:
            back = self.qpos[3:7] * np.array([1.0, -1.0, -1.0, -1.0])
            turn = quaternion_vectors(multiply_quaternions(back[None], qpos[None, 3:7]))[0]
            speed = np.concatenate([qpos[:3] - self.qpos[:3], turn, qpos[7:] - self.qpos[7:]]) / span
            self._speed += _SMOOTHING * (speed - self._speed)
        self._take(fit, time)

    def _take(self, fit: PoseFit, time: float) -> None:
        self.qpos, self.time = fit.qpos[0], time
        misses = fit.residuals[0]
        there = np.isfinite(misses[:, 0])
        self.places, _ = self.expect(fit.qpos[0], there, time)
        missing = np.bincount(self.digits[~there & (self.digits >= 0)], minlength=len(DIGITS))
        self._whole[missing == 0] = time
        self._speed[6:].reshape(len(DIGITS), -1)[missing > 0] *= _FADING
        self._learn(misses, there)

    def _learn(self, misses: Float[np.ndarray, "M 3"], there: Bool[np.ndarray, "M"]) -> None:
        local = np.einsum("mji,mj->mi", self._turns, np.where(there[:, None], misses, 0.0))
        self._learned[there] = np.minimum(self._learned[there] + 1.0, _MEMORY)
        rate = np.where(there, 1.0 / np.maximum(self._learned, 1.0), 0.0)
        off = local - self._habit
        self._habit += rate[:, None] * off
        known = np.maximum(rate, 1.0 / _MEMORY) * there * (self._learned > 1.0)
        self.variance += known * ((off**2).sum(axis=1) - self.variance)
        np.maximum(self.variance, _LEAST_SPREAD**2, out=self.variance)
        self.adapted.places[:, 0] = self._designed - self._habit
