"""Labeled captures of several people, one sub-folder each, and gloves that sit as on people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gloves.captures.formats import read_hands
from gloves.fit import Attachment
from handsim.hand.shape import BONES, HandShape
from handsim.space.transforms import quaternion_matrix
from track.calibration.hand_parameters import (
    attachment_at,
    build_skin,
    nearest_coordinates,
    project_onto_skin,
)


def read_markers(files: Sequence[Path], names: Sequence[str]) -> np.ndarray:
    """Named markers (T, M, 3) [m] of each hand in labeled captures, without frames that lack them all."""
    return np.concatenate([hand for file in files for hand in read_hands(file, names)[0]])


def right_hands(captures: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Markers (T, M, 3) [m] of every person's files *_right.trc, by the sub-folder's name."""
    return {
        person.name: read_markers(sorted(person.rglob("*_right.trc")), names)
        for person in sorted(captures.iterdir())
        if person.is_dir()
    }


def displace_markers(
    worn: Attachment, shape: HandShape, distance: float, lift: float = 0.0, *, rng: np.random.Generator
) -> Attachment:
    """A glove on a right hand with every marker displaced along the skin, as on a real glove."""
    steps = rng.normal(size=worn.points.shape)
    steps -= (steps * worn.normals).sum(axis=1, keepdims=True) * worn.normals
    steps *= distance / np.linalg.norm(steps, axis=1, keepdims=True)
    coordinates = project_onto_skin(
        nearest_coordinates(worn.points, worn.feet, worn.main_bones, shape),
        worn.points + steps,
        build_skin(shape),
    )
    heights = worn.layout.heights + rng.normal(scale=lift, size=len(steps))
    return attachment_at(worn.layout, coordinates._replace(heights=heights), shape)


def flesh_motion(worn: Attachment, qpos: np.ndarray, size: float, *, rng: np.random.Generator) -> np.ndarray:
    """Motion of markers in the world (T, M, 3) [m], of this RMS, by linear functions of their digits' angles.

    Markers of the palm move with the flexions of the fingers' knuckles.
    """
    turns = quaternion_matrix(qpos[:, 3:7])
    moved = np.empty((len(turns), worn.layout.num_markers, 3))
    for marker, bone in enumerate(worn.main_bones):
        digit = BONES[bone].digit
        angles = qpos[:, 7 + 4 * digit : 11 + 4 * digit] if digit >= 0 else qpos[:, 12::4]
        way = (angles - angles.mean(axis=0)) @ rng.standard_normal((4, 3))
        way *= size / max(float(np.sqrt((way**2).sum(axis=1).mean())), 1e-9)
        moved[:, marker] = np.einsum("tij,tj->ti", turns, way)
    return moved
