"""The command `handsim generate`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from handsim.app.messages import named_steps, print_line, print_table, progress_bar
from handsim.app.output import place_of
from handsim.app.workers import chosen_workers
from handsim.cli.parsing import PresetCommand, run_command
from train.simulation.training_frames import GenerateSettings

if TYPE_CHECKING:
    from train.simulation.room_like import RoomLike
    from train.simulation.scenes import SimulatedKind


def _generate(
    out: Annotated[str, tyro.conf.arg(metavar="PATH")],
    settings: Annotated[GenerateSettings, tyro.conf.arg(name="")],
    workers: int | None = None,
    like: tuple[Path, ...] = (),
    cluster: str | None = None,
) -> None:
    """Make a training set and a page of plots of it; run it again to continue where it was stopped.

    Args:
        out: Folder for the shards, their manifest and report.html; or a folder of an object store, as
            s3://bucket/prefix, which gets no report (docs/cluster.md).
        settings: What to make.
        workers: Processes; all cores when not given.
        like: Captures of your lab, labeled or not, whose noise, losses and ghosts the set gets instead of the
            defaults; options given beside it hold (docs/room.md).
        cluster: Where else to make shards: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    from train.simulation.generation import make_dataset

    del like  # it is in `settings`
    place = place_of(out)
    with progress_bar("frames") as bar, chosen_workers(cluster, workers, bar.say) as chosen:
        manifest = make_dataset(settings, place, workers=chosen, progress=bar)
    print_line(f"{manifest.num_frames} frames of {settings.glove} in {place}")
    if isinstance(place, Path):
        print_line(f"report in {_report(settings, place)}")


def _with_measured_room(args: Sequence[str], prog: str) -> Callable[..., None]:
    """The command with the settings that captures show as its defaults."""
    if not any(arg.partition("=")[0] == "--like" for arg in args):
        return _generate

    @functools.wraps(_generate)
    def asked(settings: GenerateSettings, like: tuple[Path, ...], **_: object) -> RoomLike[GenerateSettings]:
        from train.simulation.room_like import room_like

        with named_steps("") as on_step:
            return room_like(like, settings, on_step=on_step)

    measured: RoomLike[GenerateSettings] = run_command(asked, prog=prog, args=args)

    @functools.wraps(_generate)
    def command(settings: GenerateSettings, **others: Any) -> None:
        _generate(settings=settings, **others)
        print_table([("figure", "found", "simulated"), *measured.table])
        print_line(*measured.sentences(settings))

    return functools.partial(command, settings=measured.settings)


generate: Final = PresetCommand(_with_measured_room)


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
