"""One step of a sweep, in whatever process: a labeler is trained, or a capture is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from handsim._version import __version__
from handsim.errors import HandSimError
from handsim.files.json_files import load_json, save_json
from track.evaluation.sweep.cells import MeasureStep, TrainStep
from track.evaluation.take_evaluation import evaluate_tracker, measured_users, true_users
from track.tracker import Tracker
from train.evaluation.labeler_evaluation import evaluate_takes
from train.glove_labeler import labeler_for_glove
from train.loop import train_labeler
from train.simulation.takes import simulate_take

SETS: Final = "sets"
LABELERS: Final = "labelers"
MEASURED: Final = "measured"
LABELING: Final = (
    "slot_accuracy",
    "frame_accuracy",
    "occlusion_precision",
    "occlusion_recall",
    "ghost_precision",
    "ghost_recall",
)
"""Figures of labels, shares of 1."""
TRACKING: Final = ("frames_right", "frames_valid", "joint_error_mm", "angle_error_deg")
"""Figures of tracking: shares of 1, and mean errors."""
SEEN: Final = "markers_seen"
"""Share of the hands' markers that the cameras see."""
_VERSION: Final = "handsim"


def train_one(steps: Sequence[TrainStep], out: Path, number: int) -> int:
    """Train a labeler on one thread, or go on with it."""
    step = steps[number]
    train_labeler(out / SETS / step.set.name, step.config, out / LABELERS / step.name, threads=1)
    return number


def measure_one(steps: Sequence[MeasureStep], out: Path, number: int) -> int:
    """Simulate a capture, label and track it, and write the figures, or why there are none."""
    step = steps[number]
    try:
        content: dict[str, Any] = {"figures": _figures(step, out)}
    except HandSimError as error:  # the other captures go on
        content = {"error": str(error)}
    path = measured_file(out, step)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_json(path, {_VERSION: __version__, **content})
    return number


def measured_file(out: Path, step: MeasureStep) -> Path:
    """Where the figures of a step are."""
    return out / MEASURED / f"{step.name}.json"


def load_figures(out: Path, step: MeasureStep) -> tuple[dict[str, float | None], str]:
    """The figures of a step and the version that measured them; none and "" where it is to be done.

    Raises:
        DatasetError: The file is damaged.
    """
    path = measured_file(out, step)
    if not path.is_file():
        return {}, ""
    content = load_json(path)
    figures = content.get("figures")
    if not isinstance(figures, dict):
        return {}, ""
    numbers = {
        name: float(figures[name]) if isinstance(figures.get(name), int | float) else None
        for name in (SEEN, *LABELING, *TRACKING)
        if name in figures
    }
    return numbers, str(content.get(_VERSION))


def load_error(out: Path, step: MeasureStep) -> str:
    """Why a step has no figures, "" if it has."""
    path = measured_file(out, step)
    return str(load_json(path).get("error", "")) if path.is_file() else ""


def _figures(step: MeasureStep, out: Path) -> dict[str, float]:
    trained = None if step.labeler is None else out / LABELERS / step.labeler.name
    labeler = labeler_for_glove(step.capture.glove, trained)
    take = simulate_take(step.capture)
    figures = {SEEN: float(take.markers_present().mean())}
    labeled = evaluate_takes(labeler, [take]).figures
    figures |= {name: float(labeled[name]) for name in LABELING}
    if step.track is not None:
        bare = take.without_body()  # as an optical system that tracks it itself
        users = true_users(bare) if step.track.users == "calibrated" else measured_users(bare, labeler)
        tracked = evaluate_tracker(bare, users, Tracker(users, labeler, config=step.track.tracker)).figures()
        values = (
            tracked["right"],
            tracked["valid"],
            1e3 * tracked["joint_error"],
            math.degrees(tracked["angle_error"]),
        )
        figures |= dict(zip(TRACKING, values, strict=True))
    return figures
