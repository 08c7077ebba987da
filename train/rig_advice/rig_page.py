"""The page of a rig's score, and its tables: advice, figures of the work, cameras, the volume."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from handsim.app.page import Section, write_page
from train.reports.plot_style import picture
from train.rig_advice.forecast import Forecast
from train.rig_advice.rig_picture import MAP_SIZE, WORTH_SIZE, draw_map, draw_worth
from train.rig_advice.rig_score import RigScore
from train.rig_advice.rig_sentences import sentences

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
    "rays; a point begins with three rays and goes on with two. Gaps: of one marker, and their lengths. "
    "Ghosts: points of a frame that are no marker, where rays meet by chance and in mirror images. Error: "
    "root mean square distance from the true center."
)
"""What the columns of both tables are."""


def write_rig_page(path: Path, score: RigScore, *, work: str) -> None:
    """Write the page: one HTML file with its pictures inside.

    Args:
        path: The file.
        score: What is known of the rig.
        work: Whose hands did what, in words.
    """
    rig = score.rig
    lead = (
        f"{len(rig.positions)} cameras, field of view {np.rad2deg(rig.field_of_view):.0f} degrees, "
        f"{rig.resolution} pixels across it; {score.whole.marker_frames:,} marker-frames of {work}."
    )
    items = "".join(f"<li>{escape(one)}</li>" for one in sentences(score))
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
    draw = partial(draw_worth, losses=score.losses, missing=score.whole.missing)
    text = (
        "The same hands without one camera. Sees, needed: share of the marker-frames that the camera sees, "
        "and that it sees and fewer than two others."
    )
    caption = "Marker-frames that are missing without each camera, and with all."
    return Section(
        "Cameras", text, table=camera_table(score), pictures=[(picture(WORTH_SIZE, draw), caption)]
    )


def _volume_section(score: RigScore) -> Section:
    volume = score.volume
    draw = partial(draw_map, volume=volume, rig=score.rig)
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
        pictures=[(picture(MAP_SIZE, draw), caption)],
    )  # fmt: skip


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
