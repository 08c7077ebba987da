"""The forearm as a rigid body: its axes by landmarks, and the variances of the wrist's angles.

The forearm's frame is that of the hand's wrist when the wrist is straight. Its plane is that of Wu and others
2005: through both styloids and the elbow, midway between the epicondyles. The origin is midway between the
styloids, not at the ulnar one, so that the long axis ends in the middle of the wrist.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import Capture, select_markers
from gloves.takes.take import Take
from handsim.errors import ArgumentError, CalibrationError
from handsim.hand.shape import Side
from handsim.space.transforms import unit
from track.bodies.constellation import FEWEST
from track.bodies.rigid_body import RigidTemplate, track_body
from track.kinematics.pose_spread import SOURCES

_SHARE: Final = 0.6
"""Factor of gluing and person in the turn of an uncalibrated palm, whose many markers make up for each other:
constant errors found are 0.43 to 0.70 of those stated, in either angle of 60 simulated hands."""


def forearm_of_landmarks(body: RigidTemplate, capture: Capture, landmarks: Sequence[str]) -> RigidTemplate:
    """A forearm in the frame of its landmarks.

    Args:
        body: The forearm, whose markers have the names of columns.
        capture: A labeled capture of some seconds.
        landmarks: Columns at the radial styloid, the ulnar styloid, and one or two epicondyles, whose middle
            is the elbow.

    Raises:
        ArgumentError: There are not three or four landmarks.
        CalibrationError: A landmark is never seen while the forearm is, or they are nearly on one line.
        CaptureError: A column is missing.
    """
    if body.forearm is None:
        raise ArgumentError("landmarks of no hand's forearm, expected the side of the hand")
    if len(landmarks) not in {3, 4}:
        raise ArgumentError(
            f"landmarks are {', '.join(landmarks)}, expected the columns of the radial styloid, the ulnar "
            "styloid and one or two epicondyles"
        )
    points, markers = (select_markers(capture, names) for names in (landmarks, body.marker_names))
    local = np.full_like(points, np.nan)
    for frame, tracked in enumerate(track_body(body, Capture(body.marker_names, markers, capture.rate))):
        if tracked.T_world_body is not None:
            local[frame] = (points[frame] - tracked.T_world_body[:3, 3]) @ tracked.T_world_body[:3, :3]
    for name, seen in zip(landmarks, np.isfinite(local[..., 0]).any(axis=0), strict=True):
        if not seen:
            raise CalibrationError(
                f"landmark {name} is never seen with the forearm, expected both in a frame"
            )
    radial, ulnar, *epicondyles = np.nanmedian(local, axis=0)
    wrist, across = 0.5 * (radial + ulnar), radial - ulnar if body.forearm == "right" else ulnar - radial
    x = unit(wrist - np.mean(epicondyles, axis=0))
    z = np.cross(x, across)
    if np.linalg.norm(z) < 0.5 * np.linalg.norm(across):
        raise CalibrationError("the landmarks are nearly on one line, expected styloids across the forearm")
    z = unit(z)
    axes = np.column_stack([x, np.cross(z, x), z])
    positions = (body.positions - wrist) @ axes
    return RigidTemplate(body.name, body.marker_names, positions, None, body.forearm, has_axes=True)


def wrist_variances(
    take: Take, side: Side, body: int, hand: Float[np.ndarray, "T 3 5"], *, is_calibrated: bool
) -> Float[np.ndarray, "T 2 5"]:
    """Variances of a wrist's angles [rad^2] by source, for small deviations and known axes of the forearm.

    Args:
        take: The take.
        side: The hand.
        body: Index of its forearm among the bodies, whose noise counts as the first source.
        hand: Variances of the hand's rotation about its own axes [rad^2], by source.
        is_calibrated: Whether the hand is.
    """
    markers, turns = take.bodies[body].positions, take.turns_on(body, side)
    seen = np.isfinite(take.observed(take.bodies[body].name)[..., 0])
    count = seen.sum(axis=1)
    shown = np.flatnonzero((count >= FEWEST) & np.isfinite(turns[:, 0, 0]))
    found = np.full((len(turns), 2, hand.shape[2]), np.nan)
    if len(shown):
        seen, count, turns = seen[shown].astype(float), count[shown], turns[shown]
        noise = np.nanmean(
            np.square(take.body_rms[shown, body]) * count / (3 * count - 6)
        )  # a pose takes six
        local = markers - (seen @ markers / count[:, None])[:, None]
        squares = np.einsum("tq,tqi,tqj->tij", seen, local, local)
        inertia = squares.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
        by_markers = noise * turns.swapaxes(1, 2) @ np.linalg.inv(inertia) @ turns
        is_less = np.isin(SOURCES, ("gluing", "person")) & (not is_calibrated)
        found[shown] = hand[shown, 1:] * np.where(is_less, _SHARE**2, 1.0)
        found[shown, :, 0] += by_markers.diagonal(axis1=1, axis2=2)[:, 1:]
    return found
