"""Pictures for people: marker names with leader lines, titles, pictures side by side, PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.files.outputs import atomic_write
from render.illustrations.palette import BACKGROUND

Picture = UInt8[np.ndarray, "H W 3"]

_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_INK: Final = (38, 42, 50)
_PAPER: Final = tuple(round(255 * level) for level in BACKGROUND)
_TEXT_HEIGHT: Final = 24  # [pixels], of names and titles
_LINE_STEP: Final = 1.35
_PADDING: Final = 16  # [pixels]


def write_png(path: str | Path, picture: Picture) -> None:
    """Write a picture as PNG.

    Raises:
        HandSimError: The name does not end in .png.
        OSError: The file cannot be written.
    """
    if Path(path).suffix.lower() != ".png":
        raise HandSimError(f"{path}: expected a file name that ends in .png")
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    assert done, "a PNG takes any 8-bit picture"
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def side_by_side(pictures: Sequence[Picture], *, gap: int = 0) -> Picture:
    """Pictures in a row, those of less height centered, on the common background."""
    height = max(picture.shape[0] for picture in pictures)
    parts = []
    for number, picture in enumerate(pictures):
        above = (height - picture.shape[0]) // 2
        below = height - picture.shape[0] - above
        before = gap if number else 0
        parts.append(pad(picture, (above, below), (before, 0)))
    return np.concatenate(parts, axis=1)


def titled(picture: Picture, title: str) -> Picture:
    """The picture with a line of text above it, in its middle."""
    band = round(_TEXT_HEIGHT * 2.2)
    result = pad(picture, (band, 0), (0, 0))
    width = text_width(title)
    origin = ((picture.shape[1] - width) // 2, band - _PADDING // 2)
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
    """The picture between two columns of names, with a thin line from each name to its point in the picture.

    Args:
        pixels: Points in it, x right and y down [px]; NaN rows get no name.
        names: One per point.
        colors: sRGB in [0, 1] of each name; ink when not given.
    """
    shown = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    column = 2 * _PADDING + max((text_width(name) for name in names), default=0)
    width = picture.shape[1]
    shown = shown[np.argsort(pixels[shown, 1], kind="stable")]
    left = shown[pixels[shown, 0] < width / 2]
    right = shown[pixels[shown, 0] >= width / 2]
    step = round(_TEXT_HEIGHT * _LINE_STEP)
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


def spread_out(desired: Float[np.ndarray, "N"], step: float, low: float, high: float) -> NDArray[np.float64]:
    """Ascending heights near the desired ones, at least `step` apart, between `low` and `high` [px].

    They are the least-squares solution, by pooling adjacent violators.
    """
    slots = step * np.arange(len(desired))
    blocks: list[tuple[float, int]] = []  # mean of desired - slot, how many
    for offset in desired - slots:
        mean, count = float(offset), 1
        while blocks and blocks[-1][0] > mean:
            before, size = blocks.pop()
            mean, count = (before * size + mean * count) / (size + count), size + count
        blocks.append((mean, count))
    means = np.repeat([mean for mean, _ in blocks], [count for _, count in blocks]) if blocks else slots
    most = max(low, high - (slots[-1] if len(slots) else 0.0))
    heights: NDArray[np.float64] = np.clip(means, low, most) + slots
    return heights


def pad(picture: Picture, rows: tuple[int, int], columns: tuple[int, int]) -> Picture:
    """The picture with background above and below (`rows`), left and right (`columns`) [pixels]."""
    height, width = picture.shape[:2]
    result = np.empty((height + sum(rows), width + sum(columns), 3), dtype=np.uint8)
    result[:] = _PAPER
    result[rows[0] : rows[0] + height, columns[0] : columns[0] + width] = picture
    return result


def text_width(text: str) -> int:
    """Width of a name or title [pixels]."""
    return int(cv2.getTextSize(text, _FONT, _scale(), 2)[0][0])


def _scale() -> float:
    return _TEXT_HEIGHT / 32.0


def _write(picture: Picture, text: str, origin: tuple[int, int], ink: tuple[int, ...]) -> None:
    cv2.putText(picture, text, origin, _FONT, _scale(), ink, 2, cv2.LINE_AA)
