"""Scores as tables and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from rich.table import Table

from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES
from benchmarks.public.scoring import Score
from benchmarks.record import number_table
from handsim import __version__
from handsim.hand.model import KEYPOINT_NAMES

_FIGURES: Final = {
    "frame_accuracy": "frames [%]",
    "slot_accuracy": "slots [%]",
    "point_accuracy": "points [%]",
    "macro_f1": "F1 [%]",
    "posed": "posed [%]",
    "mpjpe": "MPJPE [mm]",
    "within_5mm": "5 mm [%]",
    "angle_error": "angles [deg]",
}
"""Columns of the first table."""
_UNITS: Final = {"mpjpe": ("mpjpe_mm", 1e3), "angle_error": ("angle_error_deg", float(np.rad2deg(1.0)))}
"""Figures that are no shares: their names in JSON, and their reported units."""
ALL: Final = "all"


def score_tables(score: Score) -> list[Table]:
    """By difficulty; frames right by kind and difficulty; errors of each joint, if there are any."""
    difficulties = difficulties_of(score)
    title = f"{BENCHMARK}, {score.benchmark.size}: right labels, joints found, errors"
    first = number_table(title, ["difficulty"], _FIGURES.values())
    for name in (*difficulties, ALL):
        means = score.mean(difficulty=None if name == ALL else name)
        first.add_row(name, *(figure_text(figure, means[figure]) for figure in _FIGURES))
    second = number_table("frames right by kind [%]", ["kind"], (*difficulties, ALL))
    for kind in dict.fromkeys(one.capture.kind for one in score.captures):
        right = [score.mean(difficulty=name, kind=kind)["frame_accuracy"] for name in (*difficulties, None)]
        second.add_row(kind, *(figure_text("frame_accuracy", share) for share in right))
    errors = [score.joint_errors(difficulty=name) for name in (*difficulties, None)]
    if np.isnan(errors).all():
        return [first, second]
    third = number_table("distance of joints from the truth [mm]", ["joint"], (*difficulties, ALL))
    for joint, row in zip(KEYPOINT_NAMES, np.transpose(errors), strict=True):
        third.add_row(joint, *(figure_text("mpjpe", value) for value in row))
    return [first, second, third]


def difficulties_of(score: Score) -> tuple[str, ...]:
    """The difficulties of a benchmark's captures, the easiest first."""
    there = {one.capture.difficulty for one in score.captures}
    return (*(name for name in DIFFICULTIES if name in there), *sorted(there - DIFFICULTIES.keys()))


def figure_text(name: str, value: float) -> str:
    """A figure in percent, millimeters or degrees; a dash where nothing was counted."""
    return "-" if np.isnan(value) else f"{_UNITS[name][1] * value if name in _UNITS else 100 * value:.2f}"


def score_record(score: Score, results: str) -> dict[str, Any]:
    """All figures for JSON: shares in [0, 1], errors in mm and degrees; None where nothing was counted.

    Args:
        score: The score.
        results: What was scored.
    """
    return {
        "benchmark": BENCHMARK,
        "size": score.benchmark.size,
        "handsim": __version__,
        "results": results,
        "missing": [one.capture.name for one in score.captures if one.missing],
        ALL: _record(score.mean()),
        "by_difficulty": {name: _record(score.mean(difficulty=name)) for name in difficulties_of(score)},
        "joint_errors_mm": _errors(score.joint_errors()),
        "captures": {
            one.capture.name: _record(one.figures) | {"joint_errors_mm": _errors(one.joint_errors)}
            for one in score.captures
        },
    }


def _record(figures: Mapping[str, float]) -> dict[str, float | None]:
    named = {}
    for name, value in figures.items():
        key, factor = _UNITS.get(name, (name, 1.0))
        named[key] = None if np.isnan(value) else float(factor * value)
    return named


def _errors(errors: np.ndarray) -> dict[str, float | None]:
    values = (None if np.isnan(value) else 1e3 * float(value) for value in errors)
    return dict(zip(KEYPOINT_NAMES, values, strict=True))
