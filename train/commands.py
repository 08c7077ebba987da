"""The commands `handsim generate | train | label | evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from gloves.captures import WRITABLE, read_capture, write_capture
from gloves.captures.capture import check_suffix
from gloves.captures.collection import find_captures, read_markers
from gloves.captures.markers import labelled_capture, unlabelled_frames
from gloves.layout import load_layout
from gloves.take import load_take
from handsim.errors import HandSimError
from handsim.json_files import save_json
from handsim.progress import progress_bar
from train.config import Preset, TrainConfig, with_preset
from train.labeler import labeler_for_glove
from train.metrics import percent
from train.report import write_report
from train.run_page import PAGE
from train.shards import Dataset
from train.synthesis import DatasetConfig, generate_dataset
from train.twins import TwinConfig, simulate_twin

_SIDE_FRAMES = 100
_TAKE = 1200  # frames of the continuous take that the report's gaps are from


def generate(
    out: Path, config: Annotated[DatasetConfig, tyro.conf.arg(name="")], workers: int | None = None
) -> None:
    """Make a training set and a page of plots of it; run it again to go on where it was stopped.

    Args:
        out: Folder for the shards, their manifest and report.html.
        config: What to make.
        workers: Processes; all cores when not given.
    """
    with progress_bar("frames") as (bar, task):
        manifest = generate_dataset(
            config,
            out,
            workers=workers,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    # Not in generate_dataset: the set is whole without its report, whose bytes hang on matplotlib's version.
    with Console(stderr=True).status("drawing the report"):
        take = simulate_twin(
            TwinConfig(kind="hand-hand", num_frames=_TAKE, glove=config.glove, rig=config.rig)
        )
        report = write_report(Dataset(out), present=take.markers_present(), rate=take.rate)
    Console().print(f"{manifest.num_frames} frames of {config.glove} in {out}")
    Console().print(f"report in {report}", soft_wrap=True, markup=False)


def train(
    dataset: Annotated[Path, tyro.conf.Positional],
    out: Path,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")],
    preset: Preset | None = None,
) -> None:
    """Train a labeler on a training set and draw a page about it; run it again to go on where it was stopped.

    Args:
        dataset: Folder that `handsim generate` wrote.
        out: Folder for the weights, the model card, the checkpoint and report.html.
        config: How to train.
        preset: A published recipe; options given beside it hold all the same.
    """
    from train.loop import train_labeler

    rows = Dataset(dataset)
    if preset is not None:
        config = with_preset(preset, config, rows.manifest.num_frames)
    with progress_bar("samples") as (bar, task):

        def report(done: int, total: int, loss: float) -> None:
            bar.update(task, completed=done, total=total, description=f"loss {loss:.3f}")

        card = train_labeler(rows, config, out, progress=report)
    print_figures(card["held_out_simulated"], title="Held-out simulated frames")
    Console().print(f"weights and model card in {out}")
    Console().print(f"report in {out / PAGE}", soft_wrap=True, markup=False)


def label(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Path,
    glove: str = "dense19",
    labeler: str | None = None,
) -> None:
    """Label every frame of a capture on its own; names and order of its columns are not used.

    Args:
        capture: A .trc, .c3d or Motive .csv file.
        out: Labelled .trc or .c3d file; points that are no markers become columns Unlabeled1, Unlabeled2, ...
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
    """
    check_suffix(out, WRITABLE)  # before the work, not after it
    network = labeler_for_glove(glove, labeler)
    source = read_capture(capture)
    frames = unlabelled_frames(source)
    with progress_bar("frames") as (bar, task):
        labellings = []
        for first in range(0, len(frames), 1024):
            labellings += network.label_frames(frames[first : first + 1024])
            bar.update(task, completed=len(labellings), total=len(frames))
    labels = [labelling.labels for labelling in labellings]
    write_capture(out, labelled_capture(frames, labels, network.marker_names, source.rate))
    named = sum(int((label >= 0).sum()) for label in labels)
    points = sum(len(label) for label in labels)
    sure = np.concatenate([labelling.confidence for labelling in labellings]) if points else np.ones(1)
    Console().print(
        f"{out}: {len(frames)} frames, {named} of {points} points labelled, "
        f"median confidence {np.median(sure):.3f}{_side(glove, frames, labels)}"
    )


def _side(glove: str, frames: list[np.ndarray], labels: list[np.ndarray]) -> str:
    """Whose hand it looks like, from a few frames with the most markers."""
    from train.side import SideTeller

    best = sorted(range(len(frames)), key=lambda frame: -int((labels[frame] >= 0).sum()))[:_SIDE_FRAMES]
    teller = SideTeller(load_layout(glove), rng=np.random.default_rng(0))
    sides = [teller.tell(frames[frame], labels[frame]) for frame in best]
    votes = sum(clear if side == "right" else -clear for side, clear in sides)
    return "" if votes == 0.0 else f", a {'right' if votes > 0.0 else 'left'} hand"


def export(labeler: Annotated[str, tyro.conf.Positional], out: Path) -> None:
    """Write a trained set labeler as one .onnx file, which labels without torch.

    Args:
        labeler: A glove with a shipped labeler, or the folder of a trained one.
        out: The .onnx file.
    """
    from train.labeler import load_network
    from train.onnx_labeler import export_onnx

    if out.suffix.lower() != ".onnx":
        raise HandSimError(f"cannot write '{out}', wanted a name that ends in .onnx")
    network, card = load_network(labeler)
    export_onnx(network, card["marker_names"], out)
    Console().print(f"{out}: {len(card['marker_names'])} markers", highlight=False, soft_wrap=True)


def evaluate(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    *,
    glove: str = "dense19",
    labeler: str | None = None,
    occlude: int = 0,
    ghosts: int = 0,
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Measure a labeler on labelled captures, corrupted as in the paper.

    Args:
        captures: Labelled .trc, .c3d or .csv files, folders searched for them, or the .truth.npz of takes.
        glove: Marker layout: a shipped name or the path of a .toml file.
        labeler: Folder of a trained labeler, or an exported .onnx file; the shipped one when not given.
        occlude: Up to this many draws of a marker to drop, with replacement (the paper: 5 dense, 3 sparse).
        ghosts: Up to this many ghosts, uniform in the frame's box grown by a tenth (the paper: 2).
        seed: Seed of the corruption.
        json: File for the figures.
    """
    from train.augmentation import Corruption
    from train.evaluation import evaluate_labeler, evaluate_takes

    if occlude < 0 or ghosts < 0:
        raise HandSimError(f"occlude is {occlude} and ghosts {ghosts}, wanted 0 or more of each")
    network = labeler_for_glove(glove, labeler)
    if all(path.suffix == ".npz" for path in captures):
        if occlude or ghosts:
            raise HandSimError(
                "a simulated take has its own gaps and ghosts: leave out --occlude and --ghosts"
            )
        report = evaluate_takes(network, [load_take(path) for path in captures])
        title = f"{len(captures)} takes, {report.num_frames} frames of one hand"
    else:
        files = find_captures(captures)
        markers = read_markers(files, network.marker_names)
        corruption = Corruption(occlude, ghosts)
        report = evaluate_labeler(network, markers, corruption, rng=np.random.default_rng(seed))
        title = f"{len(files)} captures, {report.num_frames} frames, occlude {occlude}, ghosts {ghosts}"
    by_marker = dict(zip(network.marker_names, map(float, report.slot_accuracy_by_marker), strict=True))
    _print_report(report.figures, by_marker, title)
    if json is not None:
        drawn = {"glove": glove, "occlude": occlude, "ghosts": ghosts, "seed": seed}
        # JSON knows no NaN, which stands where there was nothing to count.
        figures = {name: None if np.isnan(value) else value for name, value in report.figures.items()}
        found = {"frames": report.num_frames, "figures": figures, "slot_accuracy_by_marker": by_marker}
        save_json(json, {**drawn, **found})


def _print_report(figures: dict[str, float], by_marker: dict[str, float], title: str) -> None:
    print_figures({"share": figures}, title=title)
    worst = sorted(by_marker, key=by_marker.__getitem__)[:3]
    Console().print("worst markers: " + ", ".join(f"{name} {100 * by_marker[name]:.2f} %" for name in worst))


def print_figures(columns: dict[str, dict[str, float]], *, title: str) -> None:
    """Figures as a table in percent, a column each."""
    table = Table(title=title)
    table.add_column("figure")
    for name in columns:
        table.add_column(f"{name} [%]", justify="right")
    for figure in next(iter(columns.values())):
        table.add_row(
            figure.replace("_", " "), *map(percent, (column[figure] for column in columns.values()))
        )
    Console().print(table)
