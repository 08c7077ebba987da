"""A map of the volume: what a rig sees of hands that are set at each point of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GlovedHand
from gloves.optics.blobs import MARKER_RADIUS
from handsim.space.cameras import FEWEST_CAMERAS, CameraRig
from train.rig_advice.forecast import OPTICS, covariances
from train.rig_advice.rig_faults import cube_points
from train.simulation.light_sources import marker_radii
from train.simulation.motion import SceneMotion
from train.simulation.sight import SceneSight

GRID: Final = 5
"""Points of the map along each side of the volume."""
_HANDS: Final = 12  # hands at every point
_LONGEST: Final = 0.01  # of errors that are averaged [m]: two rays that hardly cross make no point


class VolumeMap(NamedTuple):
    """G points of a volume and what becomes of a hand there."""

    points: Float[np.ndarray, "G 3"]
    """Where the wrist is [m]."""
    seen_by_two: Float[np.ndarray, "G"]
    """Share of a hand's markers that two cameras or more see."""
    seen_by_three: Float[np.ndarray, "G"]
    error: Float[np.ndarray, "G"]
    """Root mean square distance of points from the truth [m]; NaN where no marker has a point."""


def map_volume(
    scenes: Sequence[SceneMotion],
    rig: CameraRig,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    rng: np.random.Generator,
) -> VolumeMap:
    """Set hands at each point of a grid, in poses that hands at work have.

    Args:
        scenes: Whose hands, and their poses.
        rig: The cameras.
        center: Middle of the volume [m].
        sides: Its sides [m].
        rng: Chooses the poses.
    """
    points = cube_points(center, sides, GRID)
    two, three, errors = [], [], []
    for _ in range(_HANDS):
        scene = scenes[int(rng.integers(len(scenes)))]
        hand = scene.hands[int(rng.integers(len(scene.hands)))]
        qpos = np.tile(hand.qpos[rng.integers(scene.num_frames)], (len(points), 1))
        qpos[:, :3] = points
        placed = SceneMotion((GlovedHand(hand.fit, qpos),))
        sight, radii = SceneSight(placed, rig), marker_radii(placed, OPTICS)
        seen = sight.visible_markers(OPTICS.partial * radii, rng=rng)
        views = seen.sum(axis=-1)
        two.append((views >= FEWEST_CAMERAS).mean(axis=1))
        three.append((views > FEWEST_CAMERAS).mean(axis=1))
        errors.append(_errors(sight.markers[0], seen, rig, radii))
    error = np.concatenate(errors, axis=1)
    known = np.isfinite(error)
    mean = np.where(known, error, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    return VolumeMap(points, np.mean(two, axis=0), np.mean(three, axis=0), mean)


def _errors(
    markers: NDArray[np.float64], seen: NDArray[np.bool_], rig: CameraRig, radii: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of each marker (G, M) [m], NaN where it has no point."""
    errors = np.full(seen.shape[:2], np.nan)
    rows, columns = np.nonzero(seen.sum(axis=-1) >= FEWEST_CAMERAS)
    noise = OPTICS.noise * np.sqrt(MARKER_RADIUS / radii[columns])
    spread = covariances(markers[rows, columns], seen[rows, columns], rig, noise)
    lengths = np.sqrt(np.trace(spread, axis1=1, axis2=2))
    errors[rows, columns] = np.where(lengths < _LONGEST, lengths, np.nan)
    return errors
