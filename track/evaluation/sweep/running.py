"""A sweep, step after step: training sets, labelers, captures; what is there already is not done again."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from handsim._version import __version__
from handsim.app.interrupts import Stopped
from handsim.app.workers import Job, LocalProcesses, check_workers, run_jobs
from handsim.errors import HandSimWarning
from handsim.files.json_files import claim
from track.evaluation.sweep.cells import Cell, MeasureStep, SetStep, cells_of, steps_of
from track.evaluation.sweep.results import Row
from track.evaluation.sweep.steps import (
    LABELERS,
    MEASURED,
    SETS,
    load_error,
    load_figures,
    measure_one,
    train_one,
)
from track.evaluation.sweep.sweep_file import Sweep, SweepError
from train.data.shards import MANIFEST
from train.reports.model_card import MODEL_CARD
from train.simulation.generation import generate_dataset

CLAIM: Final = "sweep.json"
Progress = Callable[[str, int, int], None]
"""Called with what is being done, the number of steps done, and of all."""


def run_sweep(
    sweep: Sweep, out: Path, *, workers: int | Executor | None = None, progress: Progress | None = None
) -> list[Row]:
    """Do what a sweep's results need and are lacking.

    Args:
        sweep: The sweep.
        out: Folder for training sets, labelers and figures. What another sweep left there is used where it
            has the same settings, and stays.
        workers: Number of processes, all cores when not given; or an executor.
        progress: Called after each step; training sets are counted in hundredths.

    Returns:
        The figures of all cells.

    Raises:
        HandSimError: A setting is refused, or a step fails that other steps need.
        Stopped: A signal came; finished steps are kept.
    """
    workers, cells = workers if isinstance(workers, Executor) else check_workers(workers), cells_of(sweep)
    sets, trainings, measures = steps_of(cells)
    claim(out / CLAIM, {"sweep": 1}, noun="sweep", error=SweepError)
    tell = progress or (lambda *_: None)
    try:
        for number, step in enumerate(sets):
            _make_set(step, out, workers, functools.partial(_part_of, tell, number, len(sets)))
        done = [(out / LABELERS / step.name / MODEL_CARD).is_file() for step in trainings]
        _do("labelers", functools.partial(train_one, trainings, out), done, workers, tell)
        _check_versions(measures, out)
        done = [bool(load_figures(out, step)[1]) for step in measures]
        _do("captures", functools.partial(measure_one, measures, out), done, workers, tell)
    except KeyboardInterrupt as stop:
        kept = f"what is finished is in {out}, and the same command goes on after it"
        raise Stopped.again(stop, kept) from stop
    return [_row(cell, out) for cell in cells]


def _make_set(step: SetStep, out: Path, workers: int | Executor, tell: Callable[[int, int], None]) -> None:
    """Make a training set, on all workers, unless it is complete."""
    if not (out / SETS / step.name / MANIFEST).is_file():  # which is written last
        generate_dataset(step.config, out / SETS / step.name, workers=workers, progress=tell)


def _part_of(tell: Progress, number: int, count: int, done: int, total: int) -> None:
    """Tell how far the sets are, one of them half done, in hundredths."""
    tell("training sets", round(100 * (number + done / total)), 100 * count)


def _do(what: str, job: Job, done: list[bool], workers: int | Executor, tell: Progress) -> None:
    """Do the steps that are not done, none of them waiting for the first."""
    todo = [number for number, there in enumerate(done) if not there]
    with ExitStack() as ended:
        if not isinstance(workers, Executor) and workers > 1:
            workers = ended.enter_context(LocalProcesses(workers))
        for count, _ in enumerate(run_jobs(job, todo, workers), 1):
            tell(what, len(done) - len(todo) + count, len(done))


def _check_versions(measures: list[MeasureStep], out: Path) -> None:
    """Tell of figures that another version measured."""
    found = {version for step in measures if (version := load_figures(out, step)[1])} - {__version__}
    if found:
        warnings.warn(
            f"{out} has figures that handsim {', '.join(sorted(found))} measured, and this is {__version__}; "
            f"remove {out / MEASURED} to measure all of them anew",
            HandSimWarning,
            stacklevel=3,
        )


def _row(cell: Cell, out: Path) -> Row:
    step = cell.measure
    labeler = "" if step.labeler is None else step.labeler.name
    return Row(cell.varied, load_figures(out, step)[0], load_error(out, step), labeler)
