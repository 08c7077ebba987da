"""The drawn skin: the hand's surface on a forearm, shaped by its joints, with texture coordinates.

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
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from handsim.hand.model import HandModel
from handsim.hand.shape import BONES, DIGITS, JOINT_NAMES, NUM_BONES, PALM
from handsim.hand.skin import (
    WRIST,
    cage_topology,
    catmull_clark,
    skin_frames,
    subdivided_loops,
    vertex_normals,
)
from handsim.kernels import kernel
from handsim.space.transforms import MIRROR, quaternion_matrix
from render.fields import along_segment, bump, smooth
from render.frames import FOREARM, Bytes, Doubles, Floats, Integers
from render.skin.look import ELBOW, Forearm, bent_rings, forearm_rings

TILE: Final = 16
"""Texels along a tile's side."""
COLUMNS: Final = 20
ARM_ROWS: Final = 48
"""Texels along the forearm."""
RINGS: Final = 20
"""Rings of the forearm beyond the wrist's."""
_LEVELS: Final = 2
_SIDE: Final = 2**_LEVELS  # faces of the skin along a tile


class Atlas(NamedTuple):
    """Numbers only; vertices are `HandSurface`'s, then the forearm's rings, then the end's middle."""

    used: Integers  # vertices (U,) of the base surface that are drawn: those from the wrist's ring on
    wrist: Integers
    """The wrist's ring (R,), indices of the drawn vertices, from the index side over the back."""
    faces: Integers
    """Triangles (F, 3) of the drawn vertices, closed, counter-clockwise from outside on a right hand."""
    corners: Integers
    """Drawn vertex of each corner (D,): a vertex on tiles' borders has one for each tile."""
    corner_faces: Integers  # the same triangles (F, 3) as indices of `corners`
    coarse_faces: Integers
    """A quarter as many triangles (G, 3) of the same corners: the surface to a few tenths of a millimeter."""
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
    """The atlas; cached."""
    topology = cage_topology()
    quads, count = topology.quads, topology.num_vertices
    loop = topology.palm[WRIST]
    coordinates = np.broadcast_to(
        np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (len(quads), 4, 2)
    )
    for _ in range(_LEVELS):
        (loop,) = subdivided_loops([loop], quads, count)
        step, quads = catmull_clark(quads, count)
        count = step.shape[0]
        coordinates = _child_coordinates(coordinates)
    # The stump behind the wrist goes: its strip of the palm and the faces that close it.
    behind = np.isin(topology.quads, topology.palm[:WRIST]).any(axis=1)
    kept = np.flatnonzero(~behind)
    grids = _grids(quads, coordinates, len(topology.quads))[kept]
    used = np.unique(grids)
    tiles = np.searchsorted(used, grids)
    wrist = np.searchsorted(used, loop)
    return _assemble(used, tiles, wrist)


def _child_coordinates(coordinates: Doubles) -> Doubles:
    """Coordinates (4 Q, 4, 2) in their tile of the four children's corners, in `catmull_clark`'s order."""
    following, before = np.roll(coordinates, -1, axis=1), np.roll(coordinates, 1, axis=1)
    middle = np.broadcast_to(coordinates.mean(axis=1, keepdims=True), coordinates.shape)
    children = np.stack(
        [coordinates, (coordinates + following) / 2, middle, (coordinates + before) / 2], axis=2
    )
    return children.reshape(-1, 4, 2)


def _grids(quads: Integers, coordinates: Doubles, count: int) -> Integers:
    """Vertices (K, 5, 5) of each cage face's grid: rows go along its second axis."""
    grids = np.zeros((count, _SIDE + 1, _SIDE + 1), dtype=np.int64)
    column, row = np.rint(coordinates * _SIDE).astype(int).transpose(2, 0, 1)
    owner = np.repeat(np.arange(count), len(quads) // count)[:, None]
    grids[np.broadcast_to(owner, row.shape), row, column] = quads
    return grids


def _assemble(used: Integers, tiles: Integers, wrist: Integers) -> Atlas:
    tile_rows = -(-len(tiles) // COLUMNS)
    width, height = COLUMNS * TILE, tile_rows * TILE + ARM_ROWS
    # The hand's tiles: node (row, column) of a tile stands on the center of a texel of its border or inside.
    step = np.linspace(0.5, TILE - 0.5, _SIDE + 1)
    number = np.arange(len(tiles))
    across = (number % COLUMNS * TILE)[:, None, None] + step[None, None, :]
    up = (number // COLUMNS * TILE)[:, None, None] + step[None, :, None]
    across, up = np.broadcast_arrays(across, up)
    uv = [np.stack([across / width, 1.0 - up / height], axis=-1).reshape(-1, 2)]
    nodes = np.arange(tiles.size).reshape(tiles.shape)
    faces, coarse = [_squares(nodes)], [_squares(nodes[:, ::2, ::2])]
    corners = [tiles.ravel()]
    # The forearm: a grid of rings, its first column once more at the end.
    around, first = len(wrist), len(used)
    rings = np.concatenate([wrist[None], first + np.arange(RINGS * around).reshape(RINGS, around)])
    end = first + RINGS * around
    rings = np.concatenate([rings, rings[:, :1]], axis=1)
    node = tiles.size + np.arange(rings.size).reshape(rings.shape)
    # Rings come in the palm's order, index side over the back: outwards is from a ring to the wrist.
    faces.append(_squares(node[None, ::-1]))
    coarse.append(_squares(node[None, ::-2, ::2]))
    corners += [rings.ravel(), np.array([end])]
    middle = tiles.size + rings.size
    cap = np.stack([np.full(around, middle), node[-1, 1:], node[-1, :-1]], axis=1)
    faces.append(cap)
    u = np.linspace(0.5, width - 0.5, around + 1) / width
    v = 1.0 - (tile_rows * TILE + np.linspace(0.5, ARM_ROWS - 0.5, RINGS + 1)) / height
    uv.append(np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1).reshape(-1, 2))
    uv.append(np.array([[0.5, v[-1]]]))
    table, corner_faces = np.concatenate(corners), np.concatenate(faces)
    atlas = Atlas(
        used,
        wrist,
        table[corner_faces],
        table,
        corner_faces,
        np.concatenate(coarse),
        np.concatenate(uv).astype(np.float32),
        tiles,
        (width, height),
    )
    for array in atlas[:-1]:
        array.setflags(write=False)
    return atlas


def _squares(nodes: Integers) -> Integers:
    """Two triangles of each square of grids (K, R, C)."""
    a, b, c, d = nodes[:, :-1, :-1], nodes[:, :-1, 1:], nodes[:, 1:, 1:], nodes[:, 1:, :-1]
    first = np.stack([a, b, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, d], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second])


_REFERENCE: Final = 0.0118  # radius of an average finger at its knuckle, for which the lengths below are [m]
_NEAR: Final = 0.018  # [m] from a thumb's axis that only its own skin is
_FINGERS: Final = ("index", "middle", "ring", "little")


class _Hill(NamedTuple):
    """A shape of the skin."""

    joint: int  # whose angle decides the height; -1 for a shape that is always there
    start: float  # angle without height [deg]
    full: float  # angle with full height [deg]
    heights: Doubles  # full height at each vertex (U,) along the normal [m]


class Flexion:
    """The shapes of one hand."""

    def __init__(self, model: HandModel, rest: Doubles, normals: Doubles, bony: float) -> None:
        hills = list(_hills(model, rest, normals))
        self._joints = np.array([hill.joint for hill in hills])
        self._start = np.deg2rad([hill.start for hill in hills])
        self._full = np.deg2rad([hill.full for hill in hills])
        heights = bony * np.stack([hill.heights for hill in hills], axis=1)
        self._rows = np.flatnonzero(np.abs(heights).max(axis=1) > 1e-6)
        self._heights, self._normals = heights[self._rows], normals[self._rows]

    def shaped(
        self, rest: Float[np.ndarray, "U 3"], angles: Float[np.ndarray, "20"]
    ) -> Float[np.ndarray, "U 3"]:
        """Vertices at rest as the angles [rad] shape them [m]."""
        angle = np.where(self._joints < 0, self._full, angles[self._joints])
        share = smooth(angle, self._start, self._full)
        shaped: Doubles = rest.copy()
        shaped[self._rows] += (self._heights @ share)[:, None] * self._normals
        return shaped


def _hills(model: HandModel, rest: Doubles, normals: Doubles) -> Iterator[_Hill]:
    """All shapes, on the right hand that the hand is a mirror image of."""
    mirror = MIRROR if model.shape.side == "left" else np.eye(3)
    points, outward = rest @ mirror, normals @ mirror
    frames = model.rest_transforms.copy()
    frames[:, :3, :3] = mirror @ frames[:, :3, :3] @ mirror
    frames[:, :3, 3] = frames[:, :3, 3] @ mirror
    skin = _Skin(points, outward, frames, model.shape.radii[1:, 0].mean() / _REFERENCE)
    for number, digit in enumerate(_FINGERS, 1):
        yield from _finger(skin, number, digit, model.shape.radii[number, 0] / _REFERENCE)
    yield from _valleys(skin)
    yield from _thumb(skin)
    yield from _palm(skin)
    yield from _ulna(skin)


class _Skin(NamedTuple):
    """A right hand at rest."""

    points: Doubles
    normals: Doubles
    frames: Doubles  # transforms of the bones (16, 4, 4)
    scale: float  # of the hand against the reference

    def local(self, bone: int) -> tuple[Doubles, Doubles]:
        """Points (U, 3) [m] in a bone's frame, and how far they face its back, -1 to 1 (U,)."""
        frame = self.frames[bone]
        return (self.points - frame[:3, 3]) @ frame[:3, :3], self.normals @ frame[:3, 2]

    def knob(
        self, bone: int, height: float, along: float, aside: float, *, at: tuple[float, float] = (0.0, 0.0)
    ) -> Doubles:
        """A hill on the back of a bone, `at` its x and y; `along` and `aside` are its half widths [m]."""
        place, facing = self.local(bone)
        size = self.scale
        hill = bump(place[:, 0] - size * at[0], size * along) * bump(place[:, 1] - size * at[1], size * aside)
        hill *= smooth(facing, -0.1, 0.5) * (place[:, 2] > -0.004)
        return np.asarray(size * height * hill)

    def girth(self, bone: int, height: float, at: float, along: float) -> Doubles:
        """A hill around the thumb but for its back, `at` a place along a bone, of this half width [m]."""
        place, facing = self.local(bone)
        near = np.linalg.norm(place[:, 1:], axis=1) < _NEAR * self.scale
        hill = near * bump(place[:, 0] - at, self.scale * along) * smooth(-facing, -0.8, -0.2)
        return np.asarray(self.scale * height * hill)

    def ball(self, center: tuple[float, float], height: float, width: float, *, back: bool) -> Doubles:
        """A hill on the back or the palm, around a place of the wrist's frame [m]."""
        size = self.scale
        distance = np.linalg.norm(self.points[:, :2] - size * np.array(center), axis=1)
        facing = self.normals[:, 2] if back else -self.normals[:, 2]
        return np.asarray(size * height * bump(distance, size * width) * smooth(facing, 0.0, 0.6))


def _joint(name: str) -> int:
    return JOINT_NAMES.index(name)


def _finger(skin: _Skin, number: int, digit: str, wide: float) -> Iterator[_Hill]:
    """Three knuckles of a finger, its tendon, and the pad that its bending pushes out."""
    first = 1 + 3 * number
    bent, straight = _joint(f"{digit}_MCP_flexion"), (15.0, -22.0)
    yield _Hill(bent, 5.0, 85.0, skin.knob(first, 0.0042 * wide, 0.0075, 0.0062, at=(-0.001, 0.0)))
    yield _Hill(_joint(f"{digit}_PIP_flexion"), 5.0, 95.0, skin.knob(first + 1, 0.0019, 0.0058, 0.0056))
    yield _Hill(_joint(f"{digit}_DIP_flexion"), 5.0, 75.0, skin.knob(first + 2, 0.0012, 0.0042, 0.0050))
    knuckle = skin.frames[first, :2, 3]
    root = np.array([0.1, 0.35]) * knuckle  # tendons meet at the wrist
    along, aside = along_segment(skin.points[:, :2], root, knuckle)
    ridge = 0.0014 * smooth(along, 0.15, 0.75) * bump(aside, 0.0030) * smooth(skin.normals[:, 2], 0.2, 0.7)
    yield _Hill(bent, *straight, skin.scale * ridge)
    place, facing = skin.local(first)
    middle = 0.5 * np.linalg.norm(skin.frames[first + 1, :3, 3] - skin.frames[first, :3, 3])
    shaft = skin.knob(first, -0.0018 * wide, 0.0095, 0.0075, at=(float(middle) / skin.scale, 0.0))
    yield _Hill(bent, 10.0, 85.0, shaft)
    neck = skin.knob(first, -0.0014 * wide, 0.0090, 0.0085, at=(-0.021, 0.0))
    yield _Hill(bent, 10.0, 85.0, neck)
    pad = 0.0018 * bump(place[:, 0] - middle, 0.009) * bump(place[:, 1], 0.007) * smooth(-facing, 0.1, 0.7)
    yield _Hill(_joint(f"{digit}_PIP_flexion"), 20.0, 100.0, skin.scale * pad * (place[:, 2] < 0.004))


def _valleys(skin: _Skin) -> Iterator[_Hill]:
    """Hollows between the knuckles of a fist, down to where the fingers part."""
    for number in (1, 2, 3):
        first, second = 1 + 3 * number, 4 + 3 * number
        here = 0.5 * (skin.frames[first, :2, 3] + skin.frames[second, :2, 3])
        parted = here + 0.45 * (0.5 * (skin.frames[first + 1, :2, 3] + skin.frames[second + 1, :2, 3]) - here)
        along, aside = along_segment(skin.points[:, :2], here, parted)
        hollow = -0.0042 * bump(aside, skin.scale * 0.0048) * smooth(skin.normals[:, 2], 0.0, 0.6)
        hollow *= 1.0 - 0.4 * along
        yield _Hill(_joint(f"{_FINGERS[number]}_MCP_flexion"), 10.0, 85.0, skin.scale * hollow)


def _thumb(skin: _Skin) -> Iterator[_Hill]:
    """Its knuckles, its waist and pad, and the muscle that lies between it and the index when they close."""
    yield _Hill(_joint("thumb_MCP_flexion"), 0.0, 55.0, skin.knob(2, 0.0022, 0.0070, 0.0068))
    yield _Hill(_joint("thumb_IP_flexion"), 5.0, 70.0, skin.knob(3, 0.0020, 0.0060, 0.0065))
    middle = 0.5 * float(np.linalg.norm(skin.frames[3, :3, 3] - skin.frames[2, :3, 3]))
    yield _Hill(-1, 0.0, 1.0, skin.girth(2, -0.0013, middle, 0.0085))
    yield _Hill(-1, 0.0, 1.0, skin.girth(3, 0.0013, 0.0125 * skin.scale, 0.0075))
    muscle = skin.ball((0.062, 0.026), 0.0030, 0.0130, back=True)
    yield _Hill(_joint("thumb_CMC_abduction"), 15.0, -25.0, muscle)


def _palm(skin: _Skin) -> Iterator[_Hill]:
    """The balls of thumb and little finger, and the hollow between them."""
    for name, start, full, center, height, width in (
        ("thumb_CMC_flexion", -10.0, 35.0, (0.040, 0.020), 0.0035, 0.0150),
        ("little_MCP_flexion", 10.0, 80.0, (0.035, -0.028), 0.0028, 0.0140),
        ("ring_MCP_flexion", 10.0, 80.0, (0.055, -0.004), -0.0025, 0.0120),
    ):
        yield _Hill(_joint(name), start, full, skin.ball(center, height, width, back=False))


def _ulna(skin: _Skin) -> Iterator[_Hill]:
    """Its head, on the little finger's side of the wrist's back."""
    yield _Hill(-1, 0.0, 1.0, skin.ball((-0.016, -0.021), 0.0040, 0.0085, back=True))


_FLESH: Final = 1.2  # radius of the flesh around a capsule over the capsule's
_DARKEST: Final = 0.12  # even the deepest folds receive some light


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSkin:
    """One hand in one pose, with the vertices that OpenGL needs."""

    vertices: Float32[np.ndarray, "D 3"]
    """In the world [m]; vertices on borders of texture tiles are repeated for each tile."""
    normals: Float32[np.ndarray, "D 3"]  # outward unit normals
    uv: Float32[np.ndarray, "D 2"]  # texture coordinates, the origin at the bottom left
    shade: Float32[np.ndarray, "D"]
    """Share of the ambient light that the hand itself does not block, 0 to 1."""
    faces: Int[np.ndarray, "F 3"]  # triangles, counter-clockwise from outside
    parts: UInt8[np.ndarray, "F"]  # bone of each triangle, an index of `topology.BONES` or `FOREARM`
    coarse_faces: Int[np.ndarray, "G 3"]
    """Fewer triangles of the same vertices, nearly the same surface."""


class PosableSkin:
    """The drawn skin of one person's hand."""

    def __init__(self, model: HandModel, forearm: Forearm | None = None, bony: float = 0.0) -> None:
        self.model = model
        self.forearm = Forearm() if forearm is None else forearm
        atlas, surface = skin_atlas(), model.surface
        hand = surface.vertices[atlas.used]
        arm = forearm_rings(model.shape, self.forearm, hand[atlas.wrist], RINGS)
        end = arm[-1].mean(axis=0, keepdims=True)
        self._elbow = ELBOW * model.shape.length  # behind the first ring, nearly the wrist
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
        self._flexion = Flexion(model, self.rest, vertex_normals(self.rest, self.faces), bony)
        self._rest_occluded = self._rest_occlusion()

    def forearm_line(
        self, qpos: Float[np.ndarray, "27"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """The elbow [m], and the unit direction to it from the wrist, in the world."""
        middles = self._rings(self.rest).mean(axis=1)
        ahead = middles[-1] - middles[-2]
        ahead /= np.linalg.norm(ahead)
        elbow = middles[-1] + (self._elbow - np.linalg.norm(np.diff(middles, axis=0), axis=1).sum()) * ahead
        rotation = quaternion_matrix(qpos[3:7])
        return qpos[:3] + rotation @ elbow, rotation @ ahead

    def _rings(self, rest: Doubles) -> Doubles:
        """The arm's rings (K, R, 3)."""
        return rest[skin_atlas().num_hand : -1].reshape(RINGS, -1, 3)

    def posed(
        self, qpos: Float[np.ndarray, "27"], upper_arm: Float[np.ndarray, "3"] | None = None
    ) -> DrawnSkin:
        """The skin in one pose; the arm is straight and short without an upper arm's direction."""
        atlas = skin_atlas()
        transforms = self.model.forward_kinematics(qpos[None])
        shaped = self._flexion.shaped(self.rest, qpos[7:])
        if upper_arm is not None:
            rings = bent_rings(self._rings(shaped), self._elbow, upper_arm @ quaternion_matrix(qpos[3:7]))
            shaped = np.concatenate([shaped[: atlas.num_hand], rings.reshape(-1, 3), rings[-1:].mean(axis=1)])
        points = self.merged(transforms, shaped)
        normals = vertex_normals(points, self.faces)
        occluded = self._occluded(transforms, points, normals)
        shade = np.clip(1.0 - np.maximum(occluded - self._rest_occluded, 0.0), _DARKEST, 1.0)
        corners = atlas.corners
        return DrawnSkin(
            points[corners].astype(np.float32),
            normals[corners].astype(np.float32),
            atlas.uv,
            shade[corners].astype(np.float32),
            self._corner_faces,
            face_parts(),
            self._coarse_faces,
        )

    def merged(
        self, transforms: Float[np.ndarray, "1 L 4 4"], rest: Float[np.ndarray, "U 3"] | None = None
    ) -> Float[np.ndarray, "U 3"]:
        """Posed vertices of `rest`, or of its changed form, in the frame of the bones' transforms [m]."""
        still = self.rest if rest is None else rest
        points: Doubles = skin_frames(
            still, self._bones, self._weights, self.model.rest_transforms, transforms
        )[0]
        return points

    def _rest_occlusion(self) -> Floats:
        """Occlusion in the flat hand by capsules of the same flesh: a digit's other neighbors do shade it."""
        normals = vertex_normals(self.rest, self.faces)
        occluded = self._occluded(self.model.rest_transforms[None], self.rest, normals)
        capsules, digits = self.model.capsules, np.array([bone.digit for bone in BONES])
        segments = capsules.posed(self.model.rest_transforms[None])[0]
        of_digit = digits[self._bones]
        for digit in range(len(DIGITS)):
            share = (self._weights * (of_digit == digit)).sum(axis=1)
            mine = np.flatnonzero(share > 0.0)
            near = np.isin(digits[capsules.bones], (digit, digits[PALM]))
            own = _occluded_share(
                self.rest[mine], normals[mine], segments[near], capsules.radii[near] * _FLESH
            )
            occluded[mine] += share[mine].astype(np.float32) * (own - occluded[mine])
        return occluded

    def _occluded(self, transforms: Doubles, points: Doubles, normals: Doubles) -> Floats:
        capsules = self.model.capsules
        occluded: Floats = _occluded_share(
            points, normals, capsules.posed(transforms)[0], capsules.radii * _FLESH
        )
        return occluded


@functools.cache
def face_parts() -> UInt8[np.ndarray, "F"]:
    """Bone of each triangle of `DrawnSkin.faces`: the one with the largest share in it, or `FOREARM`."""
    atlas, surface = skin_atlas(), HandModel.named("M").surface  # weights are the same for every hand
    shares = np.zeros((atlas.num_vertices, NUM_BONES + 1))
    rows = np.arange(atlas.num_hand)[:, None]
    shares[rows, surface.bone_indices[atlas.used]] = surface.bone_weights[atlas.used]
    shares[atlas.num_hand :, FOREARM] = 1e3  # one vertex of the forearm makes a triangle the forearm's
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
