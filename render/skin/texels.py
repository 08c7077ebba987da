"""The anatomy at each texel: position, normal, side of the hand and digit, on one reference hand.

It is computed once per process, on a right hand of size M with its fingers straight.
"""

from __future__ import annotations

import functools
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import DIGITS, NUM_BONES
from render.skin.atlas import ARM_ROWS, COLUMNS, RINGS, TILE, skin_atlas
from render.skin.fields import smooth
from render.skin.forearm import Forearm
from render.skin.mesh import PosableSkin

REFERENCE: Final = Forearm(length=0.5)
"""The forearm whose texels are painted; a longer one is stretched."""


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
