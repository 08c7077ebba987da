"""The skin's control cage in space: its vertices for a shape, and the scales that the fit adjusts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from handsim.hand.skeleton import build_skeleton
from handsim.hand.skin.cage_topology import (
    AROUND,
    CARPUS,
    FINGER_RINGS,
    METACARPUS,
    NUM_ROWS,
    PAST_KNUCKLES,
    THENAR,
    THUMB_RINGS,
    WEB,
    CageTopology,
    dorsal,
    finger_slots,
    palmar,
)
from handsim.hand.topology import DIGITS

if TYPE_CHECKING:
    from handsim.hand.shape import HandShape


# Height of the back above, and depth of the palm under, the metacarpals, in palm thicknesses, by column.
_HEIGHTS: Final = np.array(
    [
        [0.24, 0.43, 0.52, 0.54, 0.54, 0.52, 0.48, 0.40, 0.20],
        [0.24, 0.43, 0.52, 0.54, 0.54, 0.52, 0.48, 0.40, 0.20],
        [0.30, 0.46, 0.52, 0.54, 0.54, 0.52, 0.50, 0.45, 0.22],
        [0.30, 0.47, 0.50, 0.52, 0.51, 0.50, 0.49, 0.44, 0.20],
        [0.26, 0.46, 0.47, 0.49, 0.46, 0.49, 0.46, 0.46, 0.20],
        [0.24, 0.57, 0.38, 0.58, 0.39, 0.56, 0.38, 0.53, 0.20],
    ]
)
_DEPTHS: Final = np.array(
    [
        [0.50, 0.80, 0.90, 0.92, 0.92, 0.92, 0.90, 0.80, 0.42],
        [0.50, 0.80, 0.88, 0.90, 0.90, 0.92, 0.92, 0.82, 0.42],
        [0.60, 1.00, 1.00, 0.95, 0.90, 0.92, 0.96, 0.90, 0.50],
        [0.80, 1.25, 0.95, 0.80, 0.70, 0.71, 0.82, 0.86, 0.55],
        [0.52, 0.66, 0.62, 0.58, 0.56, 0.60, 0.66, 0.70, 0.42],
        [0.40, 0.62, 0.64, 0.64, 0.64, 0.64, 0.64, 0.60, 0.38],
    ]
)
_ROW_POSITIONS: Final = np.array(
    [-0.26, -0.05, 0.16, 0.42, 0.70, 0.97]
)  # along the metacarpals: 0 wrist, 1 joint
_WRIST_COLUMNS: Final = np.array([0.215, 0.075, -0.07, -0.205])  # of the four rays, in hand breadths
_EDGES: Final = np.array([[0.15, 0.14, 0.12, 0.13, 0.13, 0.145], [0.15, 0.14, 0.16, 0.17, 0.155, 0.145]])

_CARPUS_RISE: Final = 0.42  # the carpus arches over the line from wrist to knuckles, in palm thicknesses
_ARCH: Final = np.array([0.0, 0.0, 0.04, 0.08, 0.08, 0.02])  # and the metacarpals' backs over theirs, by row
# Finger joints rotate nearer to the back than to the pad: how far a section's middle lies below, in radii.
_PALMWARD: Final = np.array([0.0, -0.14])
# The web row along the first phalanges; webs slope from the back to the palm, the crotch comes out halfway.
_WEB_DISTANCES: Final = np.array(
    [
        [0.43, 0.43, 0.31, 0.38, 0.45, 0.43],
        [0.31, 0.43, 0.31, 0.38, 0.45, 0.38],
        [0.31, 0.43, 0.31, 0.38, 0.45, 0.38],
        [0.31, 0.43, 0.43, 0.43, 0.45, 0.38],
    ]
)

# The palm's vertices around the thumb's metacarpal: where they go along it, in its lengths, sideways and
# upwards, in its radii, and how much of the way there.
_THUMB_BASE_ROWS: Final = np.repeat([CARPUS, THENAR, METACARPUS], [4, 5, 3])
_THUMB_BASE_COLUMNS: Final = np.array(
    [dorsal(0), *map(palmar, range(3)), dorsal(0), *map(palmar, range(4)), *map(palmar, range(3))]
)
_THUMB_BASE: Final = np.array(
    [
        [-0.1, -0.9, 0.9, 0.5],
        [-0.03, 1.18, 0.47, 0.8],
        [-0.02, 1.68, -0.35, 0.75],
        [-0.11, 1.57, -1.36, 0.5],
        [0.25, -1.2, 0.5, 0.5],
        [0.48, 1.08, -0.78, 0.9],
        [0.50, 0.50, -1.32, 0.9],
        [0.41, 0.77, -1.94, 0.7],
        [0.29, 0.59, -2.77, 0.4],
        [0.65, -0.25, -1.20, 0.9],
        [0.68, -0.55, -1.75, 0.8],
        [0.69, -0.17, -2.31, 0.4],
    ]
)

_RING_ANGLES: Final = np.deg2rad(np.arange(30.0, 360.0, 60.0))
_ROUND: Final = np.stack([1.03 * np.cos(_RING_ANGLES), 0.97 * np.sin(_RING_ANGLES)], axis=-1)
# Sections (y, z) of the rings about the axis: knuckles stand out on the back, the nail is flat, the pad full.
_SECTIONS: Final = {
    "metacarpal": _ROUND,
    "before 1": _ROUND,
    "at 1": _ROUND * [1.0, 1.0] + [0.0, 0.03],
    "after 1": _ROUND,
    "before 2": _ROUND,
    "after 2": _ROUND * [1.02, 0.97],
    "pad": np.array([[0.92, 0.52], [0.0, 0.80], [-0.92, 0.52], [-0.86, -0.62], [0.0, -1.12], [0.86, -0.62]]),
    "tip": np.array([[0.52, 0.28], [0.0, 0.46], [-0.52, 0.28], [-0.46, -0.44], [0.0, -0.68], [0.46, -0.44]]),
}


_WAISTS: Final = {"before 1": 0.985, "at 1": 1.01, "after 1": 0.985}


@dataclass(slots=True, eq=False)
class CageScales:
    """Scales that the fit to a shape's measures adjusts, because subdivision shrinks the cage."""

    rings: list[Float[np.ndarray, " R"]]
    """Factor on the radius of each ring of each digit."""
    tips: Float[np.ndarray, " 5"]
    """How far the last ring of each digit is pushed out [m]."""
    breadth: float
    thickness: float


def first_scales() -> CageScales:
    """Factors that suit the mean hand."""
    rings = [np.full(len(THUMB_RINGS if digit == 0 else FINGER_RINGS), 1.2) for digit in range(len(DIGITS))]
    return CageScales(rings, np.zeros(len(DIGITS)), 1.1, 1.1)


def ring_distances(shape: HandShape, digit: int) -> Float[np.ndarray, " R"]:
    """Distance of each ring from the digit's first joint, along the straight digit [m]."""
    first, second, third = shape.bone_lengths[digit]
    _, radius_1, radius_2, radius_3 = shape.radii[digit]
    joint_2, tip = first + second, first + second + third
    after_2 = joint_2 + 0.6 * radius_2
    distances = [
        first - 0.75 * radius_1,
        first,
        first + 0.75 * radius_1,
        joint_2 - 0.6 * radius_2,
        after_2,
        np.clip(tip - radius_3, after_2 + 0.35 * (tip - after_2), after_2 + 0.6 * (tip - after_2)),
        after_2 + 0.88 * (tip - after_2),
    ]
    return np.array([0.5 * first, *distances] if digit == 0 else distances)


def ring_girths(shape: HandShape, digit: int) -> Float[np.ndarray, " R"]:
    """Girth of the skin at each ring [m]: a little more at the joints, a little less between them."""
    names = THUMB_RINGS if digit == 0 else FINGER_RINGS
    waist = np.array([_WAISTS.get(name, 1.0) for name in names])
    girths: np.ndarray = 2.0 * np.pi * waist * radius_at(shape, digit, ring_distances(shape, digit))
    return girths


def radius_at(shape: HandShape, digit: int, distances: Float[np.ndarray, " R"]) -> Float[np.ndarray, " R"]:
    """Skin radius [m] at distances along a digit: straight between the shape's four radii."""
    first, second, third = shape.bone_lengths[digit]
    radii = shape.radii[digit]
    knots = [0.0, first, first + second, first + second + third - radii[3]]
    radius: np.ndarray = np.interp(distances, knots, radii)
    return radius


def digit_frames(shape: HandShape) -> Float[np.ndarray, "5 4 4"]:
    """`T_wrist_bone` of each digit's first bone on the right hand at zero angles."""
    return build_skeleton(shape.with_side("right")).rest_transforms()[1::3]


def _around(frame: Float[np.ndarray, "4 4"], distance: ArrayLike, offsets: np.ndarray) -> np.ndarray:
    """Points at `offsets` (..., 2) (y, z) [m] from a digit's axis, `distance` (...) [m] along it."""
    along = np.broadcast_to(np.asarray(distance, dtype=np.float64), offsets.shape[:-1])
    local = np.concatenate([along[..., None], offsets], axis=-1)
    points: np.ndarray = local @ frame[:3, :3].T + frame[:3, 3]
    return points


def cage_vertices(
    shape: HandShape, frames: Float[np.ndarray, "5 4 4"], topology: CageTopology, scales: CageScales
) -> Float[np.ndarray, "K 3"]:
    """Cage vertices of a right hand in the wrist frame [m]; `frames` as `digit_frames` gives them."""
    vertices = np.empty((topology.num_vertices, 3))
    vertices[topology.palm] = _palm(shape, frames, scales)
    for digit, rings in enumerate(topology.rings):
        names = THUMB_RINGS if digit == 0 else FINGER_RINGS
        distances = ring_distances(shape, digit)
        sections = np.array([_SECTIONS[name] for name in names])
        sections[:-2] += _PALMWARD
        sections = sections * (radius_at(shape, digit, distances) * scales.rings[digit])[:, None, None]
        distances[-1] += scales.tips[digit]
        vertices[rings] = _around(frames[digit], distances[:, None], sections)
    _shape_thumb_base(shape, frames, vertices, topology)
    return vertices


def _palm(
    shape: HandShape, frames: Float[np.ndarray, "5 4 4"], scales: CageScales
) -> Float[np.ndarray, "8 18 3"]:
    rows = np.empty((NUM_ROWS, AROUND, 3))
    wrist = np.zeros((4, 3))
    wrist[:, 1] = _WRIST_COLUMNS * shape.breadth
    wrist[:, 2] = _CARPUS_RISE * shape.palm_thickness
    knuckles = shape.knuckles[1:]
    along = np.clip(_ROW_POSITIONS, 0.0, 1.0)[:, None, None]
    centers = (1.0 - along) * wrist + along * knuckles
    centers[..., 0] = _ROW_POSITIONS[:, None] * np.where(
        _ROW_POSITIONS[:, None] < 0.0, knuckles[1, 0], knuckles[:, 0]
    )
    columns = np.empty((6, 9, 3))
    columns[:, 1::2] = centers
    columns[:, 2:-1:2] = 0.5 * (centers[:, :-1] + centers[:, 1:])
    edges = _EDGES * shape.breadth * scales.breadth
    columns[:, 0], columns[:, 8] = columns[:, 1], columns[:, 7]
    columns[:, 0, 1] += edges[0]
    columns[:, 8, 1] -= edges[1]
    thickness = shape.palm_thickness * scales.thickness
    rows[:6, :9], rows[:6, 9:] = columns, columns[:, ::-1]
    rows[:6, :9, 2] += (_HEIGHTS + _ARCH[:, None]) * thickness
    rows[:6, 9:, 2] -= _DEPTHS[:, ::-1] * thickness
    past = np.repeat(0.7 * shape.radii[1:, :1], 6, axis=1)
    rows[PAST_KNUCKLES] = _finger_bases(shape, frames, past, 0.12)
    rows[WEB] = _finger_bases(shape, frames, _WEB_DISTANCES * shape.bone_lengths[1:, :1], 0.0)
    return rows


def _finger_bases(
    shape: HandShape, frames: Float[np.ndarray, "5 4 4"], distances: Float[np.ndarray, "4 6"], deepen: float
) -> Float[np.ndarray, "18 3"]:
    """A palm row across the fingers, `distances` [m] past their first joints; neighbors share their sides."""
    row = np.zeros((AROUND, 3))
    shared = np.zeros(AROUND)
    for finger, distance in enumerate(distances):
        digit, slots = finger + 1, finger_slots(finger)
        radius = 1.2 * radius_at(shape, digit, distance)
        section = (_ROUND + _PALMWARD) * radius[:, None]
        section[3:, 1] -= deepen * radius[3:]
        row[slots] += _around(frames[digit], distance, section)
        shared[slots] += 1.0
    return row / shared[:, None]


def _shape_thumb_base(
    shape: HandShape, frames: Float[np.ndarray, "5 4 4"], vertices: np.ndarray, topology: CageTopology
) -> None:
    """Thenar muscle and first web: the palm's rows around the thumb's metacarpal, in the thumb's frame."""
    length, radius = shape.bone_lengths[0, 0], shape.radii[0, 0]
    moved = topology.palm[_THUMB_BASE_ROWS, _THUMB_BASE_COLUMNS]
    along, across, share = np.split(_THUMB_BASE, [1, 3], axis=1)
    targets = _around(frames[0], along[:, 0] * length, radius * across)
    vertices[moved] = (1.0 - share) * vertices[moved] + share * targets
    ring = topology.rings[0][0]
    section = np.array([[1.02, 0.6], [0.0, 1.1], [-1.1, 0.7], [-1.4, -0.6], [0.2, -1.0], [0.95, -0.62]])
    along = np.array([0.55, 0.5, 0.55, 0.72, 0.77, 0.67]) * length
    vertices[ring] = _around(frames[0], along, 1.12 * radius * section)
