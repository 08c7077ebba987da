"""The command `handsim reproduce`: the tables of tracking, joined to those of labelling."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console

from train.commands import progress_bar
from train.labeler import labeler_for_glove
from train.shards import save_json
from train.table_commands import REPRODUCE as LABELLING
from train.twins import KINDS, TwinConfig, simulate_twin

if TYPE_CHECKING:
    from gloves.take import Take
    from track.comparison import Measured

_PAPERS_GLOVE: Final = "dense19"


def table5(
    glove: str = _PAPERS_GLOVE,
    labeler: Path | None = None,
    num_frames: int | None = None,
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Trackers on the twins of the paper's captures: frames all of whose labels are right; errors and time.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        num_frames: Frames of each capture; the paper's numbers when not given.
        seed: Seed of the captures and of what is drawn while tracking; 0 gives the twins.
        json: File for the figures.
    """
    from track.comparison import TRIALS
    from track.tables import print_errors, print_table5, print_times, print_trials

    measured = _measure(glove, labeler, num_frames, seed, trials=TRIALS)
    console = Console()
    console.print(print_table5(measured, with_paper=glove == _PAPERS_GLOVE))
    console.print(*print_errors(measured), print_trials(measured), print_times(measured), sep="\n")
    _save(json, "table5", glove, seed, measured)


def table7(
    glove: str = _PAPERS_GLOVE,
    labeler: Path | None = None,
    num_frames: int | None = None,
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Trackers with calibrated hands and without: frames whose poses fit, and those of them that are right.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        num_frames: Frames of each capture; the paper's numbers when not given.
        seed: Seed of the captures and of what is drawn while tracking; 0 gives the twins.
        json: File for the figures.
    """
    from track.tables import print_table7

    measured = _measure(glove, labeler, num_frames, seed)
    Console().print(print_table7(measured, with_paper=glove == _PAPERS_GLOVE))
    _save(json, "table7", glove, seed, measured)


def cameras(
    rig: str = "six",
    glove: str = _PAPERS_GLOVE,
    labeler: Path | None = None,
    num_frames: int | None = None,
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Trackers on hands in the air before fewer cameras: the paper switches off more than half of its 16.

    Args:
        rig: Camera rig: a shipped name or the path of a .toml file.
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        num_frames: Frames of the capture; the paper's 2875 when not given.
        seed: Seed of the capture and of what is drawn while tracking.
        json: File for the figures.
    """
    from track.paper import CAMERAS_FRAMES
    from track.tables import print_cameras

    config = TwinConfig(
        kind="single-hand",
        num_frames=CAMERAS_FRAMES if num_frames is None else num_frames,
        glove=glove,
        rig=rig,
        seed=seed,
    )
    takes, measured = _measure_on({"single-hand": config}, labeler)
    missing = 1.0 - takes["single-hand"].markers_present().mean()
    Console().print(print_cameras(measured, missing, rig=rig, with_paper=glove == _PAPERS_GLOVE))
    _save(json, "cameras", glove, seed, measured, rig=rig, missing=float(missing))


REPRODUCE: Final = dict(sorted({**LABELLING, "table5": table5, "table7": table7}.items())) | {
    "cameras": cameras
}


def _measure(
    glove: str, labeler: Path | None, num_frames: int | None, seed: int, *, trials: int = 0
) -> list[Measured]:
    configs: dict[str, TwinConfig] = {
        kind: TwinConfig(kind=kind, num_frames=num_frames, glove=glove, seed=seed) for kind in KINDS
    }
    return _measure_on(configs, labeler, trials=trials)[1]


def _measure_on(
    configs: Mapping[str, TwinConfig], labeler: Path | None, *, trials: int = 0
) -> tuple[dict[str, Take], list[Measured]]:
    """Simulate captures and run all trackers over them."""
    from track.comparison import USERS, compare_trackers, trackers
    from track.trials import without_body

    some = next(iter(configs.values()))
    network = labeler_for_glove(some.glove, labeler)
    takes: dict[str, Take] = {}
    with progress_bar("captures") as (bar, task):
        bar.update(task, total=len(configs))
        for kind, config in configs.items():
            takes[kind] = without_body(simulate_twin(config))
            bar.advance(task)
    frames = sum(take.num_frames for take in takes.values())
    with progress_bar("frames") as (bar, task):
        bar.update(task, total=frames * len(USERS) * len(trackers(network, some.seed)))
        measured = compare_trackers(
            takes, network, seed=some.seed, trials=trials, done=lambda: bar.advance(task)
        )
    return takes, measured


def _save(
    json: Path | None, table: str, glove: str, seed: int, measured: list[Measured], **more: Any
) -> None:
    if json is not None:
        records = [one.record() for one in measured]
        save_json(json, {"table": table, "glove": glove, "seed": seed, **more, "figures": records})
