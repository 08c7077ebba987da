"""A sheet of rendered frames, with keypoints and colored depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.hand.model import KEYPOINT_DIGITS, SKELETON
from render.formats.annotations.common import CENTER, as_sensed
from render.frames import HandTruth, RenderedFrame
from render.illustrations.captions import pad, side_by_side
from render.illustrations.palette import BACKGROUND, bone_colors

Picture = UInt8[np.ndarray, "H W 3"]

_GAP: Final = 6  # [px]
_FRACTION_BITS: Final = 4  # OpenCV draws between pixels in sixteenths
_EMPTY: Final = tuple(round(255 * level) for level in BACKGROUND)


def contact_sheet(frames: Sequence[RenderedFrame], *, columns: int = 3, width: int = 320) -> Picture:
    """Some frames in rows of `columns`, at most so wide each [px]; hidden keypoints are hollow.

    A frame without colors shows its depth alone.

    Raises:
        HandSimError: There are no frames, or one has neither colors nor depth.
    """
    if not frames:
        raise HandSimError("a contact sheet needs at least one frame")
    cells = [_cell(frame, width) for frame in frames]
    height = max(cell.shape[0] for cell in cells)
    across = max(cell.shape[1] for cell in cells)
    cells = [_padded(cell, height, across) for cell in cells]
    blank = np.broadcast_to(np.array(_EMPTY, dtype=np.uint8), cells[0].shape)
    columns = min(columns, len(cells))
    cells += [blank] * (math.ceil(len(cells) / columns) * columns - len(cells))
    rows = [side_by_side(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    return pad(np.concatenate(rows), (_GAP, 0), (_GAP, 0))


def draw_keypoints(picture: Picture, hands: Sequence[HandTruth], *, scale: float = 1.0) -> Picture:
    """The picture with the hands' skeletons in it, in the digits' colors.

    Args:
        picture: The picture; not changed.
        hands: Hands whose `pixels` are drawn where they are known.
        scale: Pixels of this picture per pixel of the camera.
    """
    drawn = np.ascontiguousarray(picture).copy()
    colors = np.rint(255 * bone_colors()).astype(int)
    inks = [tuple(colors[0 if digit < 0 else 1 + 3 * digit].tolist()) for digit in KEYPOINT_DIGITS]
    unit = 2**_FRACTION_BITS
    style = {"lineType": cv2.LINE_AA, "shift": _FRACTION_BITS}
    for hand in hands:
        near = (np.abs(np.nan_to_num(hand.keypoints)) < 1e5).all(axis=1)
        known = np.isfinite(hand.keypoints).all(axis=1) & near
        pixels = (
            np.rint(unit * (scale * np.nan_to_num(hand.keypoints) - CENTER)).astype(int).clip(-(2**24), 2**24)
        )
        for start, end in SKELETON:
            if known[start] and known[end]:
                cv2.line(drawn, pixels[start].tolist(), pixels[end].tolist(), inks[end], 1, **style)
        for keypoint, pixel in enumerate(pixels.tolist()):
            if known[keypoint]:
                thickness = -1 if hand.visible[keypoint] else 1
                cv2.circle(drawn, pixel, 3 * unit, inks[keypoint], thickness, **style)
    return drawn


def colored_depth(depth: Float32[np.ndarray, "H W"]) -> Picture:
    """Depth as colors, the nearest red, the farthest blue; background where there is nothing."""
    present = depth > 0.0
    picture: NDArray[np.uint8] = np.empty((*depth.shape, 3), dtype=np.uint8)
    picture[:] = _EMPTY
    if present.any():
        near, far = depth[present].min(), depth[present].max()
        share = (far - depth) / max(far - near, 1e-9)
        levels = np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
        colors = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]
        picture[present] = colors[present]
    return picture


def _cell(frame: RenderedFrame, width: int) -> Picture:
    sensed = as_sensed(frame)
    if sensed.rgb is None and sensed.depth is None:
        raise HandSimError(f"frame {frame.number} has neither colors nor depth to show")
    scale = min(1.0, width / frame.camera.size[0])
    parts = []
    if sensed.rgb is not None:
        parts.append(draw_keypoints(_scaled(sensed.rgb, scale), frame.hands, scale=scale))
    if sensed.depth is not None:
        depth = _scaled(colored_depth(sensed.depth), scale)
        parts.append(depth if parts else draw_keypoints(depth, frame.hands, scale=scale))
    return side_by_side(parts)


def _scaled(picture: Picture, scale: float) -> Picture:
    if scale == 1.0:
        return picture
    size = [max(1, round(scale * length)) for length in picture.shape[1::-1]]
    smaller: NDArray[np.uint8] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return smaller


def _padded(picture: Picture, height: int, width: int) -> Picture:
    rows, columns = height - picture.shape[0], width - picture.shape[1]
    return pad(picture, (0, rows + _GAP), (0, columns + _GAP))
