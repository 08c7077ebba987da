"""What a calibration can say about itself: its noise, its standard errors, its touches, what did not move."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape
from handsim.hand.topology import JOINT_NAMES, NUM_JOINTS
from track.calibration.contacts import meet, place_contacts
from track.calibration.energy import Fit, Guess, Problem
from track.calibration.hand_parameters import BONE_LENGTHS, LENGTH, NUM_PARAMETERS, slopes_of
from track.calibration.skin_walk import SkinPatch, place_points, place_weights
from track.calibration.solver import eliminate

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

ENOUGH_RANGE: Final = 0.3
"""Share of a hinge's range that the user has to cover."""
_LEAST_NOISE, _MOST_NOISE = 0.0001, 0.003  # [m]
_OPTICS: Final = 0.00015  # [m] what an optical system alone may leave a coordinate off by
_MIDDLE: Final = 2.366  # median of a chi-squared variable of three degrees of freedom
_WORTH: Final = 4.0  # frames that tell different things about flesh


def marker_noise(problem: Problem, fit: Fit) -> float:
    """Standard deviation of a marker's coordinates [m], from the middle one and what was fitted to all."""
    squares = (fit.misses**2).sum(axis=2)[problem.there]
    freedom = 3 * len(squares) - 26 * len(fit.misses) - NUM_PARAMETERS - 3 * fit.misses.shape[1]
    left = max(freedom, 1) / (3 * len(squares))
    return float(np.clip(np.sqrt(np.median(squares) / (_MIDDLE * left)), _LEAST_NOISE, _MOST_NOISE))


def weighing_noise(noise: float, num_frames: int) -> float:
    """The noise that a capture's frames are weighed by, so that they count for no more than they tell [m].

    Optical noise is new in every frame. What markers are off beyond it is flesh that moves with the pose: as
    much again in every like pose, so that many frames tell of it what a few do.

    Args:
        noise: Standard deviation of a marker's coordinates [m].
        num_frames: Frames that are weighed.
    """
    flesh = max(noise**2 - _OPTICS**2, 0.0)
    return float(np.sqrt(noise**2 + flesh * max(num_frames / _WORTH - 1.0, 0.0)))


def standard_errors(
    problem: Problem, guess: Guess, fit: Fit
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard errors [m] of marker places on their bones, and of bone lengths."""
    reduced, _ = eliminate(problem.equations(guess, fit), 0.0)
    covariance = np.linalg.inv(reduced[:, :-1])
    weights = place_weights(guess.places)
    bones, patch = weights.argmax(axis=1), SkinPatch(guess.places.faces)

    def on_bones(shape: HandShape) -> NDArray[np.float64]:
        model = HandModel(shape)
        rest = model.rest_transforms[bones]
        points = place_points(guess.places, patch.corners(model.surface.vertices))[0]
        local: NDArray[np.float64] = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3])
        return local

    count = len(bones)
    slopes = np.zeros((count, 3, len(covariance)))
    slopes[..., :NUM_PARAMETERS] = slopes_of(problem.shape, guess.parameters, on_bones)
    turns = fit.model.rest_transforms[bones][:, :3, :3].swapaxes(1, 2)
    for marker in range(count):
        first = NUM_PARAMETERS + 3 * marker
        slopes[marker, :, first : first + 3] = turns[marker]
    places = np.sqrt(np.einsum("mis,st,mit->m", slopes, covariance, slopes, optimize=True))
    own = covariance[BONE_LENGTHS, BONE_LENGTHS].diagonal()
    logs = own + covariance[LENGTH, LENGTH] + 2.0 * covariance[BONE_LENGTHS, LENGTH]
    return places, fit.model.shape.bone_lengths * np.sqrt(logs).reshape(5, 3)


def gaps_on(
    model: HandModel, touches: list[tuple[int, str]], qpos: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far thumb and finger are from touching on a hand in these poses [m]."""
    bones = model.forward_kinematics(qpos)
    contacts = place_contacts(model, touches, bones)
    faces = np.concatenate([contacts.thumb_places.faces, contacts.finger_places.faces])
    return meet(contacts, SkinPatch(faces).corners(model.surface.vertices), model, bones).gaps


def still_joints(
    angles: Float[np.ndarray, "T 20"], whole: Bool[np.ndarray, "T 5"], model: HandModel
) -> tuple[str, ...]:
    """Hinges that covered too little of their range, while their digit's markers were all there."""
    ranges = model.skeleton.ranges
    still = []
    for joint in range(NUM_JOINTS):
        seen = angles[whole[:, joint // 4], joint]
        covered = np.ptp(np.quantile(seen, [0.02, 0.98])) if len(seen) else 0.0
        if covered < ENOUGH_RANGE * (ranges[joint, 1] - ranges[joint, 0]):
            still.append(JOINT_NAMES[joint])
    return tuple(still)
