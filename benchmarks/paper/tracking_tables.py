"""The paper's tables of tracking, with its figures in separate rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from benchmarks.paper.comparison import (
    NEED_FIRST_LABELS,
    OURS,
    PAPERS_LOOP,
    TRIALS,
    USERS,
    Measurement,
    compare_trackers,
    measure_with_body,
    trackers,
)
from benchmarks.paper.printed import CAMERAS, CAMERAS_FRAMES, HAN, TABLE5, TABLE7
from benchmarks.record import Figures, number_table, save_figures
from gloves import Take
from handsim.app.messages import progress_bar
from train import SimulateSettings, load_labeler, simulate_take
from train.simulation.scenes import KINDS

_HEAD: Final = ("method", "hands")
_PAPERS_GLOVE: Final = "dense19"
_WITH_BODY: Final = "hand-controller"
_METHOD_KEYS: Final = dict(
    zip((OURS, PAPERS_LOOP, *NEED_FIRST_LABELS), ("", "loop_", "nearest_", "hungarian_"), strict=True)
)
_USER_KEYS: Final = {"calibrated": "true", "uncalibrated": "size"}


@dataclass(frozen=True, slots=True)
class TableConfig:
    """Settings of a table of tracking."""

    glove: str = _PAPERS_GLOVE
    """Marker layout: a shipped name or the path of a .toml file."""
    labeler: Path | None = None
    """Folder of a trained labeler, or an exported .onnx file; the shipped one when not given."""
    num_frames: int | None = None
    """Frames of each capture; the paper's numbers when not given."""
    seed: int = 0
    """Seed of the captures and of random choices in tracking; 0 gives the twins."""
    save: str | None = None
    """Name under which the figures are kept in benchmarks/figures, such as table5_seed1."""


_Config = Annotated[TableConfig, tyro.conf.arg(name="")]


def table5(config: _Config) -> None:
    """Trackers on the twins of the paper's captures: frames all of whose labels are right; errors.

    Args:
        config: Settings of the measurement.
    """
    takes, measured = _measure(config, trials=TRIALS)
    with_body = _measure_with_body(takes[_WITH_BODY], config)
    console = Console()
    console.print(print_table5([*measured, *with_body], with_paper=config.glove == _PAPERS_GLOVE))
    console.print(*print_errors(measured), print_trials(measured), sep="\n")
    save_figures(config.save, table5_figures(measured) | body_figures(with_body))


def table7(config: _Config) -> None:
    """Trackers with calibrated hands and without: frames whose poses fit, and those of them that are right.

    Args:
        config: Settings of the measurement.
    """
    _, measured = _measure(config)
    Console().print(print_table7(measured, with_paper=config.glove == _PAPERS_GLOVE))
    save_figures(config.save, table7_figures(measured))


def cameras(config: _Config, rig: str = "six") -> None:
    """Trackers on hands in the air before fewer cameras: the paper switches off more than half of its 16.

    Args:
        config: Settings of the measurement; the paper has 2875 frames.
        rig: Camera rig: a shipped name or the path of a .toml file.
    """
    num_frames = CAMERAS_FRAMES if config.num_frames is None else config.num_frames
    twin = SimulateSettings("single-hand", num_frames, config.glove, rig, config.seed)
    takes, measured = _measure_on({"single-hand": twin}, config)
    missing = 1.0 - takes["single-hand"].markers_present().mean()
    with_paper = config.glove == _PAPERS_GLOVE
    Console().print(print_cameras(measured, missing, rig=rig, with_paper=with_paper))
    what = f"share of markers missing before rig {rig} [%]"
    save_figures(config.save, cameras_figures(measured) | {"missing": (what, 100 * missing)})


TRACKING_TABLES: Final[dict[str, Callable[..., None]]] = {
    "table5": table5,
    "table7": table7,
    "cameras": cameras,
}


def _measure(config: TableConfig, *, trials: int = 0) -> tuple[dict[str, Take], list[Measurement]]:
    """Simulate captures of all kinds, and run all trackers over them."""
    twins: dict[str, SimulateSettings] = {
        kind: SimulateSettings(kind, config.num_frames, config.glove, seed=config.seed) for kind in KINDS
    }
    return _measure_on(twins, config, trials=trials)


def _measure_on(
    twins: Mapping[str, SimulateSettings], config: TableConfig, *, trials: int = 0
) -> tuple[dict[str, Take], list[Measurement]]:
    """Simulate captures, and run all trackers over them without their bodies, which most cannot track."""
    network = load_labeler(config.glove, config.labeler)
    takes: dict[str, Take] = {}
    with progress_bar("captures") as bar:
        bar(0, len(twins))
        for kind, twin in twins.items():
            takes[kind] = simulate_take(settings=twin)
            bar.advance()
    bare = {kind: take.without_body() for kind, take in takes.items()}
    frames = sum(take.num_frames for take in takes.values())
    with progress_bar("frames") as bar:
        bar(0, frames * len(USERS) * len(trackers(network, config.seed)))
        measured = compare_trackers(bare, network, seed=config.seed, trials=trials, done=bar.advance)
    return takes, measured


def _measure_with_body(take: Take, config: TableConfig) -> list[Measurement]:
    """Our tracker on the capture whose object has markers, with the object tracked as well."""
    network = load_labeler(config.glove, config.labeler)
    with progress_bar("frames") as bar:
        bar(0, take.num_frames * len(USERS))
        return measure_with_body(_WITH_BODY, take, network, done=bar.advance)


def table5_figures(measured: Sequence[Measurement]) -> Figures:
    """The figures of Table 5 and of the tables below it."""
    kept: Figures = {}
    for key, who, row in _keyed(measured):
        right = [100 * one.report.figures()["right"] for one in row]
        errors = [
            _mean_errors([one.report.by_occlusion()[bound] for one in row])
            for bound in row[0].report.by_occlusion()
        ]
        kept[f"right_{key}"] = f"frames all of whose labels are right [%], {_captures(row)}: {who}", right
        kept[f"errors_{key}"] = (
            f"mean errors of joints [mm], angles [deg], by markers missing: none, 1-2, 3-5, 6 or more: {who}",
            [[1e3 * joint, np.rad2deg(angle)] for joint, angle in errors],
        )
        if row[0].method == PAPERS_LOOP and row[0].users == "calibrated" and len(row[0].recovery):
            waits = [np.concatenate([one.initialization for one in row])]
            waits.append(np.concatenate([one.recovery for one in row]))
            never = [np.where(np.isnan(wait), np.inf, wait) for wait in waits]
            kept["loop_starts"] = (
                "the paper's loop, frames until all is right: median, p90 from nothing, after a dark second",
                np.ravel([np.quantile(wait, [0.5, 0.9], method="higher") for wait in never]),
            )
    return kept


def body_figures(measured: Sequence[Measurement]) -> Figures:
    """The figures of our tracker with a body beside the hands."""
    return {
        f"body_{_USER_KEYS[one.users]}": (
            f"{one.capture}, frames all of whose labels are right [%]: {one.method}, {one.users}",
            100 * one.report.figures()["right"],
        )
        for one in measured
    }


def table7_figures(measured: Sequence[Measurement]) -> Figures:
    """The figures of Table 7."""
    kept: Figures = {}
    for key, who, row in _keyed(measured):
        figures = [one.report.figures() for one in row]
        shares = [[100 * one["valid"], 100 * one["right_of_valid"]] for one in figures]
        kept[key] = f"valid frames, right ones of these [%], {_captures(row)}: {who}", shares
    return kept


def cameras_figures(measured: Sequence[Measurement]) -> Figures:
    """The figures of few cameras."""
    kept: Figures = {}
    for key, who, (one,) in _keyed(measured):
        figures = one.report.figures()
        shares = [100 * figures[name] for name in ("valid", "right_of_valid", "valid_and_right")]
        errors = [1e3 * figures["joint_error"], np.rad2deg(figures["angle_error"])]
        what = f"valid, right of these, both [%]; joints [mm], joint angles [deg]: {who}"
        kept[key] = what, [*shares, *errors]
    return kept


def _keyed(measured: Sequence[Measurement]) -> Iterable[tuple[str, str, list[Measurement]]]:
    """Results by method and hands: their key, the words for it, and what was measured."""
    for (method, users), row in _rows(measured):
        yield f"{_METHOD_KEYS[method]}{_USER_KEYS[users]}", f"{method}, {users}", row


def _captures(row: Sequence[Measurement]) -> str:
    return ", ".join(one.capture for one in row)


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
    return number_table(title, _HEAD, (name.replace("-", " ") if name in KINDS else name for name in columns))


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
