"""Meshes of drawn skin: the hand's surface on a forearm, shaped by its joints, with texture coordinates.

The hand's vertices are `HandModel.skin`'s, so that pictures show the surface behind all occlusion; a
forearm replaces the short stump behind the wrist.

The skin's cage has 360 faces; those in front of the wrist get a square tile of the texture each, so that
the texture needs no cutting by hand and no tile is stretched much. Corner texels of a tile lie on its
corners: neighbors hold the same colors along a common side, and no seam shows.

Linear blend skinning flattens a bent joint, where a hand shows the head of the bone. Joints therefore raise
smooth hills on the skin at rest, whose heights follow angles. Heights are those of bones under thin skin
(Gray's Anatomy, surface anatomy of the hand), chosen by eye.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy import sparse

from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, DIGIT_OF_BONE, DIGITS, JOINT_NAMES, JOINTS, NUM_BONES, NUM_JOINTS, PALM
from handsim.hand.skin import (
    PALM_VERTICES,
    all_weights,
    catmull_clark,
    load_cage,
    skin_frames,
    vertex_normals,
)
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR, quaternion_matrix
from render.fields import along_segment, bump, smooth
from render.frames import FOREARM, Bytes, Doubles, Floats, Integers
from render.skin.look import BEND, ELBOW, ELBOW_BEND, Forearm, bent_rings, forearm_rings

TILE: Final = 16
"""Texels along a tile's side."""
COLUMNS: Final = 20  # number of tiles in a row of the texture
ARM_ROWS: Final = 48
"""Texels along the forearm."""
RINGS: Final = 20
"""Rings of the forearm beyond the wrist's."""
_SUBDIVISIONS: Final = 2  # number of times that the cage is subdivided
_TILE_FACES: Final = 2**_SUBDIVISIONS  # faces of the skin along a tile
_REFERENCE_RADIUS: Final = 0.0118  # radius at the knuckle of the finger for which hills have their sizes [m]
_THUMB_RADIUS: Final = 0.018  # distance from the thumb's axis within which the skin is the thumb's [m]
_FINGERS: Final = ("index", "middle", "ring", "little")
_LEAST_BEND_SHARE: Final = 0.04  # Vertices bend where twice the product of two bones' weights is larger.
_FLESH_RATIO: Final = 1.2  # radius of the flesh around a capsule over the capsule's radius
_PALENESS: Final = 35.0  # logarithm of the light of skin over the height to which bones raise it [1/m]
_LEAST_AMBIENT: Final = 0.12  # share of the ambient light that the deepest folds receive


class Atlas(NamedTuple):
    """Topology of every drawn skin: vertices of the hand, of the forearm's rings, and of its end's middle."""

    used: Integers  # vertices (U,) of `HandSurface` that are drawn: those from the wrist's ring on
    wrist: Integers  # the wrist's ring (R,) of drawn vertices, from the index side over the back
    faces: Integers
    """Triangles (F, 3) of the drawn vertices, closed, counter-clockwise from outside on a right hand."""
    corners: Integers
    """Drawn vertex of each corner (D,); a vertex on borders of tiles has a corner in each of them."""
    corner_faces: Integers  # the same triangles (F, 3) as indices of `corners`
    coarse_faces: Integers
    """A quarter as many triangles (G, 3) of the same corners, within a few tenths of a millimeter."""
    uv: Floats  # texture coordinates (D, 2), the origin at the bottom left
    tiles: Integers  # drawn vertices (K, 5, 5) of each tile's grid
    size: tuple[int, int]  # width and height of the texture [texels]

    @property
    def num_hand(self) -> int:
        """Number of drawn vertices that are the hand's own."""
        return len(self.used)

    @property
    def num_vertices(self) -> int:
        """Number of drawn vertices."""
        return int(self.corners.max()) + 1


@functools.cache
def skin_atlas() -> Atlas:
    """The atlas, which all hands share; cached."""
    cage = load_cage()
    quads, count = cage.quads, len(cage.weights)
    coordinates = np.broadcast_to(
        np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (len(quads), 4, 2)
    )
    for _ in range(_SUBDIVISIONS):
        step, quads = catmull_clark(quads, count)
        count = step.shape[0]
        coordinates = _child_coordinates(coordinates)
    # The stump behind the wrist, which is a strip of the palm, and the faces that close it are left out.
    kept = ~np.isin(cage.quads, PALM_VERTICES[0]).any(axis=1)
    grids = _tile_grids(quads, coordinates, len(cage.quads))[kept]
    used = np.unique(grids)
    return _build_atlas(used, np.searchsorted(used, grids), np.searchsorted(used, cage.wrist_loop))


def _child_coordinates(coordinates: Doubles) -> Doubles:
    """Coordinates (4 Q, 4, 2) of the children's corners in their tiles, in the order of `catmull_clark`."""
    following, before = np.roll(coordinates, -1, axis=1), np.roll(coordinates, 1, axis=1)
    middle = np.broadcast_to(coordinates.mean(axis=1, keepdims=True), coordinates.shape)
    children = np.stack(
        [coordinates, (coordinates + following) / 2, middle, (coordinates + before) / 2], axis=2
    )
    return children.reshape(-1, 4, 2)


def _tile_grids(quads: Integers, coordinates: Doubles, count: int) -> Integers:
    """Vertices (K, 5, 5) of each cage face's grid: rows go along its second axis."""
    grids = np.zeros((count, _TILE_FACES + 1, _TILE_FACES + 1), dtype=np.int64)
    column, row = np.rint(coordinates * _TILE_FACES).astype(int).transpose(2, 0, 1)
    owner = np.repeat(np.arange(count), len(quads) // count)[:, None]
    grids[np.broadcast_to(owner, row.shape), row, column] = quads
    return grids


def ring_vertices(wrist: Integers, num_hand: int) -> Integers:
    """Drawn vertices (RINGS + 1, R + 1) of the wrist's ring and the forearm's, each closed by its first."""
    around = len(wrist)
    rings = np.concatenate([wrist[None], num_hand + np.arange(RINGS * around).reshape(RINGS, around)])
    return np.concatenate([rings, rings[:, :1]], axis=1)


def _build_atlas(used: Integers, tiles: Integers, wrist: Integers) -> Atlas:
    """The atlas of the hand's tiles (K, 5, 5) and of a forearm behind the wrist."""
    tile_rows = -(-len(tiles) // COLUMNS)
    width, height = COLUMNS * TILE, tile_rows * TILE + ARM_ROWS
    # Each node of a tile lies on the center of a texel, the outer nodes on those of the tile's border.
    step = np.linspace(0.5, TILE - 0.5, _TILE_FACES + 1)
    number = np.arange(len(tiles))
    across = (number % COLUMNS * TILE)[:, None, None] + step[None, None, :]
    up = (number // COLUMNS * TILE)[:, None, None] + step[None, :, None]
    across, up = np.broadcast_arrays(across, up)
    uv = [np.stack([across / width, 1.0 - up / height], axis=-1).reshape(-1, 2)]
    nodes = np.arange(tiles.size).reshape(tiles.shape)
    faces, coarse = [_triangles_of_grids(nodes)], [_triangles_of_grids(nodes[:, ::2, ::2])]
    corners = [tiles.ravel()]
    around, rings = len(wrist), ring_vertices(wrist, len(used))
    end = len(used) + RINGS * around
    node = tiles.size + np.arange(rings.size).reshape(rings.shape)
    # Rings run from the index side over the back, so rows go towards the wrist for faces to look outwards.
    faces.append(_triangles_of_grids(node[None, ::-1]))
    coarse.append(_triangles_of_grids(node[None, ::-2, ::2]))
    corners += [rings.ravel(), np.array([end])]
    middle = tiles.size + rings.size
    cap = np.stack([np.full(around, middle), node[-1, 1:], node[-1, :-1]], axis=1)
    faces.append(cap)
    u = np.linspace(0.5, width - 0.5, around + 1) / width
    v = 1.0 - (tile_rows * TILE + np.linspace(0.5, ARM_ROWS - 0.5, RINGS + 1)) / height
    uv.append(np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1).reshape(-1, 2))
    uv.append(np.array([[0.5, v[-1]]]))
    table, corner_faces = np.concatenate(corners), np.concatenate(faces)
    faces_of = table[corner_faces], table, corner_faces, np.concatenate(coarse)
    atlas = Atlas(used, wrist, *faces_of, np.concatenate(uv).astype(np.float32), tiles, (width, height))
    for array in atlas[:-1]:
        array.setflags(write=False)
    return atlas


def _triangles_of_grids(nodes: Integers) -> Integers:
    """Two triangles of each square of grids (K, R, C)."""
    a, b, c, d = nodes[:, :-1, :-1], nodes[:, :-1, 1:], nodes[:, 1:, 1:], nodes[:, 1:, :-1]
    first = np.stack([a, b, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, d], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second])


class _Hill(NamedTuple):
    """A smooth hill on the skin at rest."""

    joint: str | None  # joint whose angle raises the hill; None for a hill that is always there
    start: float  # angle without height [deg]
    full: float  # angle with full height [deg]
    heights: Doubles  # full height at each vertex (U,) along the normal [m]


class Flexion:
    """Shapes the skin of a hand by its joints, which raise hills and keep their thickness when bent."""

    def __init__(self, model: HandModel, rest: Doubles, normals: Doubles, bone_relief: float) -> None:
        hills = list(_hills(model, rest, normals))
        self._joints = np.array(
            [-1 if hill.joint is None else JOINT_NAMES.index(hill.joint) for hill in hills]
        )
        self._start = np.deg2rad([hill.start for hill in hills])
        self._full = np.deg2rad([hill.full for hill in hills])
        heights = bone_relief * np.stack([hill.heights for hill in hills], axis=1)
        self._rows = np.flatnonzero(np.abs(heights).max(axis=1) > 1e-6)
        self._heights, self._normals = heights[self._rows], normals[self._rows]
        self._bends = _bends(model, rest) if bone_relief else None

    def shaped(self, rest: Doubles, angles: Doubles) -> Doubles:
        """Vertices (U, 3) at rest with the hills of joint angles (20,) [m, rad]."""
        angle = np.where(self._joints < 0, self._full, angles[self._joints])
        share = smooth(angle, self._start, self._full)
        shaped: Doubles = rest.copy()
        shaped[self._rows] += (self._heights @ share)[:, None] * self._normals
        if self._bends is not None:
            sums, offsets, shares, joints = self._bends
            lengths = np.sqrt(1.0 - shares * (1.0 - np.cos(angles))[joints])
            shaped += sums @ (offsets * (1.0 / lengths - 1.0)[:, None])
        return shaped


def _bends(model: HandModel, rest: Doubles) -> tuple[sparse.csr_array, Doubles, Doubles, Integers]:
    """Offsets (K, 3) of vertices from a hinge that bends the skin there, their shares (K,) and joints (K,).

    Blending shrinks an offset to the root of 1 - share (1 - cosine of the angle). A matrix (U, K) adds what
    belongs to a vertex.
    """
    atlas, surface, frames = skin_atlas(), model.surface, model.rest_transforms
    weights = all_weights(surface.bone_indices, surface.bone_weights)[atlas.used]
    joint_of = {joint.bone: number for number, joint in enumerate(JOINTS)}  # a bone's last joint flexes it
    parts = []
    for bone in range(2, NUM_BONES):  # the thumb's first joint lies deep in the flesh
        shares = 2.0 * weights[:, bone] * weights[:, BONES[bone].parent]
        rows = np.flatnonzero(shares > _LEAST_BEND_SHARE)
        axes = frames[bone, :3, :3]
        offsets = (rest[rows] - frames[bone, :3, 3]) @ axes * [1.0, 0.0, 1.0] @ axes.T
        parts.append((rows, offsets, shares[rows], np.full(len(rows), joint_of[bone])))
    rows, offsets, shares, joints = (np.concatenate(part) for part in zip(*parts, strict=True))
    sums = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), (len(rest), len(rows)))
    return sums, offsets, shares, joints


def _hills(model: HandModel, rest: Doubles, normals: Doubles) -> Iterator[_Hill]:
    """Yield all hills of a hand, computed on a right hand."""
    mirror = MIRROR if model.shape.side == "left" else np.eye(3)
    frames = model.rest_transforms.copy()
    frames[:, :3, :3] = mirror @ frames[:, :3, :3] @ mirror
    frames[:, :3, 3] = frames[:, :3, 3] @ mirror
    scale = model.shape.radii[1:, 0].mean() / _REFERENCE_RADIUS
    skin = _RestingHand(rest @ mirror, normals @ mirror, frames, scale)
    for number, digit in enumerate(_FINGERS, 1):
        yield from _finger(skin, number, digit, model.shape.radii[number, 0] / _REFERENCE_RADIUS)
    for number in (1, 2, 3):  # hollows between the knuckles of a fist, down to where the fingers part
        first, second = 1 + 3 * number, 4 + 3 * number
        here = 0.5 * (frames[first, :2, 3] + frames[second, :2, 3])
        parted = here + 0.45 * (0.5 * (frames[first + 1, :2, 3] + frames[second + 1, :2, 3]) - here)
        along, aside = along_segment(skin.points[:, :2], here, parted)
        hollow = (0.0012 * along - 0.003) * bump(aside, scale * 0.0055) * smooth(skin.normals[:, 2], 0.0, 0.6)
        yield _Hill(f"{_FINGERS[number]}_MCP_flexion", 10.0, 75.0, scale * hollow)
    # The thumb's knuckles, its waist and pad, and the muscle between it and the index when they close.
    yield _Hill("thumb_MCP_flexion", 0.0, 55.0, skin.knob(2, 0.0022, 0.0070, 0.0068))
    yield _Hill("thumb_IP_flexion", 5.0, 70.0, skin.knob(3, 0.0020, 0.0060, 0.0065))
    middle = 0.5 * float(np.linalg.norm(frames[3, :3, 3] - frames[2, :3, 3]))
    yield _Hill(None, 0.0, 1.0, skin.girth(2, -0.0013, middle, 0.0085))
    yield _Hill(None, 0.0, 1.0, skin.girth(3, 0.0013, 0.0125 * scale, 0.0075))
    muscle = skin.ball((0.062, 0.026), 0.0030, 0.0130, back=True)
    yield _Hill("thumb_metacarpal_abduction", 15.0, -25.0, muscle)
    # The balls of thumb and little finger, and the hollow between them.
    for joint, start, full, center, height, width in (
        ("thumb_metacarpal_flexion", -10.0, 35.0, (0.040, 0.020), 0.0035, 0.0150),
        ("little_MCP_flexion", 10.0, 80.0, (0.035, -0.028), 0.0028, 0.0140),
        ("ring_MCP_flexion", 10.0, 80.0, (0.055, -0.004), -0.0025, 0.0120),
    ):
        yield _Hill(joint, start, full, skin.ball(center, height, width, back=False))
    # The head of the ulna, on the little finger's side of the wrist's back.
    yield _Hill(None, 0.0, 1.0, skin.ball((-0.016, -0.021), 0.0040, 0.0085, back=True))


class _RestingHand(NamedTuple):
    """A right hand at rest."""

    points: Doubles
    normals: Doubles
    frames: Doubles  # transforms of the bones (16, 4, 4)
    scale: float  # size of the hand over that of the reference

    def local(self, bone: int) -> tuple[Doubles, Doubles]:
        """Points (U, 3) in a bone's frame [m], and cosines (U,) of their normals with its back."""
        frame = self.frames[bone]
        return (self.points - frame[:3, 3]) @ frame[:3, :3], self.normals @ frame[:3, 2]

    def knob(
        self, bone: int, height: float, along: float, aside: float, *, at: tuple[float, float] = (0.0, 0.0)
    ) -> Doubles:
        """A hill on a bone's back at these x and y, with half widths along and across the bone [m]."""
        place, facing = self.local(bone)
        size = self.scale
        hill = bump(place[:, 0] - size * at[0], size * along) * bump(place[:, 1] - size * at[1], size * aside)
        hill *= smooth(facing, -0.1, 0.5) * (place[:, 2] > -0.004)
        return np.asarray(size * height * hill)

    def girth(self, bone: int, height: float, at: float, along: float) -> Doubles:
        """A hill around the thumb, except on its back, at a place along a bone, of this half width [m]."""
        place, facing = self.local(bone)
        near = np.linalg.norm(place[:, 1:], axis=1) < _THUMB_RADIUS * self.scale
        hill = near * bump(place[:, 0] - at, self.scale * along) * smooth(-facing, -0.8, -0.2)
        return np.asarray(self.scale * height * hill)

    def ball(self, center: tuple[float, float], height: float, width: float, *, back: bool) -> Doubles:
        """A hill on the back or the palm, around an x and y of the wrist's frame [m]."""
        size = self.scale
        distance = np.linalg.norm(self.points[:, :2] - size * np.array(center), axis=1)
        facing = self.normals[:, 2] if back else -self.normals[:, 2]
        return np.asarray(size * height * bump(distance, size * width) * smooth(facing, 0.0, 0.6))


def _finger(skin: _RestingHand, number: int, digit: str, wide: float) -> Iterator[_Hill]:
    """Yield hills of a finger's knuckles, tendon, neck and sides, and of the pads that bending pushes out."""
    first, size, bent = 1 + 3 * number, skin.scale, f"{digit}_MCP_flexion"
    middle = 0.5 * float(np.linalg.norm(skin.frames[first + 1, :3, 3] - skin.frames[first, :3, 3])) / size
    for bone, joint, start, full, height, long, broad, at in (
        (first, "MCP", 5.0, 75.0, 0.0018 * wide, 0.0090, 0.0075, (-0.001, 0.0)),
        (first, "MCP", 10.0, 85.0, -0.0014 * wide, 0.0090, 0.0085, (-0.021, 0.0)),  # neck
        (first + 1, "PIP", 5.0, 95.0, 0.0010, 0.0050, 0.0048, (-0.001, -0.0036)),  # a phalanx has two heads
        (first + 1, "PIP", 5.0, 95.0, 0.0010, 0.0050, 0.0048, (-0.001, 0.0036)),
        (first + 2, "DIP", 5.0, 75.0, 0.0012, 0.0042, 0.0050, (0.0, 0.0)),
    ):
        yield _Hill(f"{digit}_{joint}_flexion", start, full, skin.knob(bone, height, long, broad, at=at))
    knuckle = skin.frames[first, :2, 3]
    root = np.array([0.1, 0.35]) * knuckle  # tendons meet at the wrist
    along, aside = along_segment(skin.points[:, :2], root, knuckle)
    ridge = 0.0014 * smooth(along, 0.15, 0.75) * bump(aside, 0.0030) * smooth(skin.normals[:, 2], 0.2, 0.7)
    yield _Hill(bent, 15.0, -22.0, size * ridge)
    place, aside = skin.local(first)[0] / size, np.abs(skin.normals @ skin.frames[first, :3, 1])
    flesh = 0.0016 * wide * bump(place[:, 0] - 1.2 * middle, 0.9 * middle) * bump(place[:, 1], 0.0105)
    yield _Hill(bent, 20.0, 80.0, size * flesh * smooth(aside, 0.2, 0.8))  # neighbors touch in a fist
    for bone, joint, full in ((first, "PIP", 100.0), (first + 1, "DIP", 70.0)):
        place, facing = skin.local(bone)
        end = np.linalg.norm(skin.frames[bone + 1, :3, 3] - skin.frames[bone, :3, 3])
        pads = 0.0018 * bump(place[:, 0] - 0.5 * end, 0.009) - 0.0016 * bump(place[:, 0] - end, 0.0022)
        pads *= bump(place[:, 1], 0.007) * smooth(-facing, 0.1, 0.7) * (place[:, 2] < 0.004)
        yield _Hill(f"{digit}_{joint}_flexion", 20.0, full, size * pads)


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSkin:
    """One hand in one pose, with the vertices that textures and OpenGL need."""

    vertices: Float32[np.ndarray, "D 3"]
    """Positions in the world [m]; vertices on borders of texture tiles are repeated for each tile."""
    normals: Float32[np.ndarray, "D 3"]  # outward unit normals
    uv: Float32[np.ndarray, "D 2"]  # texture coordinates, the origin at the bottom left
    shade: Float32[np.ndarray, "D"]
    """Factor on ambient light: the share that the hand lets through, more where bones stretch the skin."""
    faces: Int[np.ndarray, "F 3"]  # triangles, counter-clockwise from outside
    parts: UInt8[np.ndarray, "F"]  # bone of each triangle, an index of `shape.BONES` or `FOREARM`
    coarse_faces: Int[np.ndarray, "G 3"]
    """Fewer triangles of the same vertices, nearly the same surface."""


class PosableSkin:
    """The drawn skin of one person's hand."""

    def __init__(self, model: HandModel, forearm: Forearm | None = None, bone_relief: float = 0.0) -> None:
        self.model = model
        self.forearm = Forearm() if forearm is None else forearm
        atlas, surface = skin_atlas(), model.surface
        hand = surface.vertices[atlas.used]
        arm = forearm_rings(model.shape, self.forearm, hand[atlas.wrist], RINGS)
        end = arm[-1].mean(axis=0, keepdims=True)
        self._elbow = ELBOW * model.shape.length  # distance from the first ring to the elbow [m]
        self.rest: Float[np.ndarray, "U 3"] = np.concatenate([hand, arm.reshape(-1, 3), end])
        """Rest positions in the wrist's frame [m]: the hand, the forearm's rings, the middle of its end."""
        beyond = len(self.rest) - len(hand)
        to_palm, whole = np.zeros((beyond, 4), dtype=np.int64), np.tile([1.0, 0.0, 0.0, 0.0], (beyond, 1))
        self._bones = np.concatenate([surface.bone_indices[atlas.used], to_palm + PALM])
        self._weights = np.concatenate([surface.bone_weights[atlas.used], whole])
        mirrored = model.shape.side == "left"
        self.faces = np.ascontiguousarray(atlas.faces[:, ::-1] if mirrored else atlas.faces)
        """Triangles (F, 3) of the vertices of `rest`: a closed surface."""
        self._corner_faces, self._coarse_faces = (
            np.ascontiguousarray(faces[:, ::-1] if mirrored else faces)
            for faces in (atlas.corner_faces, atlas.coarse_faces)
        )
        self._normals: Doubles = vertex_normals(self.rest, self.faces)
        self._flexion = Flexion(model, self.rest, self._normals, bone_relief)
        self._straight = self._flexion.shaped(self.rest, np.zeros(NUM_JOINTS))
        self._rest_occluded = self._rest_occlusion()
        middles = self._rings(self.rest).mean(axis=1)
        ahead = middles[-1] - middles[-2]
        self._ahead: Doubles = ahead / np.linalg.norm(ahead)  # direction of the forearm at rest
        beyond = self._elbow - np.linalg.norm(np.diff(middles, axis=0), axis=1).sum()
        self._elbow_at: Doubles = middles[-1] + beyond * self._ahead

    def forearm_line(self, qpos: Doubles) -> tuple[Doubles, Doubles]:
        """The elbow (3,) [m] of a wrist at rest, and the unit direction (3,) to it, in the world."""
        rotation = quaternion_matrix(qpos[3:7])
        return qpos[:3] + rotation @ self._elbow_at, rotation @ self._ahead

    def _rings(self, rest: Doubles) -> Doubles:
        """The arm's rings (K, R, 3)."""
        return rest[skin_atlas().num_hand : -1].reshape(RINGS, -1, 3)

    def flesh(self, qpos: Doubles) -> tuple[Doubles, Doubles]:
        """Axes (K, 2, 3) and radii (K,) of the flesh around this hand's bones in one pose [m]."""
        capsules = self.model.capsules
        return capsules.posed(self.model.forward_kinematics(qpos[None]))[0], capsules.radii * _FLESH_RATIO

    def posed(
        self,
        qpos: Doubles,
        upper_arm: Doubles | None = None,
        forearm: Doubles | None = None,
        others: Sequence[tuple[Doubles, Doubles]] = (),
    ) -> DrawnSkin:
        """Pose the skin, and shade it by the hand and by the `flesh` of `others`.

        Without the upper arm (3,) from the elbow [m] the arm is straight and short, and without the forearm's
        direction (3,) the wrist is at rest.
        """
        atlas = skin_atlas()
        transforms = self.model.forward_kinematics(qpos[None])
        shaped = self._flexion.shaped(self.rest, qpos[7:])
        raised = np.einsum("vi,vi->v", shaped - self._straight, self._normals)
        if upper_arm is not None:
            rings, rotation = self._rings(shaped), quaternion_matrix(qpos[3:7])
            if forearm is not None:
                half = 0.5 * BEND * self.model.shape.length
                rings = bent_rings(rings, half, half, forearm @ rotation)
            reach = float(np.linalg.norm(upper_arm))
            rings = bent_rings(rings, self._elbow, ELBOW_BEND, upper_arm @ rotation, reach)
            shaped = np.concatenate([shaped[: atlas.num_hand], rings.reshape(-1, 3), rings[-1:].mean(axis=1)])
        points = self.merged(transforms, shaped)
        normals = vertex_normals(points, self.faces)
        occluded = self._occluded(transforms, points, normals)
        shade = 1.0 - np.maximum(occluded - self._rest_occluded, 0.0)
        for axes, radii in others:
            shade *= 1.0 - _occluded_share(points, normals, axes, radii)
        shade = np.clip(shade, _LEAST_AMBIENT, 1.0)
        shade *= np.exp(_PALENESS * raised)
        corners = atlas.corners
        return DrawnSkin(
            points.astype(np.float32).take(corners, axis=0),
            normals.astype(np.float32).take(corners, axis=0),
            atlas.uv,
            shade.astype(np.float32).take(corners),
            self._corner_faces,
            face_parts(),
            self._coarse_faces,
        )

    def surface(self, qpos: Doubles) -> Doubles:
        """Vertices (U, 3) of `faces` in one pose [m], with a straight arm."""
        transforms = self.model.forward_kinematics(qpos[None])
        return self.merged(transforms, self._flexion.shaped(self.rest, qpos[7:]))

    def merged(self, transforms: Doubles, rest: Doubles) -> Doubles:
        """Vertices (U, 3) at rest in a pose of the bones' transforms (1, L, 4, 4) [m]."""
        moved = skin_frames(rest, self._bones, self._weights, self.model.rest_transforms, transforms)
        return np.asarray(moved[0])

    def _rest_occlusion(self) -> Floats:
        """Occlusion of the flat hand; of a digit, only by itself and the palm, not by its neighbors."""
        normals = self._normals
        occluded = self._occluded(self.model.rest_transforms[None], self.rest, normals)
        capsules = self.model.capsules
        segments = capsules.posed(self.model.rest_transforms[None])[0]
        of_digit = DIGIT_OF_BONE[self._bones]
        for digit in range(len(DIGITS)):
            share = (self._weights * (of_digit == digit)).sum(axis=1)
            own_vertices = np.flatnonzero(share > 0.0)
            near = np.isin(DIGIT_OF_BONE[capsules.bones], (digit, DIGIT_OF_BONE[PALM]))
            radii = capsules.radii[near] * _FLESH_RATIO
            own = _occluded_share(self.rest[own_vertices], normals[own_vertices], segments[near], radii)
            occluded[own_vertices] += share[own_vertices].astype(np.float32) * (own - occluded[own_vertices])
        return occluded

    def _occluded(self, transforms: Doubles, points: Doubles, normals: Doubles) -> Floats:
        """Share (U,) of each vertex's hemisphere that the hand's capsules hide."""
        capsules = self.model.capsules
        segments = capsules.posed(transforms)[0]
        return np.asarray(_occluded_share(points, normals, segments, capsules.radii * _FLESH_RATIO))


@functools.cache
def face_parts() -> UInt8[np.ndarray, "F"]:
    """Bone of each triangle of `DrawnSkin.faces`: the one with the largest weight in it, or `FOREARM`."""
    atlas, surface = skin_atlas(), HandModel.named("M").surface  # all hands have the same weights
    shares = np.zeros((atlas.num_vertices, NUM_BONES + 1))
    hand = all_weights(surface.bone_indices, surface.bone_weights)
    shares[: atlas.num_hand, :NUM_BONES] = hand[atlas.used]
    shares[atlas.num_hand :, FOREARM] = 1e3  # a triangle with one vertex of the forearm is the forearm's
    parts: Bytes = shares[atlas.faces].sum(axis=1).argmax(axis=1).astype(np.uint8)
    parts.setflags(write=False)
    return parts


@kernel
def _occluded_share(points: Doubles, normals: Doubles, segments: Doubles, radii: Doubles) -> Any:
    """Share (V,) of each point's hemisphere behind capsules, each replaced by its nearest ball.

    The inner loop has no branches and writes one array, so that it is compiled into vector instructions.
    """
    count = len(points)
    x, y, z = _columns(points)
    nx, ny, nz = _columns(normals)
    free = np.ones(count, np.float32)
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-20)
    for k in range(len(radii)):
        sx, sy, sz = (
            np.float32(segments[k, 0, 0]),
            np.float32(segments[k, 0, 1]),
            np.float32(segments[k, 0, 2]),
        )
        ax = np.float32(segments[k, 1, 0] - segments[k, 0, 0])
        ay = np.float32(segments[k, 1, 1] - segments[k, 0, 1])
        az = np.float32(segments[k, 1, 2] - segments[k, 0, 2])
        scale = one / (ax * ax + ay * ay + az * az + np.float32(1e-12))
        square = np.float32(radii[k] * radii[k])
        strength = np.float32(0.85) * square
        for v in range(count):
            px, py, pz = sx - x[v], sy - y[v], sz - z[v]
            along = -(px * ax + py * ay + pz * az) * scale
            along = along if along > zero else zero
            along = along if along < one else one
            px, py, pz = px + along * ax, py + along * ay, pz + along * az
            distance = px * px + py * py + pz * pz
            facing = px * nx[v] + py * ny[v] + pz * nz[v]
            facing = facing if facing > zero else zero
            cosine = facing / np.sqrt(distance + tiny)
            cosine = cosine if cosine < one else one
            free[v] *= one - strength / (distance if distance > square else square) * cosine
    return one - free


@kernel
def _columns(points: Doubles) -> Any:
    """The columns of an array (V, 3)."""
    return (points[:, 0].astype(np.float32), points[:, 1].astype(np.float32), points[:, 2].astype(np.float32))
