"""A hand's shape as 53 parameters around an initial shape, and coordinates on the skin of hands.

All shapes are of right hands. Length and breadth scale the whole hand. In addition bone lengths, knuckles,
directions of digits, girths and palm thickness vary, as in `handsim.hand.shape.sample_shape`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import Attachment
from gloves.layout import MarkerLayout
from handsim.arrays import Doubles, Integers
from handsim.hand.model import HandModel, metacarpal_rotations
from handsim.hand.shape import ADULTS, DIGIT_OF_BONE, DIGITS, HandShape, Side, named_shape
from handsim.hand.skin import all_weights, build_surface, catmull_clark, strongest_weights, vertex_normals
from handsim.kernels import CARPUS
from handsim.space.transforms import MIRROR, euler_axes

if TYPE_CHECKING:
    from scipy import sparse

LENGTH, BREADTH = 0, 1  # log factors
BONE_LENGTHS: Final = slice(2, 17)  # log factors, three per digit
KNUCKLES: Final = slice(17, 32)  # [m], three per digit
DIRECTIONS: Final = slice(32, 47)  # base angles [rad], three per digit
GIRTHS: Final = slice(47, 52)  # log factors, one per digit
THICKNESS: Final = 52  # log factor
NUM_PARAMETERS: Final = 53
# The nearest of the five sizes may be wrong by more than a size; length and breadth are correlated (ANSUR
# II). Real knuckles are assumed to vary twice as much as in the simulated population.
_SIZE_SPREAD: Final = 0.09
_SIZE_CORRELATION: Final = 0.6
_KNUCKLE_SPREAD: Final = 2.0 * ADULTS.knuckle_spread
DIFFERENCE_STEP: Final = 1e-5  # step of finite differences
_MOST_PROJECTION_STEPS: Final = 40
_OUTSIDE_BARYCENTRIC: Final = -1e-9  # barycentric coordinate below which a point is outside its triangle
_PROJECTION_TOLERANCE: Final = 1e-8  # [m] A projection ends closer to its target than this.


def shape_at(start: HandShape, parameters: Float[np.ndarray, "53"]) -> HandShape:
    """The shape at these parameters; zeros give `start`."""
    along, across = np.exp(parameters[LENGTH]), np.exp(parameters[BREADTH])
    return dataclasses.replace(
        start,
        length=float(start.length * along),
        breadth=float(start.breadth * across),
        bone_lengths=start.bone_lengths * along * np.exp(parameters[BONE_LENGTHS].reshape(5, 3)),
        knuckles=start.knuckles * [along, across, across] + parameters[KNUCKLES].reshape(5, 3),
        base_angles=start.base_angles + parameters[DIRECTIONS].reshape(5, 3),
        radii=start.radii * across * np.exp(parameters[GIRTHS])[:, None],
        palm_thickness=float(start.palm_thickness * across * np.exp(parameters[THICKNESS])),
    )


def mirror_to_right(side: Side) -> Doubles:
    """The matrix (3, 3) that makes points of a hand those of a right one: it mirrors left ones."""
    return MIRROR if side == "left" else np.eye(3)


def shape_precision() -> Float[np.ndarray, "53 53"]:
    """Precision matrix of the prior: inverse covariance of the parameters among people."""
    covariance = np.zeros((NUM_PARAMETERS, NUM_PARAMETERS))
    covariance[:2, :2] = _SIZE_SPREAD**2 * np.array([[1.0, _SIZE_CORRELATION], [_SIZE_CORRELATION, 1.0]])
    a_digit = np.kron(np.eye(len(DIGITS)), np.ones((3, 3)))
    covariance[BONE_LENGTHS, BONE_LENGTHS] = ADULTS.bone_spread**2 * np.eye(15)
    covariance[BONE_LENGTHS, BONE_LENGTHS] += ADULTS.digit_spread**2 * a_digit
    covariance[KNUCKLES, KNUCKLES] = _KNUCKLE_SPREAD**2 * np.eye(15)
    angles = np.deg2rad(ADULTS.angle_spread) * np.repeat([3.0, 1.0, 1.0, 1.0, 1.0], 3)
    covariance[DIRECTIONS, DIRECTIONS] = np.diag(angles**2)
    covariance[GIRTHS, GIRTHS] = ADULTS.girth_spread**2 * np.eye(5)
    covariance[THICKNESS, THICKNESS] = ADULTS.girth_spread**2
    return np.linalg.inv(covariance)


def shape_jacobian(
    start: HandShape,
    parameters: Float[np.ndarray, "53"],
    function: Callable[[list[HandShape]], Float[np.ndarray, "B *shape"]],
) -> Float[np.ndarray, "*shape 53"]:
    """Derivative of a function of the shape by its parameters, by finite differences."""
    nudged = parameters + DIFFERENCE_STEP * np.eye(1 + NUM_PARAMETERS, NUM_PARAMETERS, -1)
    values = function([shape_at(start, one) for one in nudged])  # The first one is unchanged.
    # Derivatives by one parameter are contiguous.
    return np.moveaxis((values[1:] - values[0]) / DIFFERENCE_STEP, 0, -1)


def skinned_shape_jacobian(
    model: HandModel,
    parameters: Float[np.ndarray, "53"],
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
    by_bone: Float[np.ndarray, "T M L 3"],
) -> Float[np.ndarray, "T M 3 53"]:
    """Derivative of skinned points by the parameters of a hand, for fixed rest points [m] and poses.

    A bone carries a point p to o + A (p - r): its joint is at r in the rest hand and at o in the world, and A
    turns it. Knuckles and lengths move r and o; directions turn the digit around its knuckle in both.
    """
    shape, frames, count = model.shape, len(T_world_bone), len(points)
    wrist, digits = T_world_bone[:, 0, :3, :3], T_world_bone[:, 1:].reshape(-1, len(DIGITS), 3, 4, 4)
    rest, shares = model.rest_transforms[1:].reshape(len(DIGITS), 3, 4, 4), weights[:, 1:].reshape(-1, 5, 3)
    # Sum the weights of each bone and the bones after it, and their weighted rotations.
    turns = digits[..., :3, :3] @ rest[..., :3, :3].swapaxes(-1, -2)
    turns = shares[:, :, ::-1, None, None] * turns[:, None, :, ::-1]
    turns = turns.cumsum(axis=3)[:, :, :, ::-1]
    after = shares[:, :, ::-1].cumsum(axis=2)[:, :, ::-1, None]
    jacobian = np.zeros((frames, count, 3, NUM_PARAMETERS))
    groups = BONE_LENGTHS, KNUCKLES, DIRECTIONS
    of_digits = [jacobian[..., group].reshape(frames, count, 3, len(DIGITS), 3) for group in groups]
    by_length, by_knuckle, by_direction = (np.moveaxis(one, 2, -1) for one in of_digits)
    along = (turns[:, :, :, 1:] @ rest[:, :2, :3, :1])[..., 0]
    by_length[:, :, :, :2] = after[:, :, 1:] * digits[:, None, :, :2, :3, 0] - along
    by_length *= shape.bone_lengths[..., None]
    metacarpals = metacarpal_rotations(model.skeleton, T_world_bone)
    # The base of a metacarpal is a share of the knuckle's position, so a knuckle moves it, too.
    carried = metacarpals + CARPUS * (wrist[:, None] - metacarpals)
    moved = after[:, :, 0, None] * carried[:, None] - turns[:, :, :, 0]
    by_knuckle[:] = moved.swapaxes(-1, -2)
    axes, arms = euler_axes(shape.base_angles), points[:, None] - rest[:, 0, :3, 3]
    placed = np.einsum("mdb,tmdbi->tmdi", shares, by_bone[:, :, 1:].reshape(frames, count, 5, 3, 3))
    placed -= after[:, :, 0] * digits[:, None, :, 0, :3, 3]
    swept = np.cross((axes @ metacarpals.swapaxes(-1, -2))[:, None], placed[..., None, :])
    by_direction[:] = swept - np.cross(axes, arms[:, :, None]) @ turns[:, :, :, 0].swapaxes(-1, -2)
    scaled = shape.knuckles - parameters[KNUCKLES].reshape(5, 3)
    across = scaled[..., None] * by_knuckle
    jacobian[..., LENGTH] = by_length.sum(axis=(2, 3)) + across[:, :, :, 0].sum(axis=2)
    jacobian[..., BREADTH] = across[:, :, :, 1:].sum(axis=(2, 3))
    return jacobian


def skinning_terms(
    model: HandModel,
    T_world_bone: Float[np.ndarray, "T L 4 4"],
    points: Float[np.ndarray, "M 3"],
    weights: Float[np.ndarray, "M 16"],
) -> tuple[Float[np.ndarray, "T M 3 3"], Float[np.ndarray, "T M L 3"]]:
    """Blended rotations of skinned points, and the points as moved by each single bone [m]."""
    motion = (T_world_bone @ np.linalg.inv(model.rest_transforms))[:, :, :3]
    rotations = np.einsum("ml,tlij->tmij", weights, motion[..., :3], optimize=True)
    by_bone = np.einsum("tlij,mj->tmli", motion[..., :3], points, optimize=True)
    by_bone += motion[:, None, ..., 3]
    return rotations, by_bone


class SkinTopology(NamedTuple):
    """Topology and skinning weights of the skin, equal for all hands."""

    subdivide: sparse.csr_array  # maps coarse vertices of `handsim.hand.skin` to these (V, coarse V)
    faces: Int[np.ndarray, "F 3"]  # triangles, counter-clockwise from outside
    adjacent: Int[np.ndarray, "F 3"]  # triangle across the edge opposite to each corner
    weights: Float[np.ndarray, "V 16"]  # skinning weights of all bones
    digits: Int[np.ndarray, "F"]  # digit of each triangle's main bone, -1 for the palm


class SkinCoordinates(NamedTuple):
    """Coordinates of P points on or above the skin."""

    faces: Int[np.ndarray, "P"]  # triangles of `skin_mesh`
    bary: Float[np.ndarray, "P 3"]  # barycentric coordinates of the foot points
    heights: Float[np.ndarray, "P"]  # above the skin, along the normal [m]

    def part(self, first: int, last: int | None) -> SkinCoordinates:
        """Coordinates of a range of points."""
        return SkinCoordinates(*(values[first:last] for values in self))


class Corners(NamedTuple):
    """Corners of some triangles on one hand's skin."""

    points: Float[np.ndarray, "P 3 3"]  # in the wrist's frame [m]
    normals: Float[np.ndarray, "P 3 3"]  # unit vertex normals

    def part(self, first: int, last: int | None) -> Corners:
        """Corners of a range of triangles."""
        return Corners(self.points[first:last], self.normals[first:last])


class Skin(NamedTuple):
    """One hand's subdivided skin in the wrist's frame."""

    points: Float[np.ndarray, "V 3"]  # [m]
    normals: Float[np.ndarray, "V 3"]

    def corners(self, faces: Int[np.ndarray, "P"]) -> Corners:
        """Corners of some triangles of `skin_mesh`."""
        vertices = skin_mesh().faces[faces]
        return Corners(self.points[vertices], self.normals[vertices])


@cache
def skin_mesh() -> SkinTopology:
    """Triangles and weights of the skin, subdivided once; cached."""
    coarse = build_surface(named_shape("M"))
    half = len(coarse.faces) // 2
    coarse_quads = np.column_stack([coarse.faces[:half], coarse.faces[half:, 2]])
    step, quads = catmull_clark(coarse_quads, len(coarse.vertices))
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    weights = step @ all_weights(coarse.bone_indices, coarse.bone_weights)
    digits = DIGIT_OF_BONE[weights[faces].sum(axis=1).argmax(axis=1)]
    return SkinTopology(step, faces, _adjacent_faces(faces), weights, digits)


def _adjacent_faces(faces: Integers) -> Integers:
    """Neighbors (F, 3) of each triangle of a closed mesh, opposite to its corners."""
    ends = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=-1).reshape(-1, 2)
    order = np.argsort(ends.min(axis=1) * (int(faces.max()) + 1) + ends.max(axis=1)).reshape(-1, 2)
    neighbors = np.empty(len(ends), dtype=np.int64)
    neighbors[order] = order[:, ::-1] // 3  # Every edge belongs to two triangles.
    return neighbors.reshape(faces.shape)


class SkinPatch:
    """The part of the skin that determines some triangles of `skin_mesh`, for any shape."""

    def __init__(self, faces: Int[np.ndarray, "P"]) -> None:
        mesh = skin_mesh()
        needed = np.isin(mesh.faces, mesh.faces[faces]).any(axis=1)  # all triangles around their vertices
        vertices, local = np.unique(mesh.faces[needed], return_inverse=True)
        rows = mesh.subdivide[vertices]
        self._nearby = np.unique(rows.indices)
        self._rows = rows[:, self._nearby]
        self._faces = local.reshape(-1, 3)
        self._corners = np.searchsorted(vertices, mesh.faces[faces])

    def corners(self, vertices: Float[np.ndarray, "C 3"]) -> Corners:
        """Corners of the triangles on a skin with these coarse vertices."""
        points = self._rows @ vertices[self._nearby]
        return Corners(points[self._corners], vertex_normals(points, self._faces)[self._corners])


def build_skin(shape: HandShape) -> Skin:
    """The subdivided skin of a right hand."""
    mesh = skin_mesh()
    points = mesh.subdivide @ build_surface(shape).vertices
    return Skin(points, vertex_normals(points, mesh.faces))


def skin_points(
    coordinates: SkinCoordinates, corners: Corners
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Points [m] at these coordinates in the wrist's frame, and the unit normals there."""
    normals = np.einsum("pc,pci->pi", coordinates.bary, corners.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    foot = np.einsum("pc,pci->pi", coordinates.bary, corners.points)
    return foot + coordinates.heights[:, None] * normals, normals


def skin_weights(coordinates: SkinCoordinates) -> Float[np.ndarray, "P 16"]:
    """Skinning weights of all bones at these coordinates."""
    mesh = skin_mesh()
    shares = mesh.weights[mesh.faces[coordinates.faces]]
    return np.asarray(np.einsum("pc,pcb->pb", coordinates.bary, shares))


def attachment_at(layout: MarkerLayout, coordinates: SkinCoordinates, shape: HandShape) -> Attachment:
    """A glove with markers at skin coordinates of a right hand, each on its four bones of largest weight."""
    points, normals = skin_points(coordinates, build_skin(shape).corners(coordinates.faces))
    return Attachment(layout, points, normals, *strongest_weights(skin_weights(coordinates)))


def skin_weight_jacobian(coordinates: SkinCoordinates, corners: Corners) -> Float[np.ndarray, "P 16 3"]:
    """Derivative of the skinning weights by a point's position in the wrist's frame [1/m]."""
    mesh = skin_mesh()
    shares = mesh.weights[mesh.faces[coordinates.faces]]
    jacobian = np.linalg.inv(_point_jacobian(coordinates, corners))[:, :2]
    return np.asarray(np.einsum("pcb,pci->pbi", shares[:, 1:] - shares[:, :1], jacobian))


def _point_jacobian(coordinates: SkinCoordinates, corners: Corners) -> Doubles:
    """Derivatives (P, 3, 3) of each point [m] by two barycentric coordinates (the last two) and height."""
    blended = np.einsum("pc,pci->pi", coordinates.bary, corners.normals)
    length = np.linalg.norm(blended, axis=1)[:, None]
    normal = blended / length
    columns, points = [], corners.points
    for corner in (1, 2):
        change = corners.normals[:, corner] - corners.normals[:, 0]
        change = (change - (change * normal).sum(axis=1, keepdims=True) * normal) / length
        columns.append(points[:, corner] - points[:, 0] + coordinates.heights[:, None] * change)
    return np.stack([*columns, normal], axis=-1)


def project_onto_skin(
    coordinates: SkinCoordinates, targets: Float[np.ndarray, "P 3"], skin: Skin
) -> SkinCoordinates:
    """Coordinates of points [m], by Newton steps that walk between adjacent triangles."""
    # Where the skin folds, the walk may not converge: the foot point then stays on the last edge.
    faces, bary, heights = (values.copy() for values in coordinates)
    active = np.arange(len(faces))
    for _ in range(_MOST_PROJECTION_STEPS):
        here = SkinCoordinates(faces[active], bary[active], heights[active])
        corners = skin.corners(here.faces)
        residual = targets[active] - skin_points(here, corners)[0]
        step = np.linalg.solve(_point_jacobian(here, corners), residual[..., None])[..., 0]
        moved = here.bary + np.column_stack([-step[:, 0] - step[:, 1], step[:, :2]])
        heights[active] = here.heights + step[:, 2]
        lowest = moved.argmin(axis=1)
        out = moved[np.arange(len(active)), lowest] < _OUTSIDE_BARYCENTRIC
        # A foot point outside its triangle is clipped to the border.
        inside = np.clip(moved, 0.0, None)
        edge: Doubles = inside / inside.sum(axis=1, keepdims=True)
        bary[active] = np.where(out[:, None], np.where(np.isfinite(edge), edge, here.bary), moved)
        done = ~out & (np.linalg.norm(residual, axis=1) < _PROJECTION_TOLERANCE)
        _cross_edges(faces, bary, active[out], lowest[out])
        active = active[~done]
        if not len(active):
            break
    return SkinCoordinates(faces, bary, heights)


def _cross_edges(faces: Integers, bary: Doubles, crossing: Integers, corner: Integers) -> None:
    """Move the points `crossing` over the edges opposite to `corner`; changes `faces` and `bary`."""
    mesh, old = skin_mesh(), faces[crossing]
    new = mesh.adjacent[old, corner]
    same = mesh.faces[new][:, :, None] == mesh.faces[old][:, None, :]
    shares = np.where(np.arange(3) == corner[:, None], 0.0, bary[crossing])
    carried = (same * shares[:, None, :]).sum(axis=2)
    faces[crossing], bary[crossing] = new, carried / np.maximum(carried.sum(axis=1, keepdims=True), 1e-12)


def nearest_coordinates(
    points: Float[np.ndarray, "P 3"],
    feet: Float[np.ndarray, "P 3"],
    bones: Int[np.ndarray, "P"],
    shape: HandShape,
) -> SkinCoordinates:
    """Skin coordinates of points [m] in the wrist's frame, near `feet` on the digits of their bones."""
    # The skin of a neighboring finger may be nearer to a marker between two fingers.
    skin, mesh = build_skin(shape), skin_mesh()
    middles = skin.points[mesh.faces].mean(axis=1)
    off = 0.5 * (middles**2).sum(axis=1)[:, None] - middles @ feet.T  # half the squared distances, shifted
    faces = np.where(mesh.digits[:, None] == DIGIT_OF_BONE[bones], off, np.inf).argmin(axis=0)
    heights = np.linalg.norm(points - feet, axis=1)
    start = SkinCoordinates(faces, np.full((len(faces), 3), 1 / 3), heights)
    return project_onto_skin(start, points, skin)
