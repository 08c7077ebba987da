"""Tables of tracking results, with the paper's figures in separate rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from rich.markup import escape
from rich.table import Table

from track.evaluation.comparison import Measurement
from track.evaluation.paper import CAMERAS, HAN, TABLE5, TABLE7
from train.simulation.room_settings import KINDS

_HEAD: Final = ("method", "hands")


def print_table5(measured: Sequence[Measurement], *, with_paper: bool) -> Table:
    """Frames all of whose labels are right [%], one column per capture; blank where nothing was measured."""
    table = _table("Table 5: frames all of whose labels are right [%]", KINDS)
    if with_paper:
        for method, shares in TABLE5.items():
            table.add_row(method, "calibrated", *(_percent(shares[kind]) for kind in KINDS))
        table.add_section()
    for (method, users), row in _rows(measured):
        right = {one.capture: one.report.figures()["right"] for one in row}
        table.add_row(method, users, *(_percent(right.get(kind, np.nan)) for kind in KINDS))
    return table


def print_table7(measured: Sequence[Measurement], *, with_paper: bool) -> Table:
    """Share of valid frames, and of right ones among them [%], one column per capture."""
    table = _table("Table 7: frames whose poses fit / right ones of these [%]", KINDS)
    if with_paper:
        for users, shares in TABLE7.items():
            table.add_row(HAN, users, *(_pair(*shares[kind]) for kind in KINDS))
        table.add_section()
    for (method, users), row in _rows(measured):
        figures = [one.report.figures() for one in row]
        table.add_row(method, users, *(_pair(one["valid"], one["right_of_valid"]) for one in figures))
    return table


def print_cameras(measured: Sequence[Measurement], missing: float, *, rig: str, with_paper: bool) -> Table:
    """Results with few cameras.

    Args:
        measured: Results on one capture.
        missing: Share of markers without a point.
        rig: Name of the camera rig.
        with_paper: Whether to add the paper's row.
    """
    title = f"Rig {rig}: {_percent(missing)} % of the markers missing"
    table = _table(title, ("fit [%]", "right of these [%]", "both [%]", "joints [mm]", "angles [deg]"))
    if with_paper:
        both = CAMERAS[0] * CAMERAS[1]
        table.add_row(HAN, "calibrated", *map(_percent, (*CAMERAS, both)), "", "")
        table.add_section()
    for (method, users), row in _rows(measured):
        figures = row[0].report.figures()
        shares = (_percent(figures[name]) for name in ("valid", "right_of_valid", "valid_and_right"))
        table.add_row(method, users, *shares, _length(figures["joint_error"]), _angle(figures["angle_error"]))
    return table


def print_errors(measured: Sequence[Measurement]) -> tuple[Table, Table]:
    """Errors of joints [mm] and joint angles [deg] by the number of missing markers, over all captures."""
    bounds = list(measured[0].report.by_occlusion())
    words = ["none", *(f"{low}-{high}" for low, high in bounds[1:-1]), f"{bounds[-1][0]} or more"]
    what = "by markers that a hand lacks"
    joints = _table(f"Mean distance of joints from the truth {what} [mm]", words)
    angles = _table(f"Mean error of joint angles {what} [deg]", words)
    for head, row in _rows(measured):
        errors = [_mean_errors([one.report.by_occlusion()[bound] for one in row]) for bound in bounds]
        joints.add_row(*head, *(_length(joint) for joint, _ in errors))
        angles.add_row(*head, *(_angle(angle) for _, angle in errors))
    return joints, angles


def print_times(measured: Sequence[Measurement]) -> Table:
    """Time per frame [ms], over all captures."""
    table = _table("Time per frame on this machine [ms]", ("median", "p99"))
    for head, row in _rows(measured):
        seconds = np.concatenate([one.report.seconds for one in row])
        table.add_row(*head, *(f"{1e3 * np.quantile(seconds, q):.2f}" for q in (0.5, 0.99)))
    return table


def print_trials(measured: Sequence[Measurement]) -> Table:
    """Frames until all is right, at first and after a second without points, over all captures."""
    columns = ("first: median", "p90", "in 1 s [%]", "hidden: median", "p90", "in 1 s [%]")
    table = _table("Frames until all is right, from random frames and after a second without points", columns)
    for (method, users), row in _rows(measured):
        waits = [
            np.concatenate([one.initialization for one in row]),
            np.concatenate([one.recovery for one in row]),
        ]
        table.add_row(method, users, *(cell for wait in waits for cell in _quantiles(wait)))
    return table


def _table(title: str, columns: Iterable[str]) -> Table:
    table = Table(title=escape(title))
    for name in _HEAD:
        table.add_column(name, no_wrap=True)
    for name in columns:
        table.add_column(escape(name.replace("-", " ") if name in KINDS else name), justify="right")
    return table


def _rows(measured: Sequence[Measurement]) -> list[tuple[tuple[str, str], list[Measurement]]]:
    """Results by method and hands, in order."""
    rows: dict[tuple[str, str], list[Measurement]] = {}
    for one in measured:
        rows.setdefault((one.method, one.users), []).append(one)
    return list(rows.items())


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{100 * share:.2f}"


def _pair(valid: float, right: float) -> str:
    return f"{_percent(valid)} / {_percent(right) or '-'}"


def _length(meters: float) -> str:
    return "" if np.isnan(meters) else f"{1e3 * meters:.2f}"


def _angle(radians: float) -> str:
    return "" if np.isnan(radians) else f"{np.rad2deg(radians):.2f}"


def _mean_errors(parts: Sequence[tuple[int, float, float]]) -> tuple[float, float]:
    """Errors of joints [m] and joint angles [rad] over several captures, weighted by the number of poses."""
    counted = [part for part in parts if part[0]]
    if not counted:
        return np.nan, np.nan
    weights = np.array([part[0] for part in counted])
    joint, angle = weights @ np.array([part[1:] for part in counted]) / weights.sum()
    return float(joint), float(angle)


def _quantiles(frames: Float[np.ndarray, "S"]) -> tuple[str, str, str]:
    """Median, 90th percentile and share of successful trials; 'never' for a quantile that was not reached."""
    if not len(frames):
        return "", "", ""
    never = np.where(np.isnan(frames), np.inf, frames)
    found = (float(np.quantile(never, q, method="higher")) for q in (0.5, 0.9))
    words = [f"{value:.0f}" if np.isfinite(value) else "never" for value in found]
    return words[0], words[1], _percent(float(np.isfinite(never).mean()))
