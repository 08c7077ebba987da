"""Shadows of a far lamp, by the lamp's own z-buffer."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from render.painting.rasterizer import nearest_faces

_TEXELS: Final = (
    640  # along a side; hands and forearms are half a meter across, a finger's edge a millimeter soft
)
_MARGIN: Final = 3.0  # [texels] that reads of neighbors may go beyond what is drawn


class ShadowMap(NamedTuple):
    """Nearness of the nearest surface to a far lamp."""

    to_map: Float[np.ndarray, "3 4"]
    """Maps positions [m] to columns and rows [texels] and nearness to the lamp [m]."""
    nearest: Float32[np.ndarray, "N N"]
    """Nearness [m], minus infinity where nothing is."""
    bias: float
    """How much nearer a surface must be to cast a shadow [m]: about a texel."""


def shadow_map(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], towards: Float[np.ndarray, "3"]
) -> ShadowMap:
    """The shadows of a surface.

    Args:
        points: Vertices [m], in any frame.
        faces: Triangles.
        towards: Unit vector to the lamp, in the same frame.
    """
    aside = np.cross(np.eye(3)[np.abs(towards).argmin()], towards)
    aside /= np.linalg.norm(aside)
    rotation = np.stack([aside, np.cross(aside, towards), towards])  # rows run down, as in pictures
    rotated = points @ rotation.T
    aside_and_down = np.ascontiguousarray(rotated[:, :2].T)
    low, high = aside_and_down.min(axis=1), aside_and_down.max(axis=1)
    scale = (_TEXELS - 2.0 * _MARGIN) / max(float((high - low).max()), 1e-6)
    to_map = np.column_stack([rotation, np.zeros(3)])
    to_map[:2] *= scale
    to_map[:2, 3] = _MARGIN - scale * low
    corners = rotated * [scale, scale, 1.0] + to_map[:, 3]
    nearest, _ = nearest_faces(corners, faces, (_TEXELS, _TEXELS), farthest=-np.inf)
    return ShadowMap(to_map, nearest, 1.5 / scale)


@kernel
def lit_share(
    to_map: NDArray[np.float64], nearest: NDArray[np.float32], bias: float, x: float, y: float, z: float
) -> float:
    """Visible share of the lamp at a position: the mean over a square of three texels around it.

    Args:
        to_map: `ShadowMap.to_map` (3, 4).
        nearest: `ShadowMap.nearest` (N, N) [m].
        bias: `ShadowMap.bias` [m].
        x: Position in the frame of the map's points [m], as `y` and `z`.
        y: See `x`.
        z: See `x`.
    """
    across = to_map[0, 0] * x + to_map[0, 1] * y + to_map[0, 2] * z + to_map[0, 3] - 0.5
    down = to_map[1, 0] * x + to_map[1, 1] * y + to_map[1, 2] * z + to_map[1, 3] - 0.5
    near = to_map[2, 0] * x + to_map[2, 1] * y + to_map[2, 2] * z + to_map[2, 3] + bias
    column, row = int(np.floor(across)) - 1, int(np.floor(down)) - 1
    size = len(nearest)
    if column < 0 or row < 0 or column + 4 > size or row + 4 > size:
        return 1.0
    right, below = across - np.floor(across), down - np.floor(down)
    lit = 0.0
    for i in range(4):
        high = 1.0 - below if i == 0 else below if i == 3 else 1.0
        for j in range(4):
            if nearest[row + i, column + j] <= near:
                lit += high * (1.0 - right if j == 0 else right if j == 3 else 1.0)
    return lit / 9.0
