"""Cards that notebooks show for takes, layouts, rigs and training sets: facts beside a small SVG.

A card is self-contained HTML without scripts and styles, and is legible on any background.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from handsim.pages import Paint

_DRAWING_WIDTH: Final = 320.0
"""Width of every drawing [pixels]."""
_ROW_HEIGHT: Final = 16.0
"""Height of a row of a drawing [pixels]."""
_NAMES_WIDTH: Final = 100.0
"""Width of the names of rows [pixels]."""


def card(title: str, facts: Mapping[str, str], drawing: str) -> str:
    """HTML with a title, a table of facts and a drawing."""
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(one)}</td></tr>" for name, one in facts.items())
    return f"<div><b>{escape(title)}</b><table>{rows}</table>{drawing}</div>"


def map_drawing(
    points: Float[np.ndarray, "N 2"],
    names: Sequence[str],
    lines: Sequence[Float[np.ndarray, "K 2"]] = (),
) -> str:
    """Named points and lines on a map whose axes have one scale, the second axis upwards."""
    everything = np.concatenate([points, *lines])
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = (_DRAWING_WIDTH - 2 * _ROW_HEIGHT) / max(float((high - low).max()), 1e-9)
    height = (high - low)[1] * scale + 2 * _ROW_HEIGHT

    def at(places: Float[np.ndarray, "K 2"]) -> list[tuple[float, float]]:
        return [(_ROW_HEIGHT + x, height - _ROW_HEIGHT - y) for x, y in (places - low) * scale]

    shapes = []
    for line in lines:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in at(line))
        shapes.append(f'<polyline points="{path}" fill="none" stroke="{Paint.PALE}" stroke-width="2"/>')
    for name, (x, y) in zip(names, at(points), strict=True):
        dot = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{Paint.BLUE}">'
        shapes.append(f"{dot}<title>{escape(name)}</title></circle>")
    return _svg(height, shapes)


def share_drawing(shares: Mapping[str, float]) -> str:
    """A bar for each share in [0, 1], with its name before it."""
    shapes = []
    for number, (name, share) in enumerate(shares.items()):
        shapes += [*_row_shapes(number, f"{name} {100 * share:.1f} %"), _bar_shape(number, 0.0, share)]
    return _svg(_ROW_HEIGHT * len(shares), shapes)


def span_drawing(rows: Mapping[str, Bool[np.ndarray, "T"]]) -> str:
    """A row for each name, filled where its frames are true."""
    shapes = []
    for number, (name, present) in enumerate(rows.items()):
        shapes += _row_shapes(number, name)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
        # Pixels cannot show more spans than this.
        for first, last in edges.reshape(-1, 2)[: int(_DRAWING_WIDTH)] / max(len(present), 1):
            shapes.append(_bar_shape(number, float(first), float(last)))
    return _svg(_ROW_HEIGHT * len(rows), shapes)


def _row_shapes(number: int, name: str) -> list[str]:
    """The SVG elements of a row: its name and its empty band."""
    place = f'x="{_NAMES_WIDTH - 4:g}" y="{_ROW_HEIGHT * (number + 0.75):g}"'
    text = f'<text {place} font-size="10" text-anchor="end" fill="{Paint.SOFT}">{escape(name)}</text>'
    return [text, _bar_shape(number, 0.0, 1.0, Paint.BAND)]


def _bar_shape(number: int, first: float, last: float, color: str = Paint.BLUE) -> str:
    """The SVG element of a part of a row, from one share of its width to another."""
    width = _DRAWING_WIDTH - _NAMES_WIDTH
    x, y = _NAMES_WIDTH + width * first, _ROW_HEIGHT * number + 1
    size = f'width="{width * (last - first):.1f}" height="{_ROW_HEIGHT - 2:g}"'
    return f'<rect x="{x:.1f}" y="{y:g}" {size} fill="{color}"/>'


def _svg(height: float, shapes: Iterable[str]) -> str:
    """A drawing as SVG."""
    size = f'width="{_DRAWING_WIDTH:g}" height="{height:.0f}" viewBox="0 0 {_DRAWING_WIDTH:g} {height:.0f}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">{"".join(shapes)}</svg>'
