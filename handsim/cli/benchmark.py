"""The commands `handsim benchmark make | run | score`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro
from rich.console import Console

from handsim.app.cluster import chosen_workers
from handsim.app.messages import print_line
from handsim.app.progress import print_above, progress_bar
from handsim.errors import HandSimWarning
from handsim.files.disk import shown_bytes
from handsim.files.json_files import save_json
from handsim.files.outputs import check_outputs
from track.benchmark.baselines import TrackerName, Users, run_baseline
from track.benchmark.difficulties import BENCHMARK, SIZES
from track.benchmark.making import make_benchmark
from track.benchmark.manifest import differing_files, load_benchmark
from track.benchmark.score_tables import score_record, score_tables
from track.benchmark.scoring import score_results

_MOST_SHOWN: Final = 3  # files that differ


def make(
    out: Path,
    size: Literal["small", "full"] = "small",
    workers: int | None = None,
    cluster: str | None = None,
) -> None:
    """Make the captures of the public benchmark and their truth; run it again to continue where it stopped.

    Args:
        out: Folder for captures, truth, data card and manifest.
        size: Which benchmark; results name it.
        workers: Processes; all cores when not given.
        cluster: Where else to simulate captures: tcp://host:port of a Dask scheduler, its file (.json), or
            local; docs/cluster.md.
    """
    with (
        progress_bar("frames") as (bar, task),
        chosen_workers(cluster, workers, print_above(bar)) as chosen,
    ):
        benchmark = make_benchmark(
            SIZES[size],
            out,
            workers=chosen,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    frames = sum(one.num_frames for one in benchmark.captures)
    taken = shown_bytes(sum((out / file).stat().st_size for file in benchmark.files))
    print_line(f"{out}: {BENCHMARK}, {size}: {len(benchmark.captures)} captures, {frames} frames, {taken}")
    different = differing_files(benchmark)
    if different:
        few = ", ".join(different[:_MOST_SHOWN]) + (", ..." if len(different) > _MOST_SHOWN else "")
        warnings.warn(
            f"{len(different)} of {len(benchmark.files)} files differ from the published ones ({few}); say "
            "so with results, or use the published files",
            HandSimWarning,
            stacklevel=2,
        )
    elif different is not None:
        print_line(f"all {len(benchmark.files)} files are the published ones")


def run(
    folder: Annotated[Path, tyro.conf.Positional],
    out: Path,
    tracker: TrackerName = "handsim",
    users: Users = "uncalibrated",
) -> None:
    """Run one of our trackers on a benchmark; run it again to continue where it stopped.

    Args:
        folder: The benchmark.
        out: Folder for the results.
        tracker: handsim; paper, the loop of Han et al. 2018; hungarian and nearest, which are given the true
            labels of each capture's first frame.
        users: uncalibrated: the size of the hands is measured in the capture; calibrated: the true hands and
            gloves are known.
    """
    benchmark = load_benchmark(folder)
    check_outputs((folder, folder / "captures", folder / "truth"), [out])
    with progress_bar("frames") as (bar, task):
        bar.update(task, total=sum(one.num_frames for one in benchmark.captures))
        run_baseline(
            benchmark, tracker, out, users=users, progress=lambda frames: bar.update(task, advance=frames)
        )
    print_line(f"{out}: results of {len(benchmark.captures)} captures; handsim benchmark score counts them")


def score(
    folder: Annotated[Path, tyro.conf.Positional],
    results: Annotated[Path, tyro.conf.Positional],
    json: Path | None = None,
) -> None:
    """Count results against the truth of a benchmark: labels, joints, joint angles.

    Args:
        folder: The benchmark.
        results: Folder with a file for every capture: NAME.csv (frame,point,label), NAME.npz (labels, joints,
            angles), or what handsim label and handsim track write.
        json: File for all figures.
    """
    benchmark = load_benchmark(folder)
    inputs = [folder / file for file in benchmark.files] if json is not None else []
    check_outputs((*inputs, *(results.glob("*") if json is not None else ())), [json])
    with progress_bar("captures") as (bar, task):
        bar.update(task, total=len(benchmark.captures))
        counted = score_results(benchmark, results, done=lambda: bar.advance(task))
    console = Console()
    for table in score_tables(counted):
        console.print(table)
    if json is not None:
        save_json(json, score_record(counted, results.name))


BENCHMARK_COMMANDS: Final = {"make": make, "run": run, "score": score}
