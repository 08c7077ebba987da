"""The cells of a sweep, and the steps that they need: cells that share a training set share its making.

A step's name ends with a digest of everything that decides its result, so that a sweep whose file has changed
does only what is new.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from gloves.layout import load_layout
from handsim.errors import HandSimError
from handsim.files.toml_settings import settings_of
from handsim.space.cameras import CameraRig, rig_setting
from track.config import TrackerConfig
from track.evaluation.sweep.sweep_file import Sweep
from train.config import TrainConfig
from train.simulation.dataset_config import DatasetConfig
from train.simulation.takes import TakeConfig

_Content = Callable[[str, CameraRig | str], dict[str, Any]]
_MOST_CELLS: Final = 10_000
_DIGEST: Final = 10  # hexadecimal digits: some millions of steps do not collide


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """How captures are tracked."""

    users: Literal["uncalibrated", "calibrated"] = "uncalibrated"
    """uncalibrated: the size of the hands is measured in the capture; calibrated: the true hands and gloves
    are known."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)


@dataclass(frozen=True, slots=True)
class SetStep:
    """A training set to make."""

    name: str
    config: DatasetConfig


@dataclass(frozen=True, slots=True)
class TrainStep:
    """A labeler to train on a set."""

    name: str
    config: TrainConfig
    set: SetStep


@dataclass(frozen=True, slots=True)
class MeasureStep:
    """A capture to simulate, label, and track."""

    name: str
    capture: TakeConfig
    track: TrackSettings | None
    """None where it is labeled only."""
    labeler: TrainStep | None
    """None where the labeler is the glove's shipped one, or the one for any layout."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of what is varied."""

    varied: dict[str, Any]
    """The values, by the columns of the table of results."""
    measure: MeasureStep


def cells_of(sweep: Sweep) -> list[Cell]:
    """All cells of a sweep, the last list varying fastest.

    Raises:
        HandSimError: There are too many, or a setting is refused.
        LayoutError: A glove is unknown.
        RigError: A rig is unknown.
    """
    lists: dict[str, tuple[Any, ...]] = {"glove": sweep.gloves, "rig": sweep.rigs, **sweep.vary}
    if "train" in sweep.settings:
        lists["seed"] = sweep.seeds
    lists["person"] = sweep.people
    count = 1
    for values in lists.values():
        count *= len(values)
    if count > _MOST_CELLS:
        raise HandSimError(f"the sweep has {count} cells, expected at most {_MOST_CELLS}")
    content = functools.cache(_content)
    return [
        _cell(sweep, dict(zip(lists, values, strict=True)), content)
        for values in itertools.product(*lists.values())
    ]


def _cell(sweep: Sweep, varied: dict[str, Any], content: _Content) -> Cell:
    tables = {name: dict(table) for name, table in sweep.settings.items()}
    for key, value in varied.items():
        if key in sweep.vary:
            _put(tables, key.split("."), value)
    glove, rig = varied["glove"], varied["rig"]
    labeler = None
    if "train" in tables:
        drawn = {"glove": glove, "rig": rig, "seed": varied["seed"]} | tables.get("generate", {})
        dataset = settings_of(DatasetConfig, drawn, "generate")
        training = settings_of(TrainConfig, {"seed": varied["seed"]} | tables["train"], "train")
        labeler = _train_step(_set_step(dataset, content), training)
    captured = {"glove": glove, "rig": rig, "seed": varied["person"]} | tables.get("simulate", {})
    capture = settings_of(TakeConfig, captured, "simulate")
    track = settings_of(TrackSettings, tables["track"], "track") if "track" in tables else None
    return Cell(_shown_values(varied), _measure_step(capture, track, labeler, content))


def _put(table: dict[str, Any], path: list[str], value: Any) -> None:
    """Put a value into tables of tables, which are copied."""
    for key in path[:-1]:
        inner = table.get(key, {})
        table[key] = dict(inner) if isinstance(inner, Mapping) else {}
        table = table[key]
    table[path[-1]] = value


def _set_step(config: DatasetConfig, content: _Content) -> SetStep:
    settings = {**dataclasses.asdict(config), **content(config.glove, config.rig)}
    return SetStep(_name(config.glove, settings), config)


def _train_step(dataset: SetStep, config: TrainConfig) -> TrainStep:
    settings = {"set": dataset.name, **dataclasses.asdict(config)}
    return TrainStep(_name(dataset.config.glove, settings), config, dataset)


def _measure_step(
    capture: TakeConfig, track: TrackSettings | None, labeler: TrainStep | None, content: _Content
) -> MeasureStep:
    settings = {
        **dataclasses.asdict(capture),
        **content(capture.glove, capture.rig),
        "track": track and dataclasses.asdict(track),
        "labeler": labeler and labeler.name,
    }
    return MeasureStep(_name(capture.glove, settings), capture, track, labeler)


def _content(glove: str, rig: CameraRig | str) -> dict[str, Any]:
    """What a glove and a rig are, whose files may change."""
    return {
        "layout": dataclasses.asdict(load_layout(glove)),
        "rig": rig_setting(rig),
    }


def _name(glove: str, settings: dict[str, Any]) -> str:
    """A step's name: the glove, for readers, and the digest of its settings."""
    text = json.dumps(settings, sort_keys=True)
    return f"{Path(glove).stem}-{hashlib.sha256(text.encode()).hexdigest()[:_DIGEST]}"


def _shown_values(varied: dict[str, Any]) -> dict[str, Any]:
    """The same, gloves and rigs by the names of their files."""
    return varied | {key: Path(varied[key]).name.removesuffix(".toml") for key in ("glove", "rig")}


def steps_of(cells: list[Cell]) -> tuple[list[SetStep], list[TrainStep], list[MeasureStep]]:
    """The steps that cells need, each once, in the order of the cells."""
    measures = list({cell.measure.name: cell.measure for cell in cells}.values())
    trainings = {step.labeler.name: step.labeler for step in measures if step.labeler is not None}
    sets = {step.set.name: step.set for step in trainings.values()}
    return list(sets.values()), list(trainings.values()), measures
