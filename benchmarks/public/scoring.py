"""Scores of results: labels are counted as in the tables of labeling and tracking, joints against the truth.

A slot is right when it holds the right point, or rightly none; a frame when all its slots and points are
(`train.evaluation`). Joint errors are over joints that were given; what was not given shows in
`posed` and `within_5mm`, where it counts as wrong. A capture without results counts as zero.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from rich.table import Table

from benchmarks.public.answers import Answers
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES
from benchmarks.public.manifest import Benchmark, BenchmarkCapture, label_names
from benchmarks.public.results import find_results, read_result
from benchmarks.record import number_table
from handsim import HandSimWarning, __version__
from handsim.hand.model import KEYPOINT_NAMES
from handsim.hand.shape import NUM_KEYPOINTS
from train.evaluation import count_labels

NEAR: Final = 0.005
"""Distance from the truth within which a joint counts as found [m]."""
POSE_SHARES: Final = ("posed", "within_5mm")
LABEL_SHARES: Final = (
    *("slot_accuracy", "point_accuracy", "frame_accuracy"),
    *("occlusion_ratio", "occlusion_precision", "occlusion_recall"),
    *("ghost_ratio", "ghost_precision", "ghost_recall", "macro_f1"),
)
_MOST_TOLD: Final = 5
_COLUMNS: Final = {
    "frame_accuracy": "frames [%]",
    "slot_accuracy": "slots [%]",
    "point_accuracy": "points [%]",
    "macro_f1": "F1 [%]",
    "posed": "posed [%]",
    "mpjpe": "MPJPE [mm]",
    "within_5mm": "5 mm [%]",
    "angle_error": "angles [deg]",
}
_UNITS: Final = {"mpjpe": ("mpjpe_mm", 1e3), "angle_error": ("angle_error_deg", float(np.rad2deg(1.0)))}
"""Figures that are no shares: their names in JSON, and their reported units."""


@dataclass(frozen=True, slots=True, eq=False)
class CaptureScore:
    """The score of one capture."""

    capture: BenchmarkCapture
    figures: dict[str, float]
    """Shares in [0, 1] of `train.evaluation.count_labels`; `posed`, the share of joints that were
    given; `within_5mm`, of those that are right to 5 mm; `mpjpe`, mean distance of joints from the truth [m];
    `angle_error`, mean absolute error of joint angles [rad]. NaN where nothing was counted."""
    joint_errors: Float[np.ndarray, "21"]
    """Mean distance of each joint of both hands from the truth [m]; NaN where it was never given."""
    missing: bool = False
    """There is no result of this capture."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The score of results."""

    benchmark: Benchmark
    captures: tuple[CaptureScore, ...]

    def mean(self, *, difficulty: str | None = None, kind: str | None = None) -> dict[str, float]:
        """Means over captures of one difficulty or kind, or over all; NaN are left out."""
        chosen = [
            one
            for one in self.captures
            if difficulty in (None, one.capture.difficulty) and kind in (None, one.capture.kind)
        ]
        return {name: _mean([one.figures[name] for one in chosen]) for name in self.captures[0].figures}

    def joint_errors(self) -> Float[np.ndarray, "21"]:
        """Mean over captures of each joint's error [m]."""
        errors = np.array([one.joint_errors for one in self.captures])
        return np.array([_mean(column) for column in errors.T])


def score_results(benchmark: Benchmark, results: Path, *, done: Callable[[], None] | None = None) -> Score:
    """Compare a folder of results with the truth; `done` is called after each capture.

    Raises:
        BenchmarkError: A file is damaged or does not fit its capture.

    Warns:
        HandSimWarning: A capture has no results and counts as zero; a file is of no capture.
    """
    names = label_names()
    found, unknown = find_results(results, [one.name for one in benchmark.captures])
    _tell(results, [one.name for one in benchmark.captures if one.name not in found], unknown)
    scores: list[CaptureScore | None] = []
    for one in benchmark.captures:
        if one.name in found:
            capture, truth = benchmark.capture(one.name), benchmark.truth(one.name)
            result = read_result(found[one.name], capture, names)
            present = np.isfinite(capture.positions[..., 0])
            scores.append(score_capture(one, result, truth, present, len(names)))
        else:
            scores.append(None)
        if done is not None:
            done()
    posed = any(score is not None and not np.isnan(score.figures["posed"]) for score in scores)
    return Score(
        benchmark,
        tuple(_completed(one, score, posed) for one, score in zip(benchmark.captures, scores, strict=True)),
    )


def score_capture(
    capture: BenchmarkCapture,
    result: Answers,
    truth: Answers,
    present: Bool[np.ndarray, "T N"],
    num_labels: int,
) -> CaptureScore:
    """Compare a result with the truth of its capture; `present` is where it has points."""
    frames = (
        (given[here].astype(np.int64), np.full(here.sum(), np.nan), true[here].astype(np.int64))
        for given, true, here in zip(result.labels, truth.labels, present, strict=True)
    )
    labels = count_labels(tuple(map(str, range(num_labels))), frames).figures
    errors = np.full(NUM_KEYPOINTS, np.nan)
    posed, near, mpjpe, angle = (np.nan,) * 4
    if result.joints is not None and truth.joints is not None:
        apart = np.linalg.norm(result.joints.astype(np.float64) - truth.joints, axis=-1)
        there = np.isfinite(apart)
        posed, near = float(there.mean()), float((apart <= NEAR).mean())
        mpjpe = _mean(apart)
        errors = np.array([_mean(apart[..., joint]) for joint in range(NUM_KEYPOINTS)])
    if result.angles is not None and truth.angles is not None:
        angle = _mean(np.abs(result.angles.astype(np.float64) - truth.angles))
    figures = {
        **{name: labels[name] for name in LABEL_SHARES},
        "posed": posed,
        "within_5mm": near,
        "mpjpe": mpjpe,
        "angle_error": angle,
    }
    return CaptureScore(capture, figures, errors)


def score_table(score: Score) -> Table:
    """Means by difficulty, by kind and over all captures, in percent, millimeters and degrees."""
    table = number_table(f"{BENCHMARK}, {score.benchmark.size}", ["captures"], _COLUMNS.values())
    rows = {name: score.mean(difficulty=name) for name in difficulties_of(score)}
    rows |= {
        kind: score.mean(kind=kind) for kind in dict.fromkeys(one.capture.kind for one in score.captures)
    }
    for row, means in {**rows, "all": score.mean()}.items():
        values = {name: _UNITS.get(name, ("", 100.0))[1] * means[name] for name in _COLUMNS}
        table.add_row(row, *("-" if np.isnan(value) else f"{value:.2f}" for value in values.values()))
    return table


def difficulties_of(score: Score) -> tuple[str, ...]:
    """The difficulties of a benchmark's captures, the easiest first."""
    there = {one.capture.difficulty for one in score.captures}
    return (*(name for name in DIFFICULTIES if name in there), *sorted(there - DIFFICULTIES.keys()))


def score_record(score: Score, results: str) -> dict[str, Any]:
    """All figures for JSON: shares in [0, 1], errors in mm and degrees; None where nothing was counted."""
    return {
        "benchmark": BENCHMARK,
        "size": score.benchmark.size,
        "handsim": __version__,
        "results": results,
        "missing": [one.capture.name for one in score.captures if one.missing],
        "all": _record(score.mean()),
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


def _completed(capture: BenchmarkCapture, score: CaptureScore | None, posed: bool) -> CaptureScore:
    """A score with zeros for what these results lack; `posed` if those of any capture have joints."""
    zeros = dict.fromkeys(POSE_SHARES, 0.0) if posed else {}
    if score is None:
        shares = dict.fromkeys(LABEL_SHARES, 0.0)
        # Those of the capture itself are no merit of a result.
        shares |= dict.fromkeys(("occlusion_ratio", "ghost_ratio"), np.nan)
        figures = shares | dict.fromkeys((*POSE_SHARES, "mpjpe", "angle_error"), np.nan) | zeros
        return CaptureScore(capture, figures, np.full(NUM_KEYPOINTS, np.nan), missing=True)
    if np.isnan(score.figures["posed"]):
        return dataclasses.replace(score, figures=score.figures | zeros)
    return score


def _tell(results: Path, missing: Sequence[str], unknown: Sequence[str]) -> None:
    """Tell of captures without results, and of files of no capture."""
    if missing:
        count = f"{len(missing)} capture{'s' * (len(missing) != 1)}"
        told = f"{results}: no results of {count}, which count as zero: {_few(missing)}"
        warnings.warn(told, HandSimWarning, stacklevel=3)
    if unknown:
        told = f"{results}: not counted, because they are of no capture of this benchmark: {_few(unknown)}"
        warnings.warn(told, HandSimWarning, stacklevel=3)


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_TOLD} more" if len(names) > _MOST_TOLD else ""
    return ", ".join(names[:_MOST_TOLD]) + more


def _mean(values: Sequence[float] | Float[np.ndarray, "*shape"]) -> float:
    """Mean of what is not NaN; NaN if there is nothing."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.nanmean(array)) if np.isfinite(array).any() else np.nan
