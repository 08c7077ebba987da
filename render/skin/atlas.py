"""The drawn skin's connectivity and its texture coordinates, the same for every hand.

The skin's cage has 360 faces; those in front of the wrist get a square tile of the texture each, so that the
texture needs no cutting by hand and no tile is stretched much. Corner texels of a tile lie on its corners:
neighbors hold the same colors along a common side, and no seam shows. The forearm has a strip of its own
under the tiles.
"""

from __future__ import annotations

import functools
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handsim.hand.skin import WRIST, cage_topology, catmull_clark, subdivided_loops

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

    used: NDArray[np.int64]
    """Vertices (U,) of the base surface that are drawn: those from the wrist's ring on."""
    wrist: NDArray[np.int64]
    """The wrist's ring (R,), indices of the drawn vertices, from the index side over the back."""
    faces: NDArray[np.int64]
    """Triangles (F, 3) of the drawn vertices, closed, counter-clockwise from outside on a right hand."""
    corners: NDArray[np.int64]
    """Drawn vertex of each corner (D,): a vertex on tiles' borders has one for each tile."""
    corner_faces: NDArray[np.int64]
    """The same triangles (F, 3) as indices of `corners`."""
    coarse_faces: NDArray[np.int64]
    """A quarter as many triangles (G, 3) of the same corners: the surface to a few tenths of a millimeter."""
    uv: NDArray[np.float32]
    """Texture coordinates (D, 2), the origin at the bottom left."""
    tiles: NDArray[np.int64]
    """Drawn vertices (K, 5, 5) of each tile's grid."""
    size: tuple[int, int]
    """Width and height of the texture [texels]."""

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


def _child_coordinates(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates (4 Q, 4, 2) in their tile of the four children's corners, in `catmull_clark`'s order."""
    following, before = np.roll(coordinates, -1, axis=1), np.roll(coordinates, 1, axis=1)
    middle = np.broadcast_to(coordinates.mean(axis=1, keepdims=True), coordinates.shape)
    children = np.stack(
        [coordinates, (coordinates + following) / 2, middle, (coordinates + before) / 2], axis=2
    )
    return children.reshape(-1, 4, 2)


def _grids(quads: NDArray[np.int64], coordinates: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Vertices (K, 5, 5) of each cage face's grid: rows go along its second axis."""
    grids = np.zeros((count, _SIDE + 1, _SIDE + 1), dtype=np.int64)
    column, row = np.rint(coordinates * _SIDE).astype(int).transpose(2, 0, 1)
    owner = np.repeat(np.arange(count), len(quads) // count)[:, None]
    grids[np.broadcast_to(owner, row.shape), row, column] = quads
    return grids


def _assemble(used: NDArray[np.int64], tiles: NDArray[np.int64], wrist: NDArray[np.int64]) -> Atlas:
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


def _squares(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles of each square of grids (K, R, C)."""
    a, b, c, d = nodes[:, :-1, :-1], nodes[:, :-1, 1:], nodes[:, 1:, 1:], nodes[:, 1:, :-1]
    first = np.stack([a, b, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, d], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second])
