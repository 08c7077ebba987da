"""The command `handsim simulate`."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gloves.captures.capture import UNLABELED, Capture, run_lengths
from gloves.captures.formats import WRITABLE, check_suffix, write_capture
from gloves.takes.take import TRUTH_SUFFIX, load_take
from handsim.app.messages import named_steps, print_line, print_table
from handsim.app.workers import chosen_workers, run_jobs
from handsim.errors import ArgumentError
from handsim.files.outputs import check_free, check_memory, check_outputs, written_together
from train.simulation.takes import SimulateSettings, simulate_take

if TYPE_CHECKING:
    from train.simulation.room_like import RoomLike


def simulate(
    out: Path,
    settings: Annotated[SimulateSettings, tyro.conf.arg(name="")],
    like: tuple[Path, ...] = (),
    cluster: str | None = None,
) -> None:
    """Simulate a capture of one hand or two; the truth goes beside it.

    Args:
        out: Unlabeled .c3d, .trc or Motive .csv file; OUT.truth.npz takes IDs, labels, poses and shapes.
        settings: What to simulate.
        like: Captures of your lab, labeled or not, whose noise, gaps and ghosts the simulated one gets;
            options of --optics and --strays that are given hold (docs/room.md).
        cluster: Where else to simulate: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    truth = out.with_suffix(TRUTH_SUFFIX)
    check_suffix(out, WRITABLE)
    check_outputs((str(settings.glove), str(settings.rig), *like), (out, truth))
    num_frames = settings.num_frames or 0
    what = f"{num_frames} frames"
    remedy = "simulate shorter captures with different seeds"
    # A frame takes 20 kB of memory, and 2 kB in both files.
    check_memory(num_frames * 20_000, what, remedy)
    check_free(out.parent, num_frames * 2_000, what, remedy, error=ArgumentError)
    measured: RoomLike[SimulateSettings] | None = None
    if like:
        from train.simulation.room_like import room_like

        with named_steps("") as on_step:
            measured = room_like(like, settings, on_step=on_step)
        settings = measured.settings
    if cluster is None:
        _simulate_into(out, settings, 0)
    else:
        with chosen_workers(cluster, None, print_line) as workers:
            list(run_jobs(functools.partial(_simulate_into, out, settings), [0], workers))
    take = load_take(truth)
    gaps = len(run_lengths(~take.markers_present()))
    print_line(
        f"{out}: {take.num_frames} frames, {gaps} gap{'s' * (gaps != 1)} of single markers; truth in {truth}"
    )
    if measured is not None:
        print_table([("figure", "found", "simulated"), *measured.table])
        print_line(*measured.sentences(settings))


def _simulate_into(out: Path, settings: SimulateSettings, number: int) -> int:
    """Write a capture and its truth; the only job of a worker."""
    take = simulate_take(settings=settings)
    names = tuple(f"{UNLABELED}{column + 1}" for column in range(take.point_list.num_columns))
    with written_together():  # a capture without its truth is no use
        write_capture(out, Capture(names, take.points, take.rate))
        take.save(out.with_suffix(TRUTH_SUFFIX))
    return number
