"""Fine relief of the skin as a normal map: nails, tendons, knuckles, creases and grain, under a millimeter.

The drawn mesh stays as it is, and so do depth and silhouettes; only shading shows the relief.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from handsim.hand.shape import named_shape
from render.skin.atlas import ARM_ROWS, TILE, skin_atlas
from render.skin.fields import bump, smooth
from render.skin.texels import skin_texels

if TYPE_CHECKING:
    from handsim.hand.shape import Side


_STEEPEST: Final = 0.9  # height over distance


class _TangentScales(NamedTuple):
    """Scales (N,) from height differences of neighboring texels to gradients along the tangents [1/m]."""

    across: NDArray[np.float64]
    """Scale of the difference along the row, for the first tangent."""
    skew: NDArray[np.float64]
    """Share of the first gradient in the second tangent: tiles are not rectangles."""
    down: NDArray[np.float64]
    """Scale of the difference along the column, for the second tangent."""


def normal_map(height: NDArray[Any], side: Side) -> UInt8[np.ndarray, "H W 3"]:
    """Normal map in the tangent frame of pyrender's shader: along u, and normal x that.

    Args:
        height: Height of the relief at each texel (N,) [m].
        side: A left hand's second axis has the other sign.
    """
    width, rows = skin_atlas().size
    across, down = _differences(height.reshape(rows, width, 1))
    scales = _tangent_scales()
    first = scales.across * across.ravel()
    second = scales.down * down.ravel() - scales.skew * first
    if side == "left":
        second = -second
    tilt = np.stack([-first, -second], axis=1)
    steep = np.linalg.norm(tilt, axis=1, keepdims=True)
    tilt *= np.minimum(1.0, _STEEPEST / np.maximum(steep, 1e-12))
    normals = np.concatenate([tilt, np.ones((len(tilt), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    encoded: NDArray[np.uint8] = np.rint(127.5 * (normals + 1.0)).astype(np.uint8)
    return encoded.reshape(rows, width, 3)


def _differences(grid: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Differences a texel to the right and down within each tile, one-sided on its border."""
    rows, width, channels = grid.shape
    hand = rows - ARM_ROWS
    across, down = np.empty_like(grid), np.empty_like(grid)
    tiles = grid[:hand].reshape(hand // TILE, TILE, width // TILE, TILE, channels)
    across[:hand] = np.gradient(tiles, axis=3).reshape(hand, width, channels)
    down[:hand] = np.gradient(tiles, axis=1).reshape(hand, width, channels)
    across[hand:] = np.gradient(grid[hand:], axis=1)
    down[hand:] = np.gradient(grid[hand:], axis=0)
    return across, down


@functools.cache
def relief() -> NDArray[np.float64]:
    """Height (N,) [m] of the relief of every hand: tendons, knuckles, and hollows between them."""
    texels, shape = skin_texels(), named_shape("M")
    back = smooth(texels.dorsal, -0.25, 0.35)  # of each digit; the thumb's faces sideways
    positions = texels.positions[:, :2]
    height = np.zeros(len(positions))
    knuckles = shape.knuckles[1:, :2]
    for knuckle in knuckles:
        root = np.array([0.1, 0.35]) * knuckle  # tendons meet at the wrist
        along = np.clip(
            (positions - root) @ (knuckle - root) / ((knuckle - root) @ (knuckle - root)), 0.0, 1.0
        )
        aside = np.linalg.norm(positions - root - along[:, None] * (knuckle - root), axis=1)
        height += 0.00025 * smooth(along, 0.2, 0.8) * bump(aside, 0.0032)
        height += 0.0005 * bump(np.linalg.norm(positions - knuckle, axis=1), 0.0065)
    for hollow in 0.5 * (knuckles[:-1] + knuckles[1:]) + [0.004, 0.0]:
        height -= 0.0004 * bump(np.linalg.norm(positions - hollow, axis=1), 0.0055)
    height *= back * texels.palm
    for digit in texels.digits:
        for joint, high, wide in zip(
            np.cumsum(digit.lengths)[:2], (0.0005, 0.0003), (0.006, 0.0045), strict=True
        ):
            knob = high * bump(digit.along - joint, wide) * bump(digit.angle, 1.0)
            height[digit.texels] += knob * back[digit.texels] * digit.share
    return height


@functools.cache
def _tangent_scales() -> _TangentScales:
    width, rows = skin_atlas().size
    texels = skin_texels()
    along_row, along_column = (
        difference.reshape(-1, 3) for difference in _differences(texels.positions.reshape(rows, width, 3))
    )
    normals = texels.normals
    first = along_row - (along_row * normals).sum(axis=1, keepdims=True) * normals
    length = np.maximum(np.linalg.norm(first, axis=1), 2e-5)
    first /= length[:, None]
    second = np.cross(normals, first)
    aside, ahead = (along_column * first).sum(axis=1), (along_column * second).sum(axis=1)
    ahead = np.where(np.abs(ahead) < 2e-5, np.copysign(2e-5, ahead), ahead)
    return _TangentScales(1.0 / length, aside / ahead, 1.0 / ahead)
