"""Adds names, titles and colors to pictures for people, arranges them in sheets, and writes PNG files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from handsim.files.outputs import atomic_write, check_ending
from handsim.hand.model import KEYPOINT_DIGITS, SKELETON, HandModel
from handsim.hand.shape import BONES, DIGITS
from handsim.hand.skin import vertex_normals
from render.formats.png import encode_png
from render.formats.records import CENTER, as_sensed
from render.frames import Bytes, Doubles, RenderedFrame
from render.painting.figures import Material, linear
from render.skin.texture import GLOVE_COLOR

Covering = Literal["skin", "glove"]
BACKGROUND: Final = (0.957, 0.961, 0.969)
SEEN_COLOR: Final = (0.13, 0.72, 0.33)
HIDDEN_COLOR: Final = (0.89, 0.2, 0.2)
UNLABELED_COLOR: Final = (0.5, 0.52, 0.56)
_DIGIT_COLORS: Final = (
    (0.85, 0.33, 0.1), (0.93, 0.66, 0.08), (0.15, 0.62, 0.35), (0.1, 0.47, 0.82), (0.56, 0.27, 0.68)
)  # fmt: skip
_PALM_COLOR: Final = (0.32, 0.36, 0.42)
_BASE: Final = {"skin": (0.86, 0.66, 0.56), "glove": GLOVE_COLOR}
_ROUGHNESS: Final = {"skin": 0.62, "glove": 0.85}
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_INK: Final = (38, 42, 50)
_PAPER: Final = tuple(round(255 * level) for level in BACKGROUND)
_TEXT_HEIGHT: Final = 24  # [pixels], of names and titles
_PADDING: Final = 16  # between a picture and its texts [pixels]
_GAP: Final = 6  # between the pictures of a sheet [px]
_FRACTION_BITS: Final = 4  # OpenCV gets positions in sixteenths of a pixel


def bone_colors() -> Float[np.ndarray, "L 3"]:
    """One color (sRGB) per digit, and one for the palm, in the order of `handsim.hand.shape.BONES`."""
    colors = [_PALM_COLOR if bone.digit < 0 else _DIGIT_COLORS[bone.digit] for bone in BONES]
    return np.array(colors)


def covering_material(covering: Covering) -> Material:
    """Bare skin or a dark glove, of one color."""
    return Material(linear(_BASE[covering]), _ROUGHNESS[covering])


def skin_tint(model: HandModel) -> Float[np.ndarray, "V 3"]:
    """Factors on the skin's color: redder towards the finger tips, paler on the palm's side."""
    surface = model.surface
    reddening = np.zeros(len(surface.vertices))
    for digit in range(len(DIGITS)):
        last = 3 + 3 * digit
        origin, along = model.rest_transforms[last, :3, 3], model.rest_transforms[last, :3, 0]
        share = ((surface.vertices - origin) @ along) / model.skeleton.lengths[last]
        mine = (surface.bone_weights * (surface.bone_indices == last)).sum(axis=1)
        reddening += mine * np.clip(share, 0.0, 1.0)
    pale = np.clip(-vertex_normals(surface.vertices, surface.faces)[:, 2], 0.0, 1.0)[:, None]
    paleness, redness = np.array([0.10, 0.06, 0.06]), np.array([0.0, -0.16, -0.13])
    return np.asarray(1.0 + pale * paleness + reddening[:, None] * redness)


Picture = UInt8[np.ndarray, "H W 3"]


def write_png(path: str | Path, picture: Picture) -> None:
    """Write a picture as PNG."""
    check_ending(Path(path), ".png", option="path")
    with atomic_write(path) as temporary:
        temporary.write_bytes(encode_png(picture))


def side_by_side(pictures: Sequence[Picture], *, gap: int = 0) -> Picture:
    """Pictures in a row, those of less height centered, on the common background."""
    height = max(picture.shape[0] for picture in pictures)
    parts = []
    for number, picture in enumerate(pictures):
        spare = height - picture.shape[0]
        parts.append(pad(picture, (spare // 2, spare - spare // 2), (gap if number else 0, 0)))
    return np.concatenate(parts, axis=1)


def titled(picture: Picture, title: str) -> Picture:
    """The picture with a line of text above it, in its middle."""
    band = round(_TEXT_HEIGHT * 2.2)
    result = pad(picture, (band, 0), (0, 0))
    origin = ((picture.shape[1] - text_width(title)) // 2, band - _PADDING // 2)
    _write(result, title, origin, _INK)
    return result


def captioned(picture: Picture, captions: Sequence[tuple[float, str]]) -> Picture:
    """The picture with a line of captions below it, each centered on its own column [px]."""
    band = round(_TEXT_HEIGHT * 2.0)
    result = pad(picture, (0, band), (0, 0))
    for center, caption in captions:
        origin = (round(center - text_width(caption) / 2), picture.shape[0] + round(_TEXT_HEIGHT * 1.2))
        _write(result, caption, origin, _INK)
    return result


def with_names(
    picture: Picture,
    pixels: Float[np.ndarray, "M 2"],
    names: Sequence[str],
    colors: Float[np.ndarray, "M 3"] | None = None,
) -> Picture:
    """The picture between columns of names, with a thin line from each name to its point [px], if finite."""
    shown = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    column = 2 * _PADDING + max((text_width(name) for name in names), default=0)
    width = picture.shape[1]
    shown = shown[np.argsort(pixels[shown, 1], kind="stable")]
    left = shown[pixels[shown, 0] < width / 2]
    right = shown[pixels[shown, 0] >= width / 2]
    step = round(_TEXT_HEIGHT * 1.35)
    rows = max(picture.shape[0], step * (max(len(left), len(right)) + 1))
    above = (rows - picture.shape[0]) // 2
    result = pad(picture, (above, rows - picture.shape[0] - above), (column, column))
    shift = np.array([column, above])
    for side, marks in (("left", left), ("right", right)):  # from top to bottom, or the lines would cross
        heights = spread_out(pixels[marks, 1] + above, step, _TEXT_HEIGHT, rows - _TEXT_HEIGHT)
        for mark, height in zip(marks, heights, strict=True):
            ink = _INK if colors is None else tuple(int(level) for level in np.rint(255 * colors[mark]))
            x, y = np.rint(pixels[mark] + shift).astype(int)
            start = text_width(names[mark]) if side == "left" else 0
            text_x = column - _PADDING - start if side == "left" else column + width + _PADDING
            line_x = column - _PADDING // 2 if side == "left" else column + width + _PADDING // 2
            cv2.line(result, (line_x, round(height)), (x, y), (150, 155, 165), 1, cv2.LINE_AA)
            cv2.circle(result, (x, y), 2, ink, -1, cv2.LINE_AA)
            _write(result, names[mark], (text_x, round(height) + _TEXT_HEIGHT // 3), ink)
    return result


def spread_out(desired: Float[np.ndarray, "N"], step: float, low: float, high: float) -> Doubles:
    """Ascending heights nearest to the desired ones, at least `step` apart, between `low` and `high` [px]."""
    from scipy.optimize import isotonic_regression

    slots: Doubles = step * np.arange(len(desired), dtype=np.float64)
    if not len(desired):
        return slots
    most = max(low, high - slots[-1])
    return np.asarray(np.clip(isotonic_regression(desired - slots).x, low, most) + slots)


def pad(picture: Picture, rows: tuple[int, int], columns: tuple[int, int]) -> Picture:
    """The picture with background above and below (`rows`), left and right (`columns`) [pixels]."""
    height, width = picture.shape[:2]
    result = np.empty((height + sum(rows), width + sum(columns), 3), dtype=np.uint8)
    result[:] = _PAPER
    result[rows[0] : rows[0] + height, columns[0] : columns[0] + width] = picture
    return result


def text_width(text: str) -> int:
    """Width of a name or title [pixels]."""
    return int(cv2.getTextSize(text, _FONT, _TEXT_HEIGHT / 32.0, 2)[0][0])


def _write(picture: Picture, text: str, origin: tuple[int, int], ink: tuple[int, ...]) -> None:
    cv2.putText(picture, text, origin, _FONT, _TEXT_HEIGHT / 32.0, ink, 2, cv2.LINE_AA)


def contact_sheet(frames: Sequence[RenderedFrame], *, columns: int = 3, width: int = 320) -> Picture:
    """Frames in rows of `columns`, each at most `width` wide [px]; hidden keypoints are drawn hollow.

    A frame without colors shows its depth alone.
    """
    return in_rows([_sheet_cell(frame, width) for frame in frames], columns=columns)


def in_rows(cells: Sequence[Picture], *, columns: int = 3) -> Picture:
    """Pictures of any sizes in rows of `columns`."""
    height = max(cell.shape[0] for cell in cells)
    across = max(cell.shape[1] for cell in cells)
    spare = [(height - cell.shape[0] + _GAP, across - cell.shape[1] + _GAP) for cell in cells]
    cells = [pad(cell, (0, rows), (0, right)) for cell, (rows, right) in zip(cells, spare, strict=True)]
    blank = np.broadcast_to(np.array(_PAPER, dtype=np.uint8), cells[0].shape)
    columns = min(columns, len(cells))
    cells += [blank] * (math.ceil(len(cells) / columns) * columns - len(cells))
    rows = [side_by_side(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    return pad(np.concatenate(rows), (_GAP, 0), (_GAP, 0))


def draw_keypoints(
    picture: Picture,
    hands: Iterable[tuple[Float[np.ndarray, "21 2"], Bool[np.ndarray, "21"]]],
    *,
    scale: float = 1.0,
) -> Picture:
    """The picture with the hands' skeletons in it, in the digits' colors.

    Of each hand keypoints [px] are given, and which of them are visible; others are drawn hollow.
    """
    drawn = np.ascontiguousarray(picture).copy()
    colors = np.rint(255 * bone_colors()).astype(int)
    inks = [tuple(colors[0 if digit < 0 else 1 + 3 * digit].tolist()) for digit in KEYPOINT_DIGITS]
    unit = 2**_FRACTION_BITS
    style = {"lineType": cv2.LINE_AA, "shift": _FRACTION_BITS}
    for keypoints, visible in hands:
        known = (np.abs(keypoints) < 1e5).all(axis=1)  # False for NaN
        sixteenths = np.rint(unit * (scale * np.nan_to_num(keypoints) - CENTER))
        pixels = sixteenths.astype(int).clip(-(2**24), 2**24)
        for start, end in SKELETON:
            if known[start] and known[end]:
                cv2.line(drawn, pixels[start].tolist(), pixels[end].tolist(), inks[end], 1, **style)
        for keypoint, pixel in enumerate(pixels.tolist()):
            if known[keypoint]:
                thickness = -1 if visible[keypoint] else 1
                cv2.circle(drawn, pixel, 3 * unit, inks[keypoint], thickness, **style)
    return drawn


def colored_depth(depth: Float32[np.ndarray, "H W"]) -> Picture:
    """Depth as colors, the nearest red, the farthest blue; background where there is nothing."""
    present = depth > 0.0
    picture: Bytes = np.empty((*depth.shape, 3), dtype=np.uint8)
    picture[:] = _PAPER
    if present.any():
        near, far = depth[present].min(), depth[present].max()
        share = (far / depth[present] - 1.0) / max(far / near - 1.0, 1e-9)  # rooms are far behind hands
        levels = np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)[:, None]
        picture[present] = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return picture


def _sheet_cell(frame: RenderedFrame, width: int) -> Picture:
    sensed = as_sensed(frame)
    scale = min(1.0, width / frame.camera.size[0])
    parts, hands = [], [(hand.keypoints, hand.visible) for hand in frame.hands]
    if sensed.rgb is not None:
        parts.append(draw_keypoints(scaled(sensed.rgb, scale), hands, scale=scale))
    if sensed.depth is not None:
        depth = scaled(colored_depth(sensed.depth), scale)
        parts.append(depth if parts else draw_keypoints(depth, hands, scale=scale))
    return side_by_side(parts)


def scaled(picture: Picture, scale: float) -> Picture:
    """The picture, smaller by a scale of at most 1."""
    if scale == 1.0:
        return picture
    size = [max(1, round(scale * length)) for length in picture.shape[1::-1]]
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
