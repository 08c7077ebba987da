"""A picture of a calibration: the hand and its markers before and after, and the contact points.

matplotlib is imported when a picture is drawn; pyplot is not used.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves import GloveFit
from handsim.files.outputs import atomic_write
from handsim.hand.shape import BONES, PALM
from handsim.hand.skin import vertex_normals
from handsim.pages import own_figures
from track import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK, _SOFT, _BEFORE, _AFTER, _TOUCH, _CARD = "#23272f", "#5b6270", "#8a93a0", "#b8572b", "#7a4fa3", "#f4f5f7"
_SIZE: Final = (12.5, 7.2)  # [inch]
_DPI: Final = 130
_VIEWS: Final = ("from the back", "from the palm")


def save_picture(path: str | Path, calibration: Calibration) -> None:
    """Draw a calibration into a PNG file.

    Args:
        path: The file.
        calibration: A calibrated hand.

    Raises:
        OSError: The file cannot be written.
    """
    with own_figures({}) as new_figure:
        figure = new_figure(figsize=_SIZE, facecolor=_CARD, layout="constrained")
        panels = figure.subplots(1, 2)
        for panel, title, sign in zip(panels, _VIEWS, (1.0, -1.0), strict=True):
            _draw(panel, calibration, sign)
            panel.set_title(title, color=_SOFT, fontsize=10)
        handles, labels = panels[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, labelcolor=_INK)
        figure.suptitle(_headline(calibration), color=_INK, fontsize=11)
        with atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=_DPI, facecolor=_CARD)


def _headline(calibration: Calibration) -> str:
    before, after = 1e3 * calibration.gaps()
    text = f"{calibration.hand.side} hand: markers off by {1e3 * calibration.rms_before:.1f} mm before, "
    text += f"{1e3 * calibration.rms_after:.2f} mm after"
    return (
        text
        if np.isnan(before)
        else f"{text}; thumb to fingertip {before:.1f} mm before, {after:.1f} mm after"
    )


def _draw(panel: Axes, calibration: Calibration, sign: float) -> None:
    """One view; `sign` is 1 from the back and -1 from the palm."""
    start, hand = calibration.start, calibration.hand
    _draw_skin(panel, hand, sign)
    _draw_bones(panel, start, sign, _BEFORE, "bones before")
    _draw_bones(panel, hand, sign, _INK, "bones after")
    old, new = _flat(start.attachment.points, sign), _flat(hand.attachment.points, sign)
    seen = sign * hand.attachment.normals[:, 2] > -0.2
    for first, second in zip(old[seen], new[seen], strict=True):
        panel.plot(*np.stack([first, second]).T, color=_AFTER, linewidth=1.0, zorder=4)
    panel.plot(
        *old[seen].T, "o", color=_BEFORE, fillstyle="none", markersize=7, zorder=5, label="markers before"
    )
    panel.plot(*new[seen].T, "o", color=_AFTER, markersize=6, zorder=6, label="markers after")
    if sign > 0.0:
        for name, spot in zip(hand.attachment.layout.names, new, strict=True):
            panel.annotate(
                name, (spot[0], spot[1]), (5, 4), textcoords="offset points", fontsize=6.5, color=_INK,
                zorder=7, parse_math=False,
            )  # fmt: skip
    if sign < 0.0:  # contact points are on the pads
        points = [touch.points for touch in calibration.significant_touches]
        touched = np.concatenate(points) if points else np.empty((0, 3))
        panel.plot(*_flat(touched, sign).T, "o", color=_TOUCH, markersize=3.5, zorder=8, label="touches")
    panel.set_aspect("equal")
    panel.set_axis_off()


def _draw_skin(panel: Axes, hand: GloveFit, sign: float) -> None:
    """The triangles that face the viewer, the farthest first."""
    from matplotlib.collections import PolyCollection

    surface = hand.model.surface
    normals = sign * vertex_normals(surface.vertices, surface.faces)[surface.faces].mean(axis=1)[:, 2]
    depth = sign * surface.vertices[surface.faces][..., 2].mean(axis=1)
    front = np.flatnonzero(normals > 0.0)
    front = front[np.argsort(depth[front])]
    shade = 0.78 + 0.14 * normals[front]
    colors = np.stack([shade, shade, shade * 1.01], axis=1).clip(0.0, 1.0)
    triangles = _flat(surface.vertices, sign)[surface.faces[front]]
    panel.add_collection(
        PolyCollection(triangles, facecolors=colors, edgecolors=colors, linewidths=0.3, zorder=1)
    )


def _draw_bones(panel: Axes, hand: GloveFit, sign: float, color: str, label: str) -> None:
    rest = hand.model.rest_transforms
    ends = rest[:, :3, 3] + hand.model.skeleton.lengths[:, None] * rest[:, :3, 0]
    legend: str | None = label
    for number in range(len(BONES)):
        if number == PALM:
            continue
        line = _flat(np.stack([rest[number, :3, 3], ends[number]]), sign)
        panel.plot(*line.T, color=color, linewidth=1.4, marker=".", markersize=4, zorder=3, label=legend)
        legend = None


def _flat(points: Float[np.ndarray, "*N 3"], sign: float) -> NDArray[np.float64]:
    """Positions (N, 2) [m] in the picture, fingers up, from the back (1) or the palm (-1)."""
    return np.stack([-sign * points[..., 1], points[..., 0]], axis=-1)
