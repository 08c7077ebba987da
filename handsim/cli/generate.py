"""The command `handsim generate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from handsim.app.messages import named_steps, print_line, progress_bar
from handsim.app.output import place_of
from handsim.app.workers import chosen_workers
from train.simulation.training_frames import GenerateSettings

if TYPE_CHECKING:
    from train.simulation.scenes import SimulatedKind


def generate(
    out: Annotated[str, tyro.conf.arg(metavar="PATH")],
    settings: Annotated[GenerateSettings, tyro.conf.arg(name="")],
    workers: int | None = None,
    cluster: str | None = None,
) -> None:
    """Make a training set and a page of plots of it; run it again to continue where it was stopped.

    Args:
        out: Folder for the shards, their manifest and report.html; or a folder of an object store, as
            s3://bucket/prefix, which gets no report (docs/cluster.md).
        settings: What to make.
        workers: Processes; all cores when not given.
        cluster: Where else to make shards: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    from train.simulation.generation import make_dataset

    place = place_of(out)
    with progress_bar("frames") as bar, chosen_workers(cluster, workers, bar.say) as chosen:
        manifest = make_dataset(settings, place, workers=chosen, progress=bar)
    print_line(f"{manifest.num_frames} frames of {settings.glove} in {place}")
    if isinstance(place, Path):
        print_line(f"report in {_report(settings, place)}")


def _report(settings: GenerateSettings, out: Path) -> Path:
    """Write the page of plots, without which a set is complete: its bytes depend on matplotlib."""
    import numpy as np

    from gloves.layout import load_layout
    from handsim.hand.shape import SIDES
    from handsim.space.rig import HAND_REACH, distances_to_volume, load_rig
    from train.data.shards import Dataset
    from train.reports.dataset_page import REPORT, write_dataset_page
    from train.simulation.takes import WRIST_VOLUME, simulate_take

    with named_steps("drawing the report"):
        both = len(load_layout(settings.glove).sides) == len(SIDES)
        rig = load_rig(settings.rig)
        if distances_to_volume(rig, np.array(settings.center), WRIST_VOLUME).min() < HAND_REACH:
            # A small rig stands where the hands of a simulated capture would move.
            return write_dataset_page(out / REPORT, Dataset(out))
        kind: SimulatedKind = "hand-hand" if both else "single-hand"
        take = simulate_take(kind, num_frames=1200, glove=settings.glove, rig=rig, center=settings.center)
        return write_dataset_page(out / REPORT, Dataset(out), present=take.markers_present(), rate=take.rate)
