"""The skin's control cage in space: its vertices for many shapes at once, at scales that the fit adjusts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

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
from handsim.space.transforms import euler_matrix

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
_THUMB, _FINGERS = slice(0, 1), slice(1, len(DIGITS))
_GROUPS: Final = ((_THUMB, THUMB_RINGS), (_FINGERS, FINGER_RINGS))  # digits with the same rings


class CageHands(NamedTuple):
    """Measures of B right hands, as in `handsim.hand.shape.HandShape`."""

    breadth: Float[np.ndarray, "B"]
    palm_thickness: Float[np.ndarray, "B"]
    bone_lengths: Float[np.ndarray, "B 5 3"]
    knuckles: Float[np.ndarray, "B 5 3"]
    radii: Float[np.ndarray, "B 5 4"]
    frames: Float[np.ndarray, "B 5 4 4"]
    """`T_wrist_bone` of each digit's first bone at zero angles."""

    @classmethod
    def of(cls, shapes: Sequence[HandShape]) -> Self:
        """The measures of some hands, whatever their sides."""
        frames = np.tile(np.eye(4), (len(shapes), len(DIGITS), 1, 1))
        frames[..., :3, :3] = euler_matrix(np.stack([shape.base_angles for shape in shapes]))
        frames[..., :3, 3] = knuckles = np.stack([shape.knuckles for shape in shapes])
        return cls(
            np.array([shape.breadth for shape in shapes]),
            np.array([shape.palm_thickness for shape in shapes]),
            np.stack([shape.bone_lengths for shape in shapes]),
            knuckles,
            np.stack([shape.radii for shape in shapes]),
            frames,
        )

    def ring_girths(self) -> Float[np.ndarray, "B R"]:
        """Girth of the skin at each ring [m]: a little more at the joints, a little less between them."""
        girths = []
        for digits, names in _GROUPS:
            waist = np.array([_WAISTS.get(name, 1.0) for name in names])
            radii = self._radius_at(digits, self._ring_distances(digits))
            girths.append((2.0 * np.pi * waist * radii).reshape(len(radii), -1))
        return np.concatenate(girths, axis=1)

    def cage_parts(self, topology: CageTopology) -> Float[np.ndarray, "3 B K 3"]:
        """The cage is affine in its scales: vertices in the wrist frame [m] at zero, per width, per depth.

        Width scales rings and the palm's breadth; depth pushes the last rings out and scales the palm's
        thickness.
        """
        wide, deep = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        cages = np.empty((len(self.breadth), 3, topology.num_vertices, 3))
        cages[:, :, topology.palm] = self._palm(wide, deep)
        for digits, names in _GROUPS:
            distances = self._ring_distances(digits)[:, None]  # (B, 1, D, R)
            sections = np.array([_SECTIONS[name] for name in names])
            sections[:-2] += _PALMWARD
            radii = self._radius_at(digits, distances[:, 0])[:, None] * wide[:, None, None]  # (B, 3, D, R)
            along = np.repeat(distances, 3, axis=1)
            along[..., -1] += deep[:, None]
            rings = np.stack(topology.rings[digits])
            cages[:, :, rings] = self._around(digits, along[..., None], sections * radii[..., None, None])
        self._shape_thumb_base(cages, topology)
        parts = cages.swapaxes(0, 1)
        parts[1:] -= parts[0].copy()
        return parts

    def _ring_distances(self, digits: slice) -> NDArray[np.float64]:
        """Distance of each ring from its digit's first joint (B, D, R), along straight digits [m]."""
        first, second, third = np.moveaxis(self.bone_lengths[:, digits], -1, 0)
        _, radius_1, radius_2, radius_3 = np.moveaxis(self.radii[:, digits], -1, 0)
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
        return np.stack([0.5 * first, *distances] if digits == _THUMB else distances, axis=-1)

    def _radius_at(self, digits: slice, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Skin radius [m] at distances (B, D, R) along digits: straight between the shape's four radii."""
        first, second, third = np.moveaxis(self.bone_lengths[:, digits], -1, 0)
        radii = self.radii[:, digits]
        knots = np.stack(
            [np.zeros_like(first), first, first + second, first + second + third - radii[..., 3]], axis=-1
        )
        slopes = np.diff(radii) / np.diff(knots)
        between = radii[..., :1]
        for part in range(3):
            start = knots[..., part, None]
            line = slopes[..., part, None] * (distances - start) + radii[..., part, None]
            between = np.where(distances >= start, line, between)
        return np.where(distances >= knots[..., 3:], radii[..., 3:], between)

    def _around(
        self, digits: slice, distances: NDArray[np.float64], offsets: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Points at `offsets` (B, S, D, ..., 2) (y, z) [m] from digits' axes, `distances` along them."""
        along = np.broadcast_to(distances, offsets.shape[:-1])
        local = np.concatenate([along[..., None], offsets], axis=-1)
        frames = self.frames[:, None, digits]
        flat = local.reshape(*local.shape[:3], -1, 3) @ frames[..., :3, :3].swapaxes(-1, -2)
        points: NDArray[np.float64] = (flat + frames[..., None, :3, 3]).reshape(local.shape)
        return points

    def _palm(self, wide: NDArray[np.float64], deep: NDArray[np.float64]) -> NDArray[np.float64]:
        """The palm's rows (B, 3, 8, 18, 3) at three scales of breadth and thickness [m]."""
        count = len(self.breadth)
        wrist = np.zeros((count, 1, 4, 3))
        wrist[..., 1] = _WRIST_COLUMNS * self.breadth[:, None, None]
        wrist[..., 2] = _CARPUS_RISE * self.palm_thickness[:, None, None]
        knuckles = self.knuckles[:, None, 1:]
        along = np.clip(_ROW_POSITIONS, 0.0, 1.0)[:, None, None]
        centers = (1.0 - along) * wrist + along * knuckles  # (B, 6, 4, 3)
        centers[..., 0] = _ROW_POSITIONS[:, None] * np.where(
            _ROW_POSITIONS[:, None] < 0.0, knuckles[:, :, 1:2, 0], knuckles[..., 0]
        )
        columns = np.empty((count, 1, 6, 9, 3))
        columns[:, 0, :, 1::2] = centers
        columns[:, 0, :, 2:-1:2] = 0.5 * (centers[:, :, :-1] + centers[:, :, 1:])
        columns[..., 0, :], columns[..., 8, :] = columns[..., 1, :], columns[..., 7, :]
        columns = np.repeat(columns, 3, axis=1)
        edges = _EDGES * self.breadth[:, None, None, None] * wide[:, None, None]  # (B, 3, 2, 6)
        columns[..., 0, 1] += edges[:, :, 0]
        columns[..., 8, 1] -= edges[:, :, 1]
        thickness = (self.palm_thickness[:, None] * deep)[..., None, None]
        rows = np.empty((count, 3, NUM_ROWS, AROUND, 3))
        rows[:, :, :6, :9], rows[:, :, :6, 9:] = columns, columns[..., ::-1, :]
        rows[:, :, :6, :9, 2] += (_HEIGHTS + _ARCH[:, None]) * thickness
        rows[:, :, :6, 9:, 2] -= _DEPTHS[:, ::-1] * thickness
        past = np.repeat(0.7 * self.radii[:, 1:, :1], 6, axis=2)
        rows[:, :, PAST_KNUCKLES] = self._finger_bases(past, 0.12)
        rows[:, :, WEB] = self._finger_bases(_WEB_DISTANCES * self.bone_lengths[:, 1:, :1], 0.0)
        return rows

    def _finger_bases(self, distances: NDArray[np.float64], deepen: float) -> NDArray[np.float64]:
        """A palm row (B, 1, 18, 3) across the fingers, `distances` (B, 4, 6) [m] past their first joints.

        Neighbors share their sides.
        """
        radius = 1.2 * self._radius_at(_FINGERS, distances)
        section = (_ROUND + _PALMWARD) * radius[..., None]
        section[..., 3:, 1] -= deepen * radius[..., 3:]
        bases = self._around(_FINGERS, distances[:, None], section[:, None])
        row, shared = np.zeros((len(distances), 1, AROUND, 3)), np.zeros(AROUND)
        for finger in range(len(DIGITS) - 1):
            slots = finger_slots(finger)
            row[:, :, slots] += bases[:, :, finger]
            shared[slots] += 1.0
        return row / shared[:, None]

    def _shape_thumb_base(self, cages: NDArray[np.float64], topology: CageTopology) -> None:
        """Thenar muscle and first web, in place: the palm's rows around the thumb's metacarpal."""
        length, radius = self.bone_lengths[:, None, :1, :1], self.radii[:, None, :1, :1]
        moved = topology.palm[_THUMB_BASE_ROWS, _THUMB_BASE_COLUMNS]
        along, across, share = np.split(_THUMB_BASE, [1, 3], axis=1)
        targets = self._around(_THUMB, along[:, 0] * length, radius[..., None] * across)[:, :, 0]
        cages[:, :, moved] = (1.0 - share) * cages[:, :, moved] + share * targets
        section = np.array([[1.02, 0.6], [0.0, 1.1], [-1.1, 0.7], [-1.4, -0.6], [0.2, -1.0], [0.95, -0.62]])
        along = np.array([0.55, 0.5, 0.55, 0.72, 0.77, 0.67]) * length
        ring = self._around(_THUMB, along, (1.12 * radius)[..., None] * section)
        cages[:, :, topology.rings[0][0]] = ring[:, :, 0]
