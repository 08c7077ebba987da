"""The page of a rig's score in pictures and tables: advice, figures of the work, cameras, the volume."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.app.page import Section, write_page
from handsim.space.rig import CameraRig
from train.reports.plot_style import BLUE, CARD, INK, LINE, PALE, SOFT, WARM, picture
from train.rig_advice.forecast import CameraLoss, Forecast
from train.rig_advice.rig_score import GRID, RigScore, VolumeMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAP_SIZE: Final = (9.6, 4.6)  # of the pictures [inch]
_WORTH_SIZE: Final = (8.4, 3.2)
_VIEWS: Final = (("from above", 0, 1), ("from the front", 0, 2))
_ARROW: Final = 0.3  # length of a camera's direction [m]
_NOTHING: Final = "-"
_COLUMNS: Final = (
    "by 2 [%]",
    "by 3 [%]",
    "missing [%]",
    "gaps [1/min]",
    "median [ms]",
    "p95 [ms]",
    "ghosts",
    "error [mm]",
)
COLUMNS_TOLD: Final = (
    "By 2, by 3: share of the marker-frames (every marker of every hand in every frame) that so many "
    "cameras see. Missing: those without a point, whether unseen, merged with a neighbor or with too few "
    "rays. Gaps: of one marker, and their lengths. Ghosts: points of a frame that are no marker, where rays "
    "meet by chance, in mirror images, and of reflections. Losses and reflections are those of `handsim "
    "simulate` with the same kind of work. Error: root mean square distance from the true center."
)
"""What the columns of both tables are."""


def write_rig_page(path: Path, score: RigScore) -> None:
    """Write the page: one HTML file with its pictures inside."""
    rig = score.rig
    seen = f"{score.whole.marker_frames:,} marker-frames of {score.work}"
    lead = f"{len(rig.cameras)} cameras of {rig.pictures()}; {seen}."
    items = "".join(f"<li>{escape(one)}</li>" for one in score.advice)
    sections = [
        Section("What to do", f"<ol>{items}</ol>"),
        Section("Hands at work", COLUMNS_TOLD, table=work_table(score), notes=[_error_note(score.whole)]),
        _cameras_section(score),
        _volume_section(score),
    ]
    write_page(path, sections, title=f"Rig {rig.name}", lead=lead)


def work_table(score: RigScore) -> list[list[str]]:
    """Figures of each kind of work and of all, the header first."""
    rows = [[kind, *_cells(one)] for kind, one in score.kinds.items()] if len(score.kinds) > 1 else []
    return [["work", *_COLUMNS], *rows, ["all", *_cells(score.whole)]]


def camera_table(score: RigScore) -> list[list[str]]:
    """What is left without each camera, the header first."""
    rows = []
    for number, one in enumerate(score.losses, 1):
        left = [_NOTHING] * len(_COLUMNS) if one.without is None else _cells(one.without)
        rows.append([str(number), f"{100 * one.seen:.1f}", f"{100 * one.needed:.1f}", *left])
    return [["without camera", "sees [%]", "needed [%]", *_COLUMNS], *rows]


def _cameras_section(score: RigScore) -> Section:
    draw = partial(_draw_worth, losses=score.losses, missing=score.whole.missing)
    text = (
        "The same hands without one camera. Sees, needed: share of the marker-frames that the camera sees, "
        "and that it sees and fewer than two others."
    )
    caption = "Marker-frames that are missing without each camera, and with all."
    return Section(
        "Cameras", text, table=camera_table(score), pictures=[(picture(_WORTH_SIZE, draw), caption)]
    )


def _volume_section(score: RigScore) -> Section:
    volume = score.volume
    draw = partial(_draw_map, volume=volume, rig=score.rig)
    caption = "Disks are cameras, numbered, with their directions. Colors are averages along the view."
    rows = [
        [
            title,
            f"{100 * shares.mean():.1f}",
            f"{100 * shares.min():.1f}",
            _point(volume.points[shares.argmin()]),
        ]
        for title, shares in (
            ("seen by two [%]", volume.seen_by_two),
            ("seen by three [%]", volume.seen_by_three),
        )
    ]
    if np.isfinite(volume.error).any():
        worst = int(np.nanargmax(volume.error))
        errors = 1e3 * volume.error
        rows.append(
            ["error [mm]", f"{np.nanmean(errors):.2f}", f"{errors[worst]:.2f}", _point(volume.points[worst])]
        )
    text = "Hands in poses of the work, set at each point of a grid in the volume, each alone."
    return Section(
        "The volume", text, table=[["a hand's markers", "mean", "worst", "at [m]"], *rows],
        pictures=[(picture(_MAP_SIZE, draw), caption)],
    )  # fmt: skip


def _draw_map(figure: Figure, volume: VolumeMap, rig: CameraRig) -> None:
    """Draw the volume colored by the share of markers that two cameras see, averaged along the view."""
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


def _draw_worth(figure: Figure, losses: list[CameraLoss], missing: float) -> None:
    """Draw what share of marker-frames is missing without each camera, beside what is missing with all."""
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


def _cells(one: Forecast) -> list[str]:
    return [
        f"{100 * one.seen_by_two:.1f}",
        f"{100 * one.seen_by_three:.1f}",
        f"{100 * one.missing:.1f}",
        f"{one.gaps:.1f}",
        _number(1e3 * one.gap_median, 0),
        _number(1e3 * one.gap_p95, 0),
        f"{one.ghosts:.3f}",
        _number(1e3 * one.error.mean, 3),
    ]


def _error_note(one: Forecast) -> str:
    if not np.isfinite(one.error.mean):
        return "No marker has a point."
    axes = ", ".join(
        f"{1e3 * axis:.3f} mm along ({' '.join(f'{part:.2f}' for part in direction + 0.0)})"
        for axis, direction in zip(one.error.axes, one.error.directions, strict=True)
    )
    return f"The error as an ellipsoid, standard deviations: {axes}."


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else _NOTHING


def _point(point: np.ndarray) -> str:
    return " ".join(f"{one:.2f}" for one in point + 0.0)
