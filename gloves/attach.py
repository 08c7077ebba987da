"""A layout put on a hand: every marker finds its place on the skin and the bones that carry it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gloves.layout import MarkerLayout, MarkerPlace
from handsim.errors import LayoutError
from handsim.mjcf import Site
from handsim.model import HandModel
from handsim.surface import HandSurface, linear_blend_skinning, vertex_normals
from handsim.topology import BONE_NAMES, PALM

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Attachment:
    """Markers of one glove on one hand: rest places and the weights of the skin under them."""

    layout: MarkerLayout
    points: Float[np.ndarray, "M 3"]
    """Marker centres at zero angles, in the wrist frame [m]: one radius above the skin."""
    normals: Float[np.ndarray, "M 3"]
    """Directions in which the markers look away from the skin, at zero angles."""
    bone_indices: Int[np.ndarray, "M 4"]
    """The bones that carry each marker."""
    bone_weights: Float[np.ndarray, "M 4"]
    """Their shares, summing to one."""

    def markers(
        self, model: HandModel, T_world_bone: Float[np.ndarray, "T L 4 4"]
    ) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M 3"]]:
        """Marker centres [m] and outward directions in the world, for poses of the same hand."""
        both = linear_blend_skinning(
            np.concatenate([self.points, self.points + self.normals]),
            np.tile(self.bone_indices, (2, 1)),
            np.tile(self.bone_weights, (2, 1)),
            model.rest_transforms,
            T_world_bone,
        )
        centres, ahead = np.split(both, 2, axis=1)
        normals = ahead - centres
        return centres, normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def sites(self, model: HandModel) -> tuple[Site, ...]:
        """The markers as MuJoCo sites, each on the bone that carries most of it."""
        bones = self.bone_indices[np.arange(len(self.points)), self.bone_weights.argmax(axis=1)]
        inverse = np.linalg.inv(model.rest_transforms)[bones]
        local = np.einsum("mij,mj->mi", inverse[:, :3, :3], self.points) + inverse[:, :3, 3]
        return tuple(
            Site(name, int(bone), place, self.layout.radius)
            for name, bone, place in zip(self.layout.names, bones, local, strict=True)
        )


def attach(layout: MarkerLayout, model: HandModel) -> Attachment:
    """Put a glove on a hand: from each place on its bone outwards to the skin.

    Raises:
        LayoutError: A marker's ray finds no skin; the sentence names the marker.
    """
    surface = model.surface
    triangles = surface.vertices[surface.faces]
    skin_normals = vertex_normals(surface.vertices, surface.faces)
    centroids = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centroids[:, None], axis=-1).max()
    corners, bary = np.empty((layout.num_markers, 3), dtype=np.int64), np.empty((layout.num_markers, 3))
    points, normals = np.empty((layout.num_markers, 3)), np.empty((layout.num_markers, 3))
    for number, marker in enumerate(layout.markers):
        origin, direction = _ray(marker, model)
        along = (centroids - origin) @ direction
        off = np.linalg.norm(centroids - origin - along[:, None] * direction, axis=1)
        near = np.flatnonzero((off <= reach) & (along >= -reach))
        found = _first_way_out(origin, direction, triangles[near])
        if found is None:
            raise LayoutError(
                f"marker '{marker.name}' finds no skin from {marker.bone} at along {marker.along:g}, "
                f"across {marker.across:g}; move it onto the hand"
            )
        face, bary[number], distance = found
        corners[number] = surface.faces[near[face]]
        normal = bary[number] @ skin_normals[corners[number]]
        normals[number] = normal / np.linalg.norm(normal)
        points[number] = origin + distance * direction + layout.radius * normals[number]
    indices, shares = _blend_weights(surface, corners, bary)
    return Attachment(layout, points, normals, indices, shares)


def vary_places(
    layout: MarkerLayout, *, along: float, around: float, rng: np.random.Generator
) -> MarkerLayout:
    """The same glove put on less carefully.

    Args:
        layout: The glove as designed.
        along: Standard deviation along the bones [bone lengths]; for the palm also across, at half of it.
        around: Standard deviation around the bones [rad].
        rng: Source of all randomness.
    """

    def moved(marker: MarkerPlace) -> MarkerPlace:
        slip, turn, side = np.clip(rng.standard_normal(3), -2.0, 2.0)
        palm = marker.bone == BONE_NAMES[PALM]
        return dataclasses.replace(
            marker,
            along=float(np.clip(marker.along + (0.5 if palm else 1.0) * along * slip, -0.3, 1.3)),
            around=float(np.clip(marker.around + (0.0 if palm else around) * turn, -np.pi, np.pi)),
            across=float(marker.across + 0.5 * along * side) if palm else 0.0,
        )

    return dataclasses.replace(layout, markers=tuple(moved(marker) for marker in layout.markers))


def _ray(marker: MarkerPlace, model: HandModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where a marker's ray starts on its bone's axis and where it goes, at zero angles in the wrist frame."""
    bone = BONE_NAMES.index(marker.bone)
    T_wrist_bone = model.rest_transforms[bone]
    sideways = 1.0 if model.shape.side == "right" else -1.0  # thumb side
    local = np.array([marker.along * model.skeleton.lengths[bone], 0.0, 0.0])
    if bone == PALM:
        local[1] = sideways * marker.across * model.shape.breadth
    turn = np.array([0.0, sideways * np.sin(marker.around), np.cos(marker.around)])
    return T_wrist_bone[:3, :3] @ local + T_wrist_bone[:3, 3], T_wrist_bone[:3, :3] @ turn


def _first_way_out(
    origin: NDArray[np.float64], direction: NDArray[np.float64], triangles: NDArray[np.float64]
) -> tuple[int, NDArray[np.float64], float] | None:
    """First way out of a closed mesh along a ray: face, barycentric weights, distance (Moeller-Trumbore)."""
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(direction, edge2)
    determinant = np.einsum("fi,fi->f", edge1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - triangles[:, 0]
        u = np.einsum("fi,fi->f", offset, across) / determinant
        q = np.cross(offset, edge1)
        v = q @ direction / determinant
        distance = np.einsum("fi,fi->f", edge2, q) / determinant
    slack = 1e-9
    outwards = (determinant < 0) & (u >= -slack) & (v >= -slack) & (u + v <= 1 + slack) & (distance > 0)
    if not outwards.any():
        return None
    face = int(np.where(outwards, distance, np.inf).argmin())
    return face, np.array([1 - u[face] - v[face], u[face], v[face]]), float(distance[face])


def _blend_weights(
    surface: HandSurface, corners: NDArray[np.int64], bary: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Skin weights between three vertices each, cut to the strongest four."""
    full = np.zeros((len(corners), len(BONE_NAMES)))
    rows = np.arange(len(corners))[:, None]
    for corner in range(3):
        vertex = corners[:, corner]
        shares = bary[:, corner, None] * surface.bone_weights[vertex]
        np.add.at(full, (rows, surface.bone_indices[vertex]), shares)
    indices = np.argsort(-full, axis=1, kind="stable")[:, :4]
    weights = np.clip(np.take_along_axis(full, indices, axis=1), 0.0, None)
    return indices, weights / weights.sum(axis=1, keepdims=True)
