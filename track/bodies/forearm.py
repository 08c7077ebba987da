"""The limbs beside a hand as rigid bodies: axes by landmarks, and the variances of the wrist's angles.

The forearm's frame equals that of the hand's wrist while the wrist is straight. Its plane is that of Wu and
others 2005: through both styloids and the elbow, which is midway between the epicondyles. Its origin is
midway between the styloids, not at the ulnar one, so that the long axis ends in the middle of the wrist.

The markers of an elbow are on the upper arm, or beyond it where the radius does not turn them. The forearm's
pronation needs only the elbow's y axis, through the epicondyles, however the elbow is bent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import Capture, select_markers
from gloves.fit import GloveFit, forearm_markers
from gloves.takes.take import Take
from handsim.arrays import Doubles
from handsim.errors import ArgumentError, CalibrationError
from handsim.hand.shape import Side
from handsim.space.transforms import pose_matrices, rigid_fit, unit
from track.association.hand_state import HandState
from track.association.initialization import HandInitializer
from track.bodies.constellation import FEWEST
from track.bodies.rigid_body import LEAST_ALIKE, RigidTemplate, track_body
from track.frames import capture_frames
from track.kinematics.pose_spread import SOURCES
from train.labelers.protocol import Labeler

_FRAMES: Final = 60  # about as many frames are searched for a forearm
_OFF: Final = 0.03
"""Largest change of a distance between two markers, or a marker and the wrist, from the layout's [m]."""
_GLUED: Final = 0.004
"""Standard deviation of markers on a forearm from their layout [m], which turns the axes that it gives."""
_MOST_OFF: Final = 0.02  # [m] largest RMS distance of a forearm's markers from those of its layout
_SAME: Final = 0.006  # [m] Distances between the markers of a forearm change less from frame to frame.
_LEAST_SHARE: Final = 0.3  # least share of the frames with a forearm that show the same one
_CONSTANT_FACTOR: Final = 0.6
"""Factor of gluing and person in the rotation of a palm, whose many markers average their errors: the
constant errors of 60 simulated hands are 0.43 to 0.70 of those stated, in either angle; calibrated, 0.6."""


def find_forearms(
    clouds: Sequence[Float[np.ndarray, "N 3"]], hands: Sequence[GloveFit], labeler: Labeler
) -> dict[Side, RigidTemplate | None]:
    """The forearms of the hands in frames with these points [m], whose layout has one; None if not found."""
    finder = HandInitializer([HandState(hand) for hand in hands], labeler, at_once=True)
    wrists, beside = ([list[Doubles]() for _ in hands] for _ in range(2))
    for points in clouds[:: max(1, len(clouds) // _FRAMES)]:
        initialized = finder.initialize(points, range(len(hands)))
        is_free = np.all([one.labels < 0 for one in initialized], axis=0) if initialized else None
        for one in initialized:
            wrists[one.index].append(pose_matrices(one.fit.qpos[:, :7])[0])
            beside[one.index].append(points[is_free])
    return {
        hand.side: found_forearm(nominal_forearm(hand), np.array(poses), points)
        for hand, poses, points in zip(hands, wrists, beside, strict=True)
        if poses
    }


def nominal_forearm(hand: GloveFit) -> RigidTemplate:
    """The forearm of a hand as the layout of its glove has it."""
    layout, side = hand.layout, hand.side
    positions, _ = forearm_markers(layout, hand.shape.length, side)
    names = tuple(one.name for one in layout.forearm)
    return RigidTemplate(f"{side}_forearm", names, positions, None, side, has_axes=True, is_nominal=True)


def found_forearm(
    nominal: RigidTemplate,
    wrists: Float[np.ndarray, "F 4 4"],
    clouds: Sequence[Float[np.ndarray, "N 3"]],
) -> RigidTemplate | None:
    """The forearm whose markers are those of its layout, roughly, and keep their distances.

    Args:
        nominal: The forearm as its layout has it, whose axes it keeps.
        wrists: Poses `T_world_wrist` of the hand in some frames [m].
        clouds: The points of each of these frames that are no marker of a hand [m].
    """
    found = [
        _likest_points(nominal, (points - wrist[:3, 3]) @ wrist[:3, :3])
        for wrist, points in zip(wrists, clouds, strict=True)
    ]
    shown = np.array([one for one in found if one is not None]).reshape(-1, len(nominal.positions), 3)
    distances = np.linalg.norm(shown[:, :, None] - shown[:, None], axis=-1)
    same = (np.abs(distances[:, None] - distances) < _SAME).all(axis=(2, 3))
    count = same.sum(axis=1)
    if count.max(initial=0) < max(FEWEST, _LEAST_SHARE * len(shown)):
        return None
    turns, shifts = rigid_fit(alike := shown[same[count.argmax()]], nominal.positions)
    placed = alike @ turns.swapaxes(1, 2) + shifts[:, None]
    return dataclasses.replace(nominal, positions=np.median(placed, axis=0))


def _likest_points(
    nominal: RigidTemplate, points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "Q 3"] | None:
    """The points beside a hand, in its frame [m], that are likest those of a forearm bent at the wrist."""
    ours, wrist = nominal.positions, np.zeros((1, 3))
    designed, there = np.concatenate([wrist, ours]), np.concatenate([wrist, points])
    apart, far = (np.linalg.norm(one[:, None] - one, axis=2) for one in (designed, there))
    chosen = [[0]]  # the wrist
    for marker in range(1, len(designed)):
        fits = (np.abs(far[one] - apart[:marker, marker, None]).max(axis=0) < _OFF for one in chosen)
        chosen = [
            [*one, k]
            for one, fit in zip(chosen, fits, strict=True)
            for k in np.flatnonzero(fit).tolist()
            if k not in one
        ]
    if not chosen:
        return None
    there = there[np.array(chosen)]
    turns, shifts = rigid_fit(designed, there)
    squares = np.square(there - designed @ turns.swapaxes(1, 2) - shifts[:, None]).sum(axis=2).mean(axis=1)
    squares[turns[:, 1, 1] < LEAST_ALIKE] = np.inf
    best = squares.argmin()
    return there[best, 1:] if squares[best] < _MOST_OFF**2 else None


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


def wrist_variances(take: Take, side: Side, hand: Float[np.ndarray, "T 3 5"]) -> Float[np.ndarray, "T 3 5"]:
    """Variances of the angles `WRIST_NAMES` [rad^2] by source, for small deviations and known axes.

    Args:
        take: The take.
        side: The hand, whose forearm is among the bodies; noise of bodies counts as the first source.
        hand: Variances of the hand's rotation about its own axes [rad^2], by source.
    """
    hands, forearms = take.arm_turns(side)
    forearm, elbow = take.forearm_index(side), take.elbow_index(side)
    assert forearm is not None
    noise, body = _rotation_noise(take, forearm), take.bodies[forearm]
    inertia = _inertia(body.positions - body.positions.mean(axis=0))
    glued = body.is_nominal * _GLUED**2 * np.linalg.inv(inertia)
    is_less = np.isin(SOURCES, ("gluing", "person"))
    found = np.full_like(hand, np.nan)
    found[:, :2] = hand[:, 1:] * np.where(is_less, _CONSTANT_FACTOR**2, 1.0)
    found[:, :2, 0] += (hands.swapaxes(1, 2) @ noise @ hands).diagonal(axis1=1, axis2=2)[:, 1:]
    found[:, :2, 1] += (hands.swapaxes(1, 2) @ glued @ hands).diagonal(axis1=1, axis2=2)[:, 1:]
    found[np.isnan(found[:, 0, 0])] = np.nan
    if elbow is not None and body.has_axes:
        # Pronation is a rotation about the forearm, perpendicular to the y axis through the epicondyles.
        length = forearms[:, :, 0]
        axis = length * [1.0, 0.0, 1.0] / (1.0 - length[:, 1:2] ** 2)
        both = forearms @ noise @ forearms.swapaxes(1, 2) + _rotation_noise(take, elbow)
        found[:, 2] = 0.0
        found[:, 2, 0] = np.einsum("ti,tij,tj->t", axis, both, axis)
        found[:, 2, 1] = np.einsum("ti,tij,tj->t", axis, forearms @ glued @ forearms.swapaxes(1, 2), axis)
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
        local = seen[..., None] * (markers - (seen @ markers / count[:, None])[:, None])
        found[shown] = noise * np.linalg.inv(_inertia(local))
    return found


def _inertia(local: Float[np.ndarray, "*batch Q 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Moments of inertia [m^2] about their center of points of unit mass, given from it [m]."""
    squares = local.swapaxes(-1, -2) @ local
    return np.asarray(squares.trace(axis1=-1, axis2=-2)[..., None, None] * np.eye(3) - squares)
