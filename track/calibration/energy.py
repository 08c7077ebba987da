"""The energy of a calibration, and its Gauss-Newton equations.

That of Han et al. 2018, section 4.5, with a shape that is solved too, all in units of the markers' noise:

    E = E_data + E_prior(M) + E_contact + what people differ by + hinges' ranges

Contact points slide after each step; what is left of a contact is then its gap along the normal, exact to
first order, as sliding changes it no more.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from handsim.hand.jacobian import skinned_jacobian
from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape
from handsim.hand.skin.surface import build_surface
from handsim.hand.topology import NUM_BONES
from handsim.kernels.integration import move
from track.calibration.contacts import PRESS, Contacts, Meeting, meet, trust
from track.calibration.hand_parameters import (
    NUM_PARAMETERS,
    shape_at,
    shape_precision,
    skeleton_numbers,
    skinned,
    skinned_shape_slopes,
    slopes_of,
)
from track.calibration.skin_walk import (
    Corners,
    SkinPatch,
    SkinPlaces,
    place_points,
    place_weights,
    skin_of,
    slide,
    weight_slopes,
)

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

ALPHA_NORMAL, ALPHA_ALONG = 2.0, 1.0
"""Of E_prior, along the normal and in the skin (Han et al. 2018)."""
PLACE_SPREAD: Final = 0.006
"""How far markers slip along the skin [m]; noise over this, squared, is the paper's lambda_1."""
HEIGHT_SPREAD: Final = 0.0004
"""How far a marker's center is off one radius above the skin [m]."""
CONTACT_SPREAD: Final = 0.0007
"""How far pads are from giving way by `contacts.PRESS` [m]; noise over this, squared, is lambda_2."""
_LIMIT_SPREAD: Final = np.deg2rad(2.0)
_REST_SPREAD: Final = np.deg2rad(90.0)
_STALE: Final = 0.005  # log lengths, radians, meters
_STEP: Final = 1e-5
_REST: Final = np.tile(np.deg2rad([0.0, 25.0, 35.0, 20.0]), 5)


@dataclass(frozen=True, eq=False)
class Guess:
    """One place in the space that is searched."""

    parameters: Float[np.ndarray, "53"]
    points: Float[np.ndarray, "M 3"]
    """Marker centers on the rest hand of this shape [m]."""
    places: SkinPlaces
    """The same on its skin."""
    qpos: Float[np.ndarray, "F 27"]
    contacts: Contacts | None = None
    """Frames count in `qpos`."""


class Fit(NamedTuple):
    """What a guess amounts to."""

    model: HandModel
    bones: Float[np.ndarray, "F L 4 4"]
    misses: Float[np.ndarray, "F M 3"]
    """Model minus marker [m], zero where a marker is missing."""
    off_design: Float[np.ndarray, "M 3"]
    """Marker minus where the glove as designed has it on this hand [m]."""
    normals: Float[np.ndarray, "M 3"]
    meeting: Meeting | None
    cost: float


class Equations(NamedTuple):
    """Normal equations: of each pose (P), between poses and what is shared (S), and of what is shared."""

    pose: Float[np.ndarray, "F 26 26"]
    mixed: Float[np.ndarray, "F 26 S"]
    shared: Float[np.ndarray, "S S"]
    pose_gradient: Float[np.ndarray, "F 26"]
    shared_gradient: Float[np.ndarray, "S"]


class Problem:
    """What a hand is calibrated with; only the reach is narrowed, once a hand nearly fits.

    Args:
        shape: The right hand to begin with.
        design: Where the glove as designed sits on its skin.
        radius: Of the markers [m].
        targets: Labeled markers of the chosen frames (F, M, 3) [m]; NaN where missing.
        noise: Standard deviation of a marker's coordinates [m].
        reach: Distance from which a marker loses its say [m].
    """

    def __init__(
        self,
        shape: HandShape,
        design: SkinPlaces,
        radius: float,
        targets: Float[np.ndarray, "F M 3"],
        *,
        noise: float,
        reach: float,
    ) -> None:
        self.shape, self.design, self.radius = shape, design, radius
        self.there = np.isfinite(targets).all(axis=2)
        self.targets = np.where(self.there[..., None], targets, 0.0)
        self.noise, self.reach = noise, reach
        self.precision = shape_precision()
        self._ranges = HandModel(shape).skeleton.ranges
        self._grown: NDArray[np.float64] | None = None
        self._grown_at = np.zeros(NUM_PARAMETERS)

    def fit(self, guess: Guess) -> Fit:
        """Residuals and energy of a guess."""
        model = HandModel(shape_at(self.shape, guess.parameters))
        bones = model.forward_kinematics(guess.qpos)
        weights = place_weights(guess.places)
        _, carried = skinned(model, bones, guess.points, weights)
        placed = np.einsum("ml,tmli->tmi", weights, carried, optimize=True)
        misses = np.where(self.there[..., None], placed - self.targets, 0.0)
        faces, count = self._faces(guess), len(guess.points)
        corners = SkinPatch(faces).corners(model.surface.vertices)
        _, normals = place_points(guess.places, _part(corners, 0, count))
        design, _ = place_points(self.design, _part(corners, count, 2 * count))
        meeting = None
        if guess.contacts is not None:
            pads = _part(corners, 2 * count, len(faces))
            meeting = meet(guess.contacts, pads, model, bones[guess.contacts.frames])
        fit = Fit(model, bones, misses, guess.points - design, normals, meeting, 0.0)
        return fit._replace(cost=self._cost(guess, fit))

    def _faces(self, guess: Guess) -> NDArray[np.int64]:
        faces = [guess.places.faces, self.design.faces]
        if guess.contacts is not None:
            faces += [guess.contacts.thumb_places.faces, guess.contacts.finger_places.faces]
        return np.concatenate(faces)

    def _cost(self, guess: Guess, fit: Fit) -> float:
        squares = (fit.misses**2).sum(axis=2)
        cost = (squares / (1.0 + squares / self.reach**2)).sum() / self.noise**2
        cost += guess.parameters @ self.precision @ guess.parameters
        cost += (fit.off_design * self._place_pull(fit, fit.off_design)).sum()
        cost += ((guess.places.heights - self.radius) ** 2).sum() / HEIGHT_SPREAD**2
        values, weights = self._angle_pulls(guess)
        cost += (weights * values**2).sum()
        if fit.meeting is not None and guess.contacts is not None:
            weights = trust(fit.meeting, guess.contacts.fingers)
            cost += (weights * fit.meeting.gaps**2).sum() / CONTACT_SPREAD**2
        return float(cost)

    def _place_pull(self, fit: Fit, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """E_prior's matrix times vectors (M, 3)."""
        along = (vectors * fit.normals).sum(axis=1, keepdims=True) * fit.normals
        pull: NDArray[np.float64] = ALPHA_ALONG * vectors + (ALPHA_NORMAL - ALPHA_ALONG) * along
        return pull / PLACE_SPREAD**2

    def _angle_pulls(self, guess: Guess) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What shall be small of the hinges (F, 40), and how much each counts."""
        angles = guess.qpos[:, 7:]
        low, high = self._ranges.T
        beyond = np.maximum(angles - high, 0.0) + np.minimum(angles - low, 0.0)
        values = np.concatenate([beyond, angles - _REST], axis=1)
        weights = np.concatenate(
            [(beyond != 0.0) / _LIMIT_SPREAD**2, np.full_like(angles, _REST_SPREAD**-2)], 1
        )
        return values, weights

    def equations(self, guess: Guess, fit: Fit) -> Equations:
        """Gauss-Newton's equations, unknowns shared by all frames in the order parameters, markers."""
        count = len(guess.points)
        skin = fit.model.surface.vertices
        patch = SkinPatch(self._faces(guess))
        corners, rest = patch.corners(skin), self._rest_slopes(guess, patch, skin)
        raw = slopes_of(self.shape, guess.parameters, skeleton_numbers)
        by_pose, by_shared = self._marker_slopes(guess, fit, _part(corners, 0, count), rest[:count], raw)
        squares = (fit.misses**2).sum(axis=2)
        weights = self.there / (1.0 + squares / self.reach**2) ** 2 / self.noise**2
        rows = np.repeat(weights, 3, axis=1)[..., None]
        residual = fit.misses.reshape(len(fit.misses), -1, 1)
        pose = by_pose.swapaxes(1, 2) @ (rows * by_pose)
        mixed = by_pose.swapaxes(1, 2) @ (rows * by_shared)
        flat = (np.sqrt(rows) * by_shared).reshape(-1, by_shared.shape[2])
        shared = flat.T @ flat
        pose_gradient = (by_pose.swapaxes(1, 2) @ (rows * residual))[..., 0]
        shared_gradient = np.einsum("fns,fn->s", by_shared, (rows * residual)[..., 0])
        result = Equations(pose, mixed, shared, pose_gradient, shared_gradient)
        self._add_priors(guess, fit, rest[:count] - rest[count : 2 * count], result)
        if guess.contacts is not None and fit.meeting is not None:
            self._add_contacts(guess, fit, rest[2 * count :], raw, result)
        return result

    def _rest_slopes(self, guess: Guess, patch: SkinPatch, skin: NDArray[np.float64]) -> NDArray[np.float64]:
        """How places on the rest skin move by the parameters (P, 3, 53).

        The skin is built anew for every guess, its derivative only where a parameter has changed by 0.005 or
        more: that moves the end by less than a micrometer, while four times as much is felt.
        """
        if self._grown is None or np.abs(guess.parameters - self._grown_at).max() > _STALE:
            self._grown = slopes_of(self.shape, guess.parameters, lambda shape: build_surface(shape).vertices)
            self._grown_at = guess.parameters
        places = self._all_places(guess)
        here, _ = place_points(places, patch.corners(skin))
        columns = []
        for number in range(NUM_PARAMETERS):
            grown = skin + _STEP * self._grown[..., number]
            columns.append((place_points(places, patch.corners(grown))[0] - here) / _STEP)
        return np.stack(columns, axis=-1)

    def _all_places(self, guess: Guess) -> SkinPlaces:
        parts = [guess.places, self.design]
        if guess.contacts is not None:
            parts += [
                side._replace(heights=np.full(len(guess.contacts.frames), -PRESS))
                for side in (guess.contacts.thumb_places, guess.contacts.finger_places)
            ]
        return SkinPlaces(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    def _marker_slopes(
        self, guess: Guess, fit: Fit, corners: Corners, rest: NDArray[np.float64], raw: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives of all markers by the poses (F, 3 M, 26) and by what is shared (F, 3 M, S)."""
        frames, count = len(guess.qpos), len(guess.points)
        weights = place_weights(guess.places)
        everywhere = np.tile(np.arange(NUM_BONES), (count, 1))
        by_pose = skinned_jacobian(fit.model, fit.bones, guess.points, everywhere, weights)
        by_shape = skinned_shape_slopes(fit.model, fit.bones, guess.points, weights) @ raw
        turns, carried = skinned(fit.model, fit.bones, guess.points, weights)
        by_shape += turns @ rest
        turns += np.einsum("tmli,mlj->tmij", carried, weight_slopes(guess.places, corners), optimize=True)
        by_shared = np.zeros((frames, count, 3, NUM_PARAMETERS + 3 * count))
        by_shared[..., :NUM_PARAMETERS] = by_shape
        for marker in range(count):
            first = NUM_PARAMETERS + 3 * marker
            by_shared[:, marker, :, first : first + 3] = turns[:, marker]
        return by_pose.reshape(frames, 3 * count, -1), by_shared.reshape(frames, 3 * count, -1)

    def _add_priors(self, guess: Guess, fit: Fit, off_slopes: NDArray[np.float64], result: Equations) -> None:
        count = len(guess.points)
        first = NUM_PARAMETERS
        result.shared[:first, :first] += self.precision
        result.shared_gradient[:first] += self.precision @ guess.parameters
        slopes = np.concatenate([off_slopes, np.zeros((count, 3, 3 * count))], axis=2)
        heights = np.zeros((count, result.shared.shape[0]))
        for marker in range(count):
            mine = slice(first + 3 * marker, first + 3 * marker + 3)
            slopes[marker, :, mine] = np.eye(3)
            heights[marker, mine] = fit.normals[marker]
        pulled = np.stack([self._place_pull(fit, slopes[..., s]) for s in range(slopes.shape[2])], axis=-1)
        result.shared[:] += np.einsum("mis,mir->sr", slopes, pulled, optimize=True)
        result.shared_gradient[:] += np.einsum("mi,mis->s", fit.off_design, pulled)
        result.shared[:] += heights.T @ heights / HEIGHT_SPREAD**2
        result.shared_gradient[:] += (guess.places.heights - self.radius) @ heights / HEIGHT_SPREAD**2
        values, weights = self._angle_pulls(guess)
        hinge = np.arange(6, 26)
        result.pose[:, hinge, hinge] += weights[:, :20] + weights[:, 20:]
        result.pose_gradient[:, 6:] += (weights * values)[:, :20] + (weights * values)[:, 20:]

    def _add_contacts(
        self, guess: Guess, fit: Fit, rest: NDArray[np.float64], raw: NDArray[np.float64], result: Equations
    ) -> None:
        contacts, meeting = guess.contacts, fit.meeting
        assert contacts is not None
        assert meeting is not None
        count = len(contacts.frames)
        places = self._all_places(guess)
        pads = SkinPlaces(*(values[len(values) - 2 * count :] for values in places))
        points, _ = place_points(pads, SkinPatch(pads.faces).corners(fit.model.surface.vertices))
        weights = place_weights(pads)
        say = trust(meeting, contacts.fingers) / CONTACT_SPREAD**2
        everywhere = np.tile(np.arange(NUM_BONES), (2, 1))
        for number, frame in enumerate(contacts.frames):
            both = [number, count + number]
            bones, share = fit.bones[frame : frame + 1], weights[both]
            by_pose = skinned_jacobian(fit.model, bones, points[both], everywhere, share)[0]
            by_shape = skinned_shape_slopes(fit.model, bones, points[both], share)[0] @ raw
            by_shape += skinned(fit.model, bones, points[both], share)[0][0] @ rest[both]
            way = meeting.directions[number]
            pose = way @ (by_pose[1] - by_pose[0])
            shared = np.zeros(result.shared.shape[0])
            shared[:NUM_PARAMETERS] = way @ (by_shape[1] - by_shape[0])
            result.pose[frame] += say[number] * np.outer(pose, pose)
            result.mixed[frame] += say[number] * np.outer(pose, shared)
            result.shared[:] += say[number] * np.outer(shared, shared)
            result.pose_gradient[frame] += say[number] * meeting.gaps[number] * pose
            result.shared_gradient[:] += say[number] * meeting.gaps[number] * shared

    def moved(
        self, guess: Guess, pose_step: Float[np.ndarray, "F 26"], shared_step: Float[np.ndarray, "S"]
    ) -> Guess:
        """The guess after a step, its markers found again on the new hand's skin."""
        parameters = guess.parameters + shared_step[:NUM_PARAMETERS]
        shape = shape_at(self.shape, parameters)
        skin = skin_of(shape)
        carried, _ = place_points(guess.places, skin.corners(guess.places.faces))
        points = carried + shared_step[NUM_PARAMETERS:].reshape(-1, 3)
        qpos = move(guess.qpos, np.clip(pose_step, -0.5, 0.5))
        places = slide(guess.places, points, skin)
        return dataclasses.replace(guess, parameters=parameters, points=points, places=places, qpos=qpos)


def _part(corners: Corners, first: int, last: int) -> Corners:
    return Corners(corners.points[first:last], corners.normals[first:last])
