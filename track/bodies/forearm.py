"""The limbs beside a hand as rigid bodies: axes by landmarks, and the variances of the wrist's angles.

The forearm's frame equals that of the hand's wrist while the wrist is straight. Its plane is that of Wu and
others 2005: through both styloids and the elbow, which is midway between the epicondyles. Its origin is
midway between the styloids, not at the ulnar one, so that the long axis ends in the middle of the wrist.

The markers of an elbow are on the upper arm, or beyond it where the radius does not turn them. The forearm's
pronation needs only the elbow's y axis, through the epicondyles, however the elbow is bent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import Capture, select_markers
from gloves.takes.take import Take
from handsim.arrays import Doubles
from handsim.errors import ArgumentError, CalibrationError
from handsim.hand.shape import Side
from handsim.space.transforms import unit
from track.bodies.constellation import FEWEST
from track.bodies.rigid_body import RigidTemplate, track_body
from track.frames import capture_frames
from track.kinematics.pose_spread import SOURCES

_CONSTANT_FACTOR: Final = 0.6
"""Factor of gluing and person in the rotation of an uncalibrated palm, whose many markers average their
errors: the constant errors of 60 simulated hands are 0.43 to 0.70 of those stated, in either angle."""


def limb_of_landmarks(body: RigidTemplate, capture: Capture, landmarks: Sequence[str]) -> RigidTemplate:
    """A forearm or an elbow in the frame of its landmarks.

    Args:
        body: The body, whose markers have the names of columns.
        capture: A labeled capture of some seconds.
        landmarks: Columns at a forearm's radial styloid, its ulnar styloid, and one or two epicondyles, whose
            middle is the elbow; or at an elbow's lateral and medial epicondyle.

    Raises:
        ArgumentError: It is no part of an arm, or it needs another number of landmarks.
        CalibrationError: A landmark is never seen while the body is, or they are nearly on one line.
        CaptureError: A column is missing.
    """
    if not body.limb:
        raise ArgumentError("landmarks of no hand's forearm or elbow, expected the side of the hand")
    needed = {3, 4} if body.forearm else {2}
    if len(landmarks) not in needed:
        words = "radial styloid, the ulnar styloid and one or two epicondyles"
        words = words if body.forearm else "lateral and the medial epicondyle"
        given = f"landmarks are {', '.join(landmarks)}" if landmarks else f"{body.name} has no landmarks"
        raise ArgumentError(f"{given}, expected the columns of the {words}")
    lateral, medial, *others = _local_landmarks(body, capture, landmarks)
    (side,), middle = body.limb.values(), 0.5 * (lateral + medial)
    across = lateral - medial if side == "right" else medial - lateral
    # An elbow's axis along the arm may be any that is not parallel to the epicondyles.
    x = middle - np.mean(others, axis=0) if others else np.eye(3)[np.abs(across).argmin()]
    z = np.cross(x, across)
    if not np.linalg.norm(z) >= 0.5 * np.linalg.norm(x) * np.linalg.norm(across) > 0.0:
        raise CalibrationError("the landmarks are nearly on one line, expected styloids across the forearm")
    z = unit(z)
    y = np.cross(z, unit(x)) if others else unit(across)
    positions = (body.positions - middle) @ np.column_stack([np.cross(y, z), y, z])
    return RigidTemplate(
        body.name, body.marker_names, positions, None, body.forearm, body.forearm is not None, body.elbow
    )


def _local_landmarks(body: RigidTemplate, capture: Capture, landmarks: Sequence[str]) -> Doubles:
    """Median places of landmarks (K, 3) in the body's frame [m]."""
    points, markers = (select_markers(capture, names) for names in (landmarks, body.marker_names))
    local = np.full_like(points, np.nan)
    frames = capture_frames(Capture(body.marker_names, markers, capture.rate))
    for frame, tracked in enumerate(track_body(body, frames)):
        if tracked.T_world_body is not None:
            local[frame] = (points[frame] - tracked.T_world_body[:3, 3]) @ tracked.T_world_body[:3, :3]
    for name, seen in zip(landmarks, np.isfinite(local[..., 0]).any(axis=0), strict=True):
        if not seen:
            (part,) = body.limb
            raise CalibrationError(f"landmark {name} is never seen with the {part}, expected both in a frame")
    return np.asarray(np.nanmedian(local, axis=0))


def wrist_variances(
    take: Take, side: Side, hand: Float[np.ndarray, "T 3 5"], *, is_calibrated: bool
) -> Float[np.ndarray, "T 3 5"]:
    """Variances of the angles `WRIST_NAMES` [rad^2] by source, for small deviations and known axes.

    Args:
        take: The take.
        side: The hand, whose forearm is among the bodies; noise of bodies counts as the first source.
        hand: Variances of the hand's rotation about its own axes [rad^2], by source.
        is_calibrated: Whether the hand is.
    """
    hands, forearms = take.arm_turns(side)
    forearm, elbow = take.forearm_index(side), take.elbow_index(side)
    assert forearm is not None
    noise = _rotation_noise(take, forearm)
    is_less = np.isin(SOURCES, ("gluing", "person")) & (not is_calibrated)
    found = np.full_like(hand, np.nan)
    found[:, :2] = hand[:, 1:] * np.where(is_less, _CONSTANT_FACTOR**2, 1.0)
    found[:, :2, 0] += (hands.swapaxes(1, 2) @ noise @ hands).diagonal(axis1=1, axis2=2)[:, 1:]
    found[np.isnan(found[:, 0, 0])] = np.nan
    if elbow is not None and take.bodies[forearm].has_axes:
        # Pronation is a rotation about the forearm, measured perpendicular to the line of the epicondyles
        # (y).
        length = forearms[:, :, 0]
        axis = length * [1.0, 0.0, 1.0] / (1.0 - length[:, 1:2] ** 2)
        both = forearms @ noise @ forearms.swapaxes(1, 2) + _rotation_noise(take, elbow)
        found[:, 2] = 0.0
        found[:, 2, 0] = np.einsum("ti,tij,tj->t", axis, both, axis)
        found[np.isnan(found[:, 2, 0]), 2] = np.nan
    return found


def _rotation_noise(take: Take, body: int) -> Float[np.ndarray, "T 3 3"]:
    """Covariances of a body's rotation about its own axes [rad^2], by its residuals; NaN of a lost body."""
    markers = take.bodies[body].positions
    seen = np.isfinite(take.observed(take.bodies[body].name)[..., 0])
    count, found = seen.sum(axis=1), np.full((len(seen), 3, 3), np.nan)
    shown = np.flatnonzero((count >= FEWEST) & np.isfinite(take.body_poses[:, body, 0]))
    if len(shown):
        seen, count = seen[shown].astype(float), count[shown]
        # A pose takes six of the markers' coordinates.
        noise = np.nanmean(np.square(take.body_rms[shown, body]) * count / (3 * count - 6))
        local = markers - (seen @ markers / count[:, None])[:, None]
        squares = np.einsum("tq,tqi,tqj->tij", seen, local, local)
        inertia = squares.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
        found[shown] = noise * np.linalg.inv(inertia)
    return found
