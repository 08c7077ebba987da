"""The pictures of a rig's score: the volume with its cameras from two sides, and each camera's worth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.space.cameras import CameraRig
from train.reports.plot_style import BLUE, CARD, INK, LINE, PALE, SOFT, WARM
from train.rig_advice.forecast import CameraLoss
from train.rig_advice.volume_map import GRID, VolumeMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAP_SIZE: Final = (9.6, 4.6)
"""Of the map [inch]."""
WORTH_SIZE: Final = (8.4, 3.2)
_VIEWS: Final = (("from above", 0, 1), ("from the front", 0, 2))
_ARROW: Final = 0.3  # length of a camera's direction [m]


def draw_map(figure: Figure, volume: VolumeMap, rig: CameraRig) -> None:
    """Draw the volume colored by the share of markers that two cameras see, averaged along the view.

    Args:
        figure: Where to draw, of `MAP_SIZE`.
        volume: The map.
        rig: Its cameras.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    panels = figure.subplots(1, 2)
    colors = LinearSegmentedColormap.from_list("seen", [WARM, "#d9a441", PALE, BLUE])
    norm = Normalize(0, 100)
    shares = 100 * volume.seen_by_two.reshape(GRID, GRID, GRID)
    points = volume.points.reshape(GRID, GRID, GRID, 3)
    for panel, (title, right, up) in zip(panels, _VIEWS, strict=True):
        flat = shares.mean(axis=3 - right - up)
        panel.pcolormesh(
            np.unique(points[..., right]), np.unique(points[..., up]), flat.T,
            cmap=colors, norm=norm, shading="nearest", rasterized=False,
        )  # fmt: skip
        _draw_cameras(panel, rig, right, up)
        panel.set_title(title, color=SOFT)
        panel.set_xlabel("x [m]")
        panel.set_ylabel(f"{'xyz'[up]} [m]")
        panel.set_aspect("equal", adjustable="datalim")
    bar = figure.colorbar(ScalarMappable(norm, colors), ax=panels, shrink=0.7)
    bar.set_label("markers seen by two cameras [%]")
    bar.outline.set_visible(False)


def draw_worth(figure: Figure, losses: list[CameraLoss], missing: float) -> None:
    """Draw what is missing without each camera, beside what is missing with all.

    Args:
        figure: Where to draw, of `WORTH_SIZE`.
        losses: Of each camera.
        missing: Share of marker-frames that is missing with all cameras.
    """
    panel = figure.subplots()
    numbers = np.arange(1, len(losses) + 1)
    without = [100.0 if one.without is None else 100 * one.without.missing for one in losses]
    panel.bar(numbers, without, color=PALE)
    panel.axhline(100 * missing, color=WARM, linewidth=1.2)
    panel.annotate(
        "with all cameras",
        (numbers[-1] + 0.5, 100 * missing),
        color=WARM,
        ha="right",
        va="bottom",
        fontsize=8,
    )
    panel.set_xticks(numbers)
    panel.set_xlabel("without camera")
    panel.set_ylabel("marker-frames missing [%]")


def _draw_cameras(panel: Axes, rig: CameraRig, right: int, up: int) -> None:
    for number, pose in enumerate(rig.T_world_camera, 1):
        begin, ahead = pose[[right, up], 3], pose[[right, up], 2]
        end = begin + _ARROW * ahead
        panel.plot(*np.stack([begin, end]).T, color=LINE, linewidth=2.0, zorder=2)
        panel.plot(*begin, "o", color=CARD, markeredgecolor=INK, markersize=11, zorder=3)
        panel.annotate(
            str(number), begin, ha="center", va="center_baseline", fontsize=6.5, color=INK, zorder=4
        )
