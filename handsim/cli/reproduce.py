"""The command `handsim reproduce`: the paper's tables of tracking, and all tables by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro
from rich.console import Console

from handsim.app.progress import progress_bar
from handsim.cli.labeling_tables import LABELING_TABLES
from handsim.files.json_files import save_json
from train.glove_labeler import load_labeler
from train.simulation.room_settings import KINDS
from train.simulation.takes import TakeConfig, record_config

if TYPE_CHECKING:
    from gloves.takes.take import Take
    from track.evaluation.comparison import Measurement

_PAPERS_GLOVE: Final = "dense19"
_WITH_BODY: Final = "hand-controller"


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
    json: Path | None = None
    """File for the results."""


_Config = Annotated[TableConfig, tyro.conf.arg(name="")]


def table5(config: _Config) -> None:
    """Trackers on the twins of the paper's captures: frames all of whose labels are right; errors and time.

    Args:
        config: Settings of the measurement.
    """
    from track.evaluation.comparison import TRIALS
    from track.evaluation.tables import print_errors, print_table5, print_times, print_trials

    takes, measured = _measure(config, trials=TRIALS)
    with_body = _measure_with_body(takes[_WITH_BODY], config)
    console = Console()
    console.print(print_table5([*measured, *with_body], with_paper=config.glove == _PAPERS_GLOVE))
    console.print(*print_errors(measured), print_trials(measured), print_times(measured), sep="\n")
    _save("table5", config, [*measured, *with_body])


def table7(config: _Config) -> None:
    """Trackers with calibrated hands and without: frames whose poses fit, and those of them that are right.

    Args:
        config: Settings of the measurement.
    """
    from track.evaluation.tables import print_table7

    _, measured = _measure(config)
    Console().print(print_table7(measured, with_paper=config.glove == _PAPERS_GLOVE))
    _save("table7", config, measured)


def cameras(config: _Config, rig: str = "six") -> None:
    """Trackers on hands in the air before fewer cameras: the paper switches off more than half of its 16.

    Args:
        config: Settings of the measurement; the paper has 2875 frames.
        rig: Camera rig: a shipped name or the path of a .toml file.
    """
    from track.evaluation.paper import CAMERAS_FRAMES
    from track.evaluation.tables import print_cameras

    num_frames = CAMERAS_FRAMES if config.num_frames is None else config.num_frames
    twin = TakeConfig("single-hand", num_frames, config.glove, rig, config.seed)
    takes, measured = _measure_on({"single-hand": twin}, config)
    missing = 1.0 - takes["single-hand"].markers_present().mean()
    with_paper = config.glove == _PAPERS_GLOVE
    Console().print(print_cameras(measured, missing, rig=rig, with_paper=with_paper))
    _save("cameras", config, measured, rig=rig, missing=float(missing))


REPRODUCE: Final = dict(sorted({**LABELING_TABLES, "table5": table5, "table7": table7}.items())) | {
    "cameras": cameras
}


def _measure(config: TableConfig, *, trials: int = 0) -> tuple[dict[str, Take], list[Measurement]]:
    """Simulate captures of all kinds, and run all trackers over them."""
    twins: dict[str, TakeConfig] = {
        kind: TakeConfig(kind, config.num_frames, config.glove, seed=config.seed) for kind in KINDS
    }
    return _measure_on(twins, config, trials=trials)


def _measure_on(
    twins: Mapping[str, TakeConfig], config: TableConfig, *, trials: int = 0
) -> tuple[dict[str, Take], list[Measurement]]:
    """Simulate captures, and run all trackers over them without their bodies, which most cannot track."""
    from track.evaluation.comparison import USERS, compare_trackers, trackers

    network = load_labeler(config.glove, config.labeler)
    takes: dict[str, Take] = {}
    with progress_bar("captures") as (bar, task):
        bar.update(task, total=len(twins))
        for kind, twin in twins.items():
            takes[kind] = record_config(twin)
            bar.advance(task)
    bare = {kind: take.without_body() for kind, take in takes.items()}
    frames = sum(take.num_frames for take in takes.values())
    with progress_bar("frames") as (bar, task):
        bar.update(task, total=frames * len(USERS) * len(trackers(network, config.seed)))
        measured = compare_trackers(
            bare, network, seed=config.seed, trials=trials, done=lambda: bar.advance(task)
        )
    return takes, measured


def _measure_with_body(take: Take, config: TableConfig) -> list[Measurement]:
    """Our tracker on the capture whose object has markers, with the object tracked as well."""
    from track.evaluation.comparison import USERS, measure_with_body

    network = load_labeler(config.glove, config.labeler)
    with progress_bar("frames") as (bar, task):
        bar.update(task, total=take.num_frames * len(USERS))
        return measure_with_body(_WITH_BODY, take, network, done=lambda: bar.advance(task))


def _save(table: str, config: TableConfig, measured: list[Measurement], **more: Any) -> None:
    if config.json is not None:
        records = [one.record() for one in measured]
        content = {"table": table, "glove": config.glove, "seed": config.seed, **more, "figures": records}
        save_json(config.json, content)
