"""The anatomy at each texel: position, normal, side of the hand and digit, on one reference hand.

It is computed once per process, on a right hand of size M with its fingers straight.
"""

from __future__ import annotations

import functools
import itertools
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from handsim.hand.model import HandModel
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import DIGITS, NUM_BONES
from handsim.kernels import kernel
from render.skin.atlas import ARM_ROWS, COLUMNS, RINGS, TILE, skin_atlas
from render.skin.fields import bump, smooth
from render.skin.forearm import Forearm, arm_places
from render.skin.mesh import PosableSkin

REFERENCE: Final = Forearm(length=0.5)
"""The forearm whose texels are painted; a longer one is stretched."""
# The palm's three lines on the reference hand [mm], (x, y) of the wrist's frame: heart, head, life.
_PALM_LINES: Final = (
    ((66.0, -37.0), (73.0, -27.0), (78.0, -14.0), (83.0, 0.0), (91.0, 12.0)),
    ((72.0, 31.0), (71.0, 20.0), (65.0, 5.0), (56.0, -10.0), (46.0, -24.0)),
    ((71.0, 31.0), (66.0, 18.0), (54.0, 8.0), (38.0, 2.0), (20.0, 1.0), (8.0, 5.0)),
)
_WRIST_LINES: Final = (-0.001, -0.009)  # across the palm's side of the wrist [m]


class DigitTexels(NamedTuple):
    """The texels (K,) of one digit."""

    texels: NDArray[np.int64]
    """Indices (K,) of the texture's N texels."""
    along: NDArray[np.float64]
    """Distance from the digit's first joint [m]."""
    angle: NDArray[np.float64]
    """Angle about the digit from the middle of its back [rad], positive towards the thumb's side."""
    share: NDArray[np.float64]
    """Share of the skin that moves with the digit."""
    lengths: NDArray[np.float64]
    """Lengths of the three bones [m]."""
    radius: float
    """Of the skin behind the tip [m]."""


class Texels(NamedTuple):
    """All N = width x height texels, row by row from the texture's top; unused ones repeat a used one."""

    positions: NDArray[np.float64]
    """On the reference hand's skin, in the wrist's frame [m] (N, 3)."""
    normals: NDArray[np.float64]
    """Outward unit normals (N, 3)."""
    dorsal: NDArray[np.float64]
    """From -1 in the middle of the palm or of a finger's pad to 1 on the back (N,)."""
    back: NDArray[np.float64]
    """1 on the back of the hand, 0 on the palm, smooth between (N,)."""
    facing: NDArray[np.float64]
    """From -1 to 1 likewise, before that: how far the skin faces the way of the back (N,)."""
    palm: NDArray[np.float64]
    """Share of the skin that moves with the palm and no digit (N,)."""
    digits: tuple[DigitTexels, ...]


@functools.cache
def skin_texels() -> Texels:
    """The texels; cached."""
    model, atlas = HandModel.named("M"), skin_atlas()
    mesh = PosableSkin(model, REFERENCE)
    normals = vertex_normals(mesh.rest, mesh.faces)
    weights = np.zeros((atlas.num_vertices, NUM_BONES))
    surface = model.surface
    rows = np.arange(atlas.num_hand)[:, None]
    weights[rows, surface.bone_indices[atlas.used]] = surface.bone_weights[atlas.used]
    weights[atlas.num_hand :, 0] = 1.0
    backs = model.rest_transforms[:, :3, 2]
    dorsal = np.einsum("vi,vi->v", normals, weights @ backs)
    # The thumb's metacarpal is flesh of the palm: its skin is colored as the palm's
    values = np.concatenate([mesh.rest, normals, dorsal[:, None], weights], axis=1)
    grid = _spread(values)
    positions, normals, dorsal, weights = grid[:, :3], grid[:, 3:6], grid[:, 6], grid[:, 7:]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    digits = tuple(_digit_texels(model, digit, positions, weights) for digit in range(len(DIGITS)))
    # The thumb's back faces sideways, but the part of it on the hand's back does not have the palm's skin.
    facing = np.maximum(dorsal, normals[:, 2])
    return Texels(positions, normals, dorsal, smooth(facing, -0.25, 0.35), facing, weights[:, 0], digits)


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (U, C) of the drawn vertices at every texel (N, C), interpolated linearly."""
    atlas = skin_atlas()
    width, height = atlas.size
    nodes = atlas.tiles.shape[1]
    across = _between(nodes, TILE)
    tiles = np.einsum("ri,cj,kijn->krcn", across, across, values[atlas.tiles], optimize=True)
    rows = -(-len(tiles) // COLUMNS)
    filler = np.repeat(tiles[-1:], rows * COLUMNS - len(tiles), axis=0)
    tiles = np.concatenate([tiles, filler]).reshape(rows, COLUMNS, TILE, TILE, -1)
    hand = tiles.swapaxes(1, 2).reshape(rows * TILE, width, -1)
    around = len(atlas.wrist)
    first = atlas.num_hand
    rings = np.concatenate([atlas.wrist[None], first + np.arange(RINGS * around).reshape(RINGS, around)])
    rings = np.concatenate([rings, rings[:, :1]], axis=1)
    along, about = _between(RINGS + 1, ARM_ROWS), _between(around + 1, width)
    arm = np.einsum("ri,cj,ijn->rcn", along, about, values[rings], optimize=True)
    return np.concatenate([hand, arm]).reshape(width * height, -1)


def _between(nodes: int, texels: int) -> NDArray[np.float64]:
    """Matrix (texels, nodes) of linear interpolation between nodes, the outer texels on the outer nodes."""
    position = np.linspace(0.0, nodes - 1.0, texels)
    low = np.minimum(position.astype(int), nodes - 2)
    matrix = np.zeros((texels, nodes))
    matrix[np.arange(texels), low] = 1.0 - (position - low)
    matrix[np.arange(texels), low + 1] = position - low
    return matrix


def _digit_texels(
    model: HandModel, digit: int, positions: NDArray[np.float64], weights: NDArray[np.float64]
) -> DigitTexels:
    first = 1 + 3 * digit
    share = weights[:, first : first + 3].sum(axis=1)
    texels = np.flatnonzero(share > 0.02)
    frame = model.rest_transforms[first]
    local = (positions[texels] - frame[:3, 3]) @ frame[:3, :3]
    angle = np.arctan2(local[:, 1], local[:, 2])
    lengths = model.shape.bone_lengths[digit]
    return DigitTexels(texels, local[:, 0], angle, share[texels], lengths, float(model.shape.radii[digit, 3]))


def behind_wrist(forearm: Forearm) -> NDArray[np.float64]:
    """How far behind the wrist each texel (N,) is along this forearm [m]; negative on the hand."""
    width, _ = skin_atlas().size
    behind = -skin_texels().positions[:, 0]
    along = _between(RINGS + 1, ARM_ROWS) @ arm_places(forearm, RINGS)
    behind[-ARM_ROWS * width :] = np.repeat(along, width)
    return behind


@functools.cache
def _palm_distances() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Texels of the palm (K,), and the distance of each palm line from them (3, K) [m]."""
    texels = skin_texels()
    near = np.flatnonzero((texels.dorsal < 0.1) & (texels.positions[:, 0] > -0.02))
    points = texels.positions[near, :2]
    distances = np.full((len(_PALM_LINES), len(near)), np.inf)
    for number, line in enumerate(_PALM_LINES):
        knots = 1e-3 * np.array(line)
        fine = np.linspace(0.0, len(knots) - 1.0, 10 * len(knots))
        knots = np.stack([np.interp(fine, np.arange(len(knots)), knots[:, i]) for i in range(2)], axis=1)
        knots = ndimage.gaussian_filter1d(knots, 4.0, axis=0, mode="nearest")
        for a, b in itertools.pairwise(knots):
            along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
            distances[number] = np.minimum(
                distances[number], np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)
            )
    return near, distances


def line_depth(rng: np.random.Generator) -> NDArray[np.float32]:
    """Depth of each texel (N,) in a palm line, finger crease or knuckle wrinkle; 1 for a deep line."""
    near, palm_lines, depth = _lines_of_all()
    depth = depth.copy()
    for line in palm_lines:
        depth[near] = np.maximum(depth[near], np.float32(rng.uniform(1.0, 1.5)) * line)
    for number, digit in enumerate(_digit_lines()):
        joints = digit.joints
        waves = digit.wave(rng.uniform(0.0, 6.0))
        # Palmar creases lie off the joints: Bugbee and Botte 1993, Clin. Orthop. Relat. Res. 296:122.
        creases = [(joints[0] - 0.0025, 1.0), (joints[0] + 0.0004, 0.5)]
        if number:
            creases += [(joints[1] - 0.0075, 0.9), (0.017, 0.9)]
        for position, strength in creases:
            _draw_line(digit.along, waves, digit.pad, position, 0.0009, strength, digit.texels, depth)
        for joint, count, spacing in ((joints[0], 5, 0.0020), (joints[1], 4, 0.0014)):
            places = np.arange(count) - (count - 1) / 2
            positions = joint + spacing * places + rng.normal(0.0, 0.0003, count)
            for place, position in zip(places, positions, strict=True):
                bow = digit.arch * np.float32(place / count * 2.0)  # wrinkles are curved
                _draw_line(digit.along, bow, digit.back, position, 0.0006, 0.4, digit.texels, depth)
    return depth


@kernel
def _draw_line(
    along: NDArray[np.float32],
    bent: NDArray[np.float32],
    share: NDArray[np.float32],
    position: float,
    width: float,
    strength: float,
    texels: NDArray[np.int64],
    depth: NDArray[np.float32],
) -> None:
    """Draw a line of this width [m] and depth across a digit.

    `along` are the distances of its K texels from its first joint, `bent` how far the line is from its
    position there [m], `share` factors on its depth; `depth` is that of all texels.
    """
    for n in range(len(texels)):
        away = (along[n] - position - bent[n]) / width
        if abs(away) < 3.0:
            here = np.float32(strength * share[n] * np.exp(-away * away))
            depth[texels[n]] = max(depth[texels[n]], here)


class _DigitLines(NamedTuple):
    """The texels (K,) of a digit and where on it lines are drawn."""

    texels: NDArray[np.int64]
    along: NDArray[np.float32]
    """Distance from its first joint [m]."""
    sine: NDArray[np.float32]
    cosine: NDArray[np.float32]
    """Of three times the angle about it."""
    arch: NDArray[np.float32]
    """How far wrinkles bow [m]."""
    pad: NDArray[np.float32]
    """Share of creases on the palm's side."""
    back: NDArray[np.float32]
    """Share of wrinkles on its back."""
    joints: NDArray[np.float64]
    """Distance of its two other joints [m]."""

    def wave(self, phase: float) -> NDArray[np.float32]:
        """How far a crease waves from its position (K,) [m]."""
        wave: NDArray[np.float32] = np.float32(0.0006 * np.cos(phase)) * self.sine
        wave += np.float32(0.0006 * np.sin(phase)) * self.cosine
        return wave


@functools.cache
def _digit_lines() -> tuple[_DigitLines, ...]:
    texels, lines = skin_texels(), []
    for digit in texels.digits:
        back = texels.back[digit.texels]
        on_back = back * digit.share * smooth(np.cos(digit.angle), -0.1, 0.6)
        lines.append(
            _DigitLines(
                digit.texels,
                along=digit.along.astype(np.float32),
                sine=np.sin(3.0 * digit.angle).astype(np.float32),
                cosine=np.cos(3.0 * digit.angle).astype(np.float32),
                arch=(0.0015 * np.cos(digit.angle)).astype(np.float32),
                pad=((1.0 - back) * digit.share).astype(np.float32),
                back=on_back.astype(np.float32),
                joints=np.cumsum(digit.lengths)[:2],
            )
        )
    return tuple(lines)


@functools.cache
def _lines_of_all() -> tuple[NDArray[np.int64], tuple[NDArray[np.float32], ...], NDArray[np.float32]]:
    """Texels of the palm (K,), its lines there (K,) each, and the depth (N,) of the wrist's lines."""
    texels = skin_texels()
    back = texels.back
    near, distances = _palm_distances()
    on_palm = (1.0 - back[near]) * (
        1.0 - sum(_share_at(digit, near, len(back)) for digit in texels.digits[1:])
    )
    lines = tuple((on_palm * bump(distance, 0.0011)).astype(np.float32) for distance in distances)
    depth = np.zeros(len(back))
    for position in _WRIST_LINES:
        depth = np.maximum(depth, 0.35 * bump(texels.positions[:, 0] - position, 0.0009) * (1.0 - back))
    return near, lines, depth.astype(np.float32)


def _share_at(digit: DigitTexels, texels: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    share = np.zeros(count)
    share[digit.texels] = digit.share
    return share[texels]
