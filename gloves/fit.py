"""A hand in its glove: markers on the skin, the bones that carry them, and a point's place on the skin."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.layout import ACROSS_RANGE, ALONG_RANGE, MarkerLayout, MarkerPlace, load_layout
from gloves.optics.visibility import visible_cameras
from handsim.errors import ArgumentError, LayoutError
from handsim.hand.model import HandModel, Site, load_model
from handsim.hand.shape import (
    BONE_NAMES,
    DIGIT_OF_BONE,
    JOINTS,
    NUM_BONES,
    NUM_QPOS,
    PALM,
    HandShape,
    Side,
    shape_from_measures,
)
from handsim.hand.skin import all_weights, strongest_weights, vertex_normals
from handsim.kernels import kernel
from handsim.space.rig import CameraRig
from handsim.space.transforms import MIRROR, unit

_ARRAY_WIDTHS: Final = {"points": 3, "normals": 3, "bone_indices": 4, "bone_weights": 4}
_MAX_NUMBER: Final = 100.0  # largest position [m], direction or bone index
# The digit of each capsule of the palm: a metacarpal belongs to its finger, the wrist to the thumb.
_PALM_DIGITS: Final = np.array([1, 2, 3, 4, 0, 0])
# Places that are tried for a marker, one after another: the wanted place (1), the designed place (0), the
# middle of the bone's back (-1), and its near end (-2), where even fingers that overlap have free skin.
_FALLBACKS: Final = (
    *(1.0, 0.75, 0.5, 0.25, 0.0, -0.125, -0.25, -0.375, -0.5, -0.625, -0.75, -0.875, -1.0),
    *(-1.25, -1.5, -1.75, -2.0),
)
_NEAR_END: Final = 0.1  # along the bone
_MAX_SLIP: Final = 0.025  # largest random shift of a marker [m]
_CONVERGED: Final = 1e-5  # [m] distance of a marker from its target
_STALK_CONVERGED: Final = 2e-4  # [m] distance of a stalk's axis from its target
_MAX_BONE_ERROR: Final = 5e-4  # largest distance from its target at which a marker keeps its bone [m]
_CURVATURE_RADIUS: Final = 0.006  # radius of curvature of a fingertip's skin [m]
_SPACING: Final = 4e-3  # rough distance between neighboring skin vertices [m]
# A forearm in lengths of the hand: its length, and half of its breadth and of its depth at wrist and elbow.
_FOREARM_LENGTH: Final = 1.4
_FOREARM_HALVES: Final = np.array([[0.175, 0.11], [0.24, 0.22]])


@dataclass(frozen=True, slots=True, eq=False)
class Attachment:
    """Markers of one glove on one hand: rest positions and the weights of the skin under them.

    Raises:
        ArgumentError: An array does not fit the layout, or a value is out of range.
    """

    layout: MarkerLayout
    points: Float[np.ndarray, "M 3"]
    """Marker centers at zero angles, in the wrist frame [m]: one radius, and a stalk, above the skin."""
    normals: Float[np.ndarray, "M 3"]
    """Outward unit directions of the skin under the markers, at zero angles."""
    bone_indices: Int[np.ndarray, "M 4"]
    """The bones that carry each marker."""
    bone_weights: Float[np.ndarray, "M 4"]
    """Shares of these bones, summing to one."""

    def __post_init__(self) -> None:
        for name, width in _ARRAY_WIDTHS.items():
            shape, expected = getattr(self, name).shape, (self.layout.num_markers, width)
            if shape != expected:
                raise ArgumentError(f"{name} has shape {shape}, expected {expected}")
            if not np.isfinite(getattr(self, name)).all():
                raise ArgumentError(f"{name} holds NaN or infinite values, expected finite numbers")
            if np.abs(getattr(self, name)).max(initial=0) > _MAX_NUMBER:
                raise ArgumentError(
                    f"{name} holds numbers beyond {_MAX_NUMBER:g}, expected markers on a hand"
                )
        lengths = np.linalg.norm(self.normals, axis=1)
        if (np.abs(lengths - 1.0) > 1e-3).any():
            raise ArgumentError("normals are not of unit length, expected the outward directions of markers")
        bones, shares = self.bone_indices, self.bone_weights
        if bones.dtype.kind != "i" or not ((bones >= 0) & (bones < NUM_BONES)).all():
            raise ArgumentError(
                f"bone_indices are not bones, expected whole numbers from 0 to {NUM_BONES - 1}"
            )
        if not ((shares >= 0.0).all() and (np.abs(shares.sum(axis=1) - 1.0) <= 1e-6).all()):
            raise ArgumentError("bone_weights are not shares, expected positive numbers that sum to one")

    @property
    def main_bones(self) -> Int[np.ndarray, "M"]:
        """The bone that carries most of each marker."""
        return np.asarray(self.bone_indices[np.arange(len(self.points)), self.bone_weights.argmax(axis=1)])

    @property
    def digits(self) -> Int[np.ndarray, "M"]:
        """Digit of the bone that carries most of each marker, -1 for the palm."""
        return np.asarray(DIGIT_OF_BONE[self.main_bones])

    @property
    def beyond(self) -> Bool[np.ndarray, "20 M"]:
        """Whether each marker lies beyond each joint, and so can show its angle."""
        bones, moved = self.main_bones, np.array([[joint.bone] for joint in JOINTS])
        return np.asarray((bones >= moved) & (self.digits == DIGIT_OF_BONE[moved]))

    @property
    def feet(self) -> Float[np.ndarray, "M 3"]:
        """The places on the skin under the markers at zero angles, in the wrist frame [m]."""
        return np.asarray(self.points - self.layout.heights[:, None] * self.normals)

    def centers(
        self, model: HandModel, T_world_bone: Float[np.ndarray, "T L 4 4"]
    ) -> Float[np.ndarray, "T M 3"]:
        """Marker centers [m] in the world, for bones from `forward_kinematics` of the same hand."""
        return self._carried(model, T_world_bone, self.points, 1.0)

    def markers(
        self, model: HandModel, T_world_bone: Float[np.ndarray, "T L 4 4"]
    ) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M 3"]]:
        """Marker centers [m] and outward unit directions in the world, for bones of the same hand."""
        normals = unit(self._carried(model, T_world_bone, self.normals, 0.0))
        return self.centers(model, T_world_bone), normals

    def _carried(
        self, model: HandModel, T_world_bone: NDArray[np.float64], rest: NDArray[np.float64], last: float
    ) -> NDArray[np.float64]:
        """Move rest points (`last` 1) or directions (`last` 0) with their bones: (T, M, 3) in the world."""
        return carried(model, T_world_bone, rest, self.bone_indices, self.bone_weights, last)

    def sites(self, model: HandModel) -> tuple[Site, ...]:
        """The markers as MuJoCo sites, each on the bone that carries most of it."""
        bones = self.main_bones
        inverse = np.linalg.inv(model.rest_transforms)[bones]
        local = np.einsum("mij,mj->mi", inverse[:, :3, :3], self.points) + inverse[:, :3, 3]
        return tuple(
            Site(name, int(bone), position, self.layout.radius)
            for name, bone, position in zip(self.layout.names, bones, local, strict=True)
        )


def carried(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    rest: Float[np.ndarray, "M 3"],
    bone_indices: Int[np.ndarray, "M 4"],
    bone_weights: Float[np.ndarray, "M 4"],
    last: float = 1.0,
) -> Float[np.ndarray, "T M 3"]:
    """Points of the rest hand [m], or directions with `last` 0, as the bones with these shares carry them."""
    inverse = np.linalg.inv(model.rest_transforms)
    local = np.einsum("lij,mj->mli", inverse, np.insert(rest, 3, last, axis=1))
    weights = all_weights(bone_indices, bone_weights)
    count, num_bones = T_world_bone.shape[:2]
    bones = np.swapaxes(T_world_bone[..., :3, :], -1, -2).reshape(count, 4 * num_bones, 3)
    return np.asarray((weights[..., None] * local).reshape(len(rest), -1) @ bones)


def attach_markers(layout: MarkerLayout, model: HandModel) -> Attachment:
    """Put a glove on a hand: from each marker's point on its bone outwards to the skin of its digit.

    Raises:
        LayoutError: A marker meets no skin, or the skin of another digit; the message names both.
    """
    worn, missed, others = _put_on(layout.markers, layout, model)
    if missed:
        raise LayoutError(_refusal(layout.markers[missed[0]], others[missed[0]]))
    return worn


@functools.lru_cache(maxsize=64)
def check_layout(layout: MarkerLayout) -> None:
    """Refuse a layout that a hand of size M cannot wear, see `attach_markers`."""
    attach_markers(layout, HandModel.named("M"))


def _refusal(marker: MarkerPlace, other: str) -> str:
    """The error message for a marker whose place has no skin, or skin of another digit."""
    place = f"along {marker.along:g}, "
    palm = marker.bone == BONE_NAMES[PALM]
    place += f"across {marker.across:g}" if palm else f"around {np.rad2deg(marker.around):g}"
    if not other:
        return f"marker '{marker.name}' meets no skin from {marker.bone} at {place}; move it onto the hand"
    return (
        f"marker '{marker.name}' on {marker.bone} at {place} would lie on {other}; move it along or around "
        "its bone to skin of its own digit"
    )


def _put_on(
    markers: Sequence[MarkerPlace], layout: MarkerLayout, model: HandModel
) -> tuple[Attachment, list[int], list[str]]:
    """Put the glove on a hand with its markers at these places, and find markers that miss their digit.

    Returns the attachment, the indices of markers that miss, and for each marker the bone of another digit
    that it would lie on ("" for none). Points of markers that meet no skin are meaningless.
    """
    surface = model.surface
    rays = np.array([_ray(marker, model) for marker in markers])
    origins, directions = rays[:, 0], rays[:, 1]
    faces, bary, distances = _exits(
        origins, directions, surface.vertices, np.ascontiguousarray(surface.faces)
    )
    missed = faces < 0
    distances[missed] = 0.0
    bary[missed] = 1.0 / 3.0
    corners = surface.faces[faces]
    # Compute the skin normals only at the vertices under markers.
    needed = np.zeros(len(surface.vertices), dtype=np.bool_)
    needed[corners] = True
    around = surface.faces[needed[surface.faces].any(axis=1)]
    normals = unit(np.einsum("mk,mki->mi", bary, vertex_normals(surface.vertices, around)[corners]))
    feet = origins + distances[:, None] * directions
    points = feet + layout.heights[:, None] * normals
    vertices = corners.ravel()
    shares = all_weights(surface.bone_indices[vertices], bary.reshape(-1, 1) * surface.bone_weights[vertices])
    indices, weights = strongest_weights(shares.reshape(*corners.shape, -1).sum(axis=1))
    bones = np.array([BONE_NAMES.index(marker.bone) for marker in markers])
    others = _wrong_bones(feet, points, bones, indices[:, 0], model)
    others = ["" if gone else other for gone, other in zip(missed, others, strict=True)]
    astray = np.flatnonzero(missed | (np.array(others) != "")).tolist()
    return Attachment(layout, points, normals, indices, weights), astray, others


def _wrong_bones(
    feet: NDArray[np.float64],
    points: NDArray[np.float64],
    bones: NDArray[np.int64],
    carriers: NDArray[np.int64],
    model: HandModel,
) -> list[str]:
    """Per marker, the bone of another digit that carries it or is nearest on the flat hand; "" for none.

    A metacarpal counts to its finger for markers of that finger, and to the palm for markers of the palm. A
    thumb's marker may lie over the index finger's metacarpal and the wrist. Skin that the palm carries more
    than any other bone, as over the thumb's muscle and the knuckles, counts to the palm. The end of a stalk
    may not be inside another digit.
    `feet` are the places under the markers' centers `points` on the skin (M, 3) [m], `carriers` the bones
    that carry most of the skin there, `bones` those of the markers (M,).
    """
    capsules = model.capsules
    axes = capsules.posed(model.rest_transforms[None])[0]
    digits = DIGIT_OF_BONE[bones][:, None]
    own = DIGIT_OF_BONE[capsules.bones] == digits
    own[:, capsules.bones == PALM] |= (digits == _PALM_DIGITS) | ((digits == 0) & (_PALM_DIGITS == 1))
    distances = _axis_distances(feet, axes)
    nearest = np.where(own, distances, np.inf).min(axis=1)
    rival = np.where(own, np.inf, distances)
    slack = np.where((digits[:, 0] < 0) & (carriers == PALM), np.inf, 0.0)
    inside = np.where(own, np.inf, _axis_distances(points, axes) - capsules.radii)
    carried = DIGIT_OF_BONE[carriers]
    is_carried = (digits[:, 0] >= 0) & (carried >= 0) & (carried != digits[:, 0])
    is_buried, is_nearer = inside.min(axis=1) < 0.0, rival.min(axis=1) + slack < nearest
    others = capsules.bones[np.where(is_buried, inside.argmin(axis=1), rival.argmin(axis=1))]
    others = np.where(is_carried, carriers, others)
    is_astray = is_carried | is_buried | is_nearer
    return [BONE_NAMES[other] if wrong else "" for other, wrong in zip(others, is_astray, strict=True)]


def _axis_distances(points: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (M, K) [m] of points (M, 3) from segments (K, 2, 3)."""
    spans = axes[:, 1] - axes[:, 0]
    offsets = points[:, None] - axes[:, 0]
    shares = np.einsum("mki,ki->mk", offsets, spans) / np.einsum("ki,ki->k", spans, spans)
    nearest = np.clip(shares, 0.0, 1.0)[..., None] * spans
    return np.asarray(np.linalg.norm(offsets - nearest, axis=-1))


def vary_layout(
    layout: MarkerLayout, *, along: float, around: float, rng: np.random.Generator
) -> MarkerLayout:
    """The glove with its markers shifted at random, by standard deviations [bone lengths] and [rad].

    On the palm markers shift along and across by half of `along`.
    """
    draws = np.clip(rng.standard_normal((layout.num_markers, 3)), -2.0, 2.0).tolist()

    def moved(marker: MarkerPlace, slip: float, roll: float, side: float) -> MarkerPlace:
        palm = marker.bone == BONE_NAMES[PALM]
        return dataclasses.replace(
            marker,
            along=min(max(marker.along + (0.5 if palm else 1.0) * along * slip, -0.3), 1.3),
            around=min(max(marker.around + (0.0 if palm else around) * roll, -math.pi), math.pi),
            across=marker.across + 0.5 * along * side if palm else 0.0,
        )

    moves = zip(layout.markers, draws, strict=True)
    return dataclasses.replace(layout, markers=tuple(moved(marker, *draw) for marker, draw in moves))


def wear(
    layout: MarkerLayout, model: HandModel, *, along: float, around: float, rng: np.random.Generator
) -> Attachment:
    """Put on a glove with random shifts (`vary_layout`).

    A shift is shortened until its marker is on the skin of its digit and within `_MAX_SLIP` of its
    designed point.

    Raises:
        LayoutError: A hand of size M cannot wear the glove.
    """
    check_layout(layout)
    wanted, designed = (
        vary_layout(layout, along=along, around=around, rng=rng),
        _settled(layout, layout, model),
    )
    return _settled(designed.layout, wanted, model, designed.points)


def settle_glove(layout: MarkerLayout, model: HandModel) -> GloveFit:
    """Put a glove on a hand of any proportions, as designed where that is possible.

    A marker that would not lie on its own digit moves towards the middle of its bone's back, then on to the
    near end.
    """
    return GloveFit(model, _settled(layout, layout, model))


def mean_hand(length: float, breadth: float, layout: MarkerLayout) -> GloveFit:
    """A right hand of mean proportions in a glove as designed; length and breadth in [m]."""
    return settle_glove(layout, HandModel(shape_from_measures(length, breadth, side="right")))


def _settled(
    layout: MarkerLayout,
    wanted: MarkerLayout,
    model: HandModel,
    designed: Float[np.ndarray, "M 3"] | None = None,
) -> Attachment:
    """Put on a glove with each marker at the first place of `_FALLBACKS` on the skin of its own digit.

    If `designed` points [m] are given, each marker is within `_MAX_SLIP` of its point.
    """
    markers, missed = list(wanted.markers), list(range(layout.num_markers))
    for share in _FALLBACKS:
        for index in missed:
            markers[index] = _fallback_place(layout.markers[index], wanted.markers[index], share)
        worn, missed, _ = _put_on(markers, wanted, model)
        if designed is not None:
            slips = np.linalg.norm(worn.points - designed, axis=1)
            missed = sorted({*missed, *np.flatnonzero(slips > _MAX_SLIP).tolist()})
        if not missed:
            return dataclasses.replace(worn, layout=dataclasses.replace(wanted, markers=tuple(markers)))
    return attach_markers(layout, model)


def _fallback_place(designed: MarkerPlace, wanted: MarkerPlace, share: float) -> MarkerPlace:
    """The place at one of the shares of `_FALLBACKS`."""
    if share == 1.0:
        return wanted
    if share < -1.0:
        along = 0.5 + (0.5 - _NEAR_END) * (share + 1.0)
        return dataclasses.replace(designed, along=along, around=0.0, across=0.0)
    end = wanted if share >= 0.0 else dataclasses.replace(designed, along=0.5, around=0.0, across=0.0)
    values = {
        key: getattr(designed, key) + abs(share) * (getattr(end, key) - getattr(designed, key))
        for key in ("along", "around", "across")
    }
    return dataclasses.replace(designed, **values)


def _ray(marker: MarkerPlace, model: HandModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin [m] and direction of a marker's ray from its bone, at zero angles in the wrist frame."""
    bone = BONE_NAMES.index(marker.bone)
    T_wrist_bone = model.rest_transforms[bone]
    sideways = 1.0 if model.shape.side == "right" else -1.0  # thumb side
    local = np.array([marker.along * model.skeleton.lengths[bone], 0.0, 0.0])
    if bone == PALM:
        local[1] = sideways * marker.across * model.shape.breadth
    direction = np.array([0.0, sideways * np.sin(marker.around), np.cos(marker.around)])
    return T_wrist_bone[:3, :3] @ local + T_wrist_bone[:3, 3], T_wrist_bone[:3, :3] @ direction


@kernel
def _exits(origins: Any, directions: Any, vertices: Any, faces: Any) -> Any:
    """First exits along rays: faces (R,), -1 for none, barycentric weights (R, 3), distances (R,) [m].

    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997).
    """
    found, weights = np.full(len(origins), -1), np.empty((len(origins), 3))
    nearest = np.full(len(origins), np.inf)
    first, second, offset, across, turned = np.empty((5, 3))
    corners, reach = np.empty((3, len(faces))), np.empty(len(faces))
    for f in range(len(faces)):
        corner = vertices[faces[f, 0]]
        for i in range(3):
            corners[i, f] = corner[i]
            first[i] = vertices[faces[f, 1], i] - corner[i]
            second[i] = vertices[faces[f, 2], i] - corner[i]
        # A line that meets a triangle passes its first corner within the longer of the edges there.
        reach[f] = 1.01 * max(_dot(first, first), _dot(second, second))
    away = np.empty(len(faces))  # squared distance of the line from each first corner, less `reach`
    for r in range(len(origins)):
        x, y, z = origins[r]
        dx, dy, dz = directions[r]
        for f in range(len(faces)):
            ox, oy, oz = x - corners[0, f], y - corners[1, f], z - corners[2, f]
            along = ox * dx + oy * dy + oz * dz
            away[f] = ox * ox + oy * oy + oz * oz - along * along - reach[f]
        for f in range(len(faces)):
            if away[f] > 0.0:
                continue
            corner = vertices[faces[f, 0]]
            for i in range(3):
                first[i] = vertices[faces[f, 1], i] - corner[i]
                second[i] = vertices[faces[f, 2], i] - corner[i]
                offset[i] = origins[r, i] - corner[i]
            _cross(directions[r], second, across)
            determinant = _dot(first, across)
            if determinant >= 0.0:  # the ray enters the skin here, or runs along the face
                continue
            _cross(offset, first, turned)
            u, v = _dot(offset, across) / determinant, _dot(turned, directions[r]) / determinant
            distance = _dot(second, turned) / determinant
            # The tolerance lets a ray through an edge hit a face.
            if min(u, v, 1.0 - u - v) >= -1e-9 and 0.0 < distance < nearest[r]:
                found[r], nearest[r] = f, distance
                weights[r] = (1.0 - u - v, u, v)
    return found, weights, nearest


@kernel(inline=True)
def _dot(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> float:
    """Scalar product of two vectors (3,)."""
    return float(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


@kernel(inline=True)
def _cross(
    first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"], product: Float[np.ndarray, "3"]
) -> None:
    """Write the vector product (3,) of two vectors (3,)."""
    product[0] = first[1] * second[2] - first[2] * second[1]
    product[1] = first[2] * second[0] - first[0] * second[2]
    product[2] = first[0] * second[1] - first[1] * second[0]


@dataclass(frozen=True, slots=True, eq=False)
class GloveFit:
    """One hand and the glove on it."""

    model: HandModel
    """The hand."""
    attachment: Attachment
    """The glove's markers on this hand."""

    def __repr__(self) -> str:
        """The hand's side and measures, and the glove's name."""
        length, breadth = 1e3 * self.shape.length, 1e3 * self.shape.breadth
        return f"GloveFit({self.side} hand of {length:.0f} x {breadth:.0f} mm in {self.layout.name})"

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.model.shape.side

    @property
    def shape(self) -> HandShape:
        """The hand's measures."""
        return self.model.shape

    @property
    def layout(self) -> MarkerLayout:
        """The glove's markers."""
        return self.attachment.layout

    def with_side(self, side: Side) -> GloveFit:
        """The same hand in its glove on the other (or the same) arm."""
        if side == self.side:
            return self
        worn = self.attachment
        mirrored = dataclasses.replace(worn, points=worn.points @ MIRROR, normals=worn.normals @ MIRROR)
        return GloveFit(HandModel(self.shape.with_side(side)), mirrored)

    def markers(
        self, qpos: Float[np.ndarray, "T 27"]
    ) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M 3"]]:
        """Marker centers [m] and outward unit directions in the world, for poses of this hand.

        Args:
            qpos: Wrist position [m], wrist orientation (wxyz), joint angles [rad].

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        return self.attachment.markers(self.model, self.model.forward_kinematics(qpos))

    def visible(self, qpos: Float[np.ndarray, "T 27"], rig: CameraRig) -> Bool[np.ndarray, "T M C"]:
        """Whether each camera sees each marker: in view, facing, and not occluded by the hand itself.

        Args:
            qpos: Poses of this hand, wrist position [m] in the world of the rig.
            rig: The cameras.
        """
        bones, capsules = self.model.forward_kinematics(qpos), self.model.capsules
        markers, normals = self.attachment.markers(self.model, bones)
        return visible_cameras(markers, normals, rig, capsules.posed(bones), capsules.radii)


@dataclass(frozen=True, slots=True, eq=False)
class GlovedHand:
    """A hand in its glove, in motion.

    Raises:
        ArgumentError: `qpos` is not (T, 27).
    """

    fit: GloveFit
    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN in frames without a pose."""

    def __post_init__(self) -> None:
        if self.qpos.ndim != 2 or self.qpos.shape[1] != NUM_QPOS:
            raise ArgumentError(f"qpos has shape {self.qpos.shape}, expected (T, {NUM_QPOS})")

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.fit.side

    @property
    def shape(self) -> HandShape:
        """The hand's measures."""
        return self.fit.shape

    @property
    def layout(self) -> MarkerLayout:
        """The glove's markers."""
        return self.fit.layout


def attach(layout: MarkerLayout | str | Path, model: HandModel | HandShape | str) -> GloveFit:
    """Put a glove on a hand as designed.

    Args:
        layout: The glove's markers, or the name or path of a layout.
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.

    Returns:
        The hand in its glove; `GloveFit.markers` gives marker centers (T, M, 3) [m] of poses.

    Raises:
        ArgumentError: An argument has another type, or there is no such size.
        LayoutError: There is no such layout, or a marker meets no skin; the message names the marker.
    """
    worn_by = load_model(model)
    return GloveFit(worn_by, attach_markers(load_layout(layout), worn_by))


def nominal_fit(layout: MarkerLayout | str | Path, size: str, side: Side) -> GloveFit:
    """A hand of one of the five sizes XS to XL, with its glove put on as designed, see `settle_glove`."""
    worn, model = load_layout(layout), HandModel.named(size, side=side)
    worn.check_side(side)
    check_layout(worn)
    return settle_glove(worn, model)


def forearm_markers(
    layout: MarkerLayout, length: float, side: Side
) -> tuple[Float[np.ndarray, "Q 3"], Float[np.ndarray, "Q 3"]]:
    """Markers on the forearm of a hand of some length [m], and the outward directions of the skin there.

    The frame is that of the wrist of a straight hand. Cross sections of the forearm are ellipses.
    """
    along, around, height = np.array([(one.along, one.around, one.height) for one in layout.forearm]).T
    wrist, elbow = length * _FOREARM_HALVES
    halves = wrist + along[:, None] * (elbow - wrist)
    turn = np.column_stack([np.sin(around), np.cos(around)])
    normals = np.column_stack([np.zeros(len(along)), unit(turn / halves)])
    skin = np.column_stack([-_FOREARM_LENGTH * length * along, halves * turn])
    mirror = MIRROR if side == "left" else np.eye(3)
    return (skin + (layout.radius + height)[:, None] * normals) @ mirror, normals @ mirror


def nearest_markers(fit: GloveFit) -> tuple[str, str, float]:
    """The two markers that are nearest on the flat hand, and the distance of their centers [m]."""
    points = fit.attachment.points
    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(distances, np.inf)
    first, second = divmod(int(distances.argmin()), len(points))
    return fit.layout.names[first], fit.layout.names[second], float(distances[first, second])


def place_marker(
    layout: MarkerLayout, index: int, model: HandModel, point: Float[np.ndarray, "3"], *, stays: bool = True
) -> MarkerLayout:
    """The layout with one marker moved to the place on the skin nearest to a point [m] of the flat hand.

    The marker stays on its bone if that reaches the point, or else moves to the bone that carries the skin
    there; unless it `stays` the latter comes first. A marker on a stalk keeps its height, and its stalk
    points at the point.
    """
    surface = model.surface
    nearest = int(((surface.vertices - point) ** 2).sum(axis=1).argmin())
    normal = vertex_normals(surface.vertices, surface.faces)[nearest]
    aside = point - surface.vertices[nearest]
    aside -= (aside @ normal) * normal
    aside *= min(1.0, _SPACING / max(float(np.linalg.norm(aside)), _CONVERGED))
    center = surface.vertices[nearest] + aside + layout.radius * normal
    bones = (BONE_NAMES.index(layout.markers[index].bone), int(surface.bone_indices[nearest, 0]))
    best, least = layout, math.inf
    for bone in dict.fromkeys(bones if stays else bones[::-1]):
        candidate, missed = _search_place(layout, index, bone, model, center, point)
        if missed < least:
            best, least = candidate, missed
        if least < _MAX_BONE_ERROR:
            break
    if math.isinf(least):
        raise LayoutError(f"marker '{layout.names[index]}' meets no skin there; move it nearer to the hand")
    return best


def _search_place(
    layout: MarkerLayout,
    index: int,
    bone: int,
    model: HandModel,
    center: NDArray[np.float64],
    point: NDArray[np.float64],
) -> tuple[MarkerLayout, float]:
    """The layout with a marker on one bone, nearest to a center or pointing at a point, and its error [m].

    The error is infinite where the bone's rays meet no skin.
    """
    height, wanted, start = layout.markers[index].height, center, model.rest_transforms[bone]
    middle = start[:3, 3] + 0.5 * model.skeleton.lengths[bone] * start[:3, 0]
    best, least = layout, math.inf
    for _ in range(12):  # the center lies on the skin's normal, not on the ray that finds the skin
        moved = dataclasses.replace(_bone_place(layout.markers[index], bone, model, wanted), height=height)
        markers = (*layout.markers[:index], moved, *layout.markers[index + 1 :])
        candidate = dataclasses.replace(layout, markers=markers)
        try:
            worn = attach_markers(candidate, model)
        except LayoutError:  # the ray misses the skin, as beyond a finger's tip
            wanted = wanted + 0.1 * (middle - wanted)
            continue
        missed = (point if height else center) - worn.points[index]
        if height:
            missed -= (missed @ worn.normals[index]) * worn.normals[index]
        distance = float(np.linalg.norm(missed))
        if distance < least:
            least, best = distance, candidate
        if least < (_STALK_CONVERGED if height else _CONVERGED):
            break
        # on curved skin the end of a stalk moves more than its foot
        wanted = wanted + missed * _CURVATURE_RADIUS / (_CURVATURE_RADIUS + height)
    return best, least


def _bone_place(marker: MarkerPlace, bone: int, model: HandModel, point: NDArray[np.float64]) -> MarkerPlace:
    """The place on a bone whose ray passes through a point."""
    T_wrist_bone = model.rest_transforms[bone]
    x, y, z = T_wrist_bone[:3, :3].T @ (point - T_wrist_bone[:3, 3])
    y *= 1.0 if model.shape.side == "right" else -1.0
    along = float(np.clip(x / model.skeleton.lengths[bone], *ALONG_RANGE))
    if bone != PALM:
        return MarkerPlace(marker.name, BONE_NAMES[bone], along, math.atan2(y, z))
    across = float(np.clip(y / model.shape.breadth, *ACROSS_RANGE))
    return MarkerPlace(marker.name, BONE_NAMES[bone], along, 0.0 if z >= 0.0 else math.pi, across)
