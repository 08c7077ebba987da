"""Cards: what notebooks show of takes, layouts, rigs and training sets, as facts beside a small SVG.

A card is self-contained HTML without scripts and styles of its own, and legible before any background.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from handsim.pages import Paint

_WIDTH: Final = 320.0
"""Width of every drawing [pixels]."""
_ROW: Final = 16.0
"""Height of a row of a drawing [pixels]."""
_NAMES: Final = 100.0
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
    scale = (_WIDTH - 2 * _ROW) / max(float((high - low).max()), 1e-9)
    height = (high - low)[1] * scale + 2 * _ROW

    def at(places: Float[np.ndarray, "K 2"]) -> list[tuple[float, float]]:
        return [(_ROW + x, height - _ROW - y) for x, y in (places - low) * scale]

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
        shapes += [*_row(number, f"{name} {100 * share:.1f} %"), _box(number, 0.0, share)]
    return _svg(_ROW * len(shares), shapes)


def span_drawing(rows: Mapping[str, Bool[np.ndarray, "T"]]) -> str:
    """A row for each name, filled where its frames are true."""
    shapes = []
    for number, (name, present) in enumerate(rows.items()):
        shapes += _row(number, name)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
        # Pixels cannot show more spans than this.
        for first, last in edges.reshape(-1, 2)[: int(_WIDTH)] / max(len(present), 1):
            shapes.append(_box(number, float(first), float(last)))
    return _svg(_ROW * len(rows), shapes)


def _row(number: int, name: str) -> list[str]:
    """The name and the empty band of a row."""
    text = f'<text x="{_NAMES - 4:g}" y="{_ROW * (number + 0.75):g}" font-size="10" text-anchor="end" '
    return [f'{text}fill="{Paint.SOFT}">{escape(name)}</text>', _box(number, 0.0, 1.0, Paint.BAND)]


def _box(number: int, first: float, last: float, color: str = Paint.BLUE) -> str:
    """A part of a row, between two shares of its width."""
    width = _WIDTH - _NAMES
    x, y = _NAMES + width * first, _ROW * number + 1
    size = f'width="{width * (last - first):.1f}" height="{_ROW - 2:g}"'
    return f'<rect x="{x:.1f}" y="{y:g}" {size} fill="{color}"/>'


def _svg(height: float, shapes: Iterable[str]) -> str:
    """A drawing as SVG."""
    size = f'width="{_WIDTH:g}" height="{height:.0f}" viewBox="0 0 {_WIDTH:g} {height:.0f}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">{"".join(shapes)}</svg>'
