"""The public benchmark: make its captures, run one of our trackers on them, score anybody's results."""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from collections.abc import Callable
from json import dumps as json_text
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

import tyro
from rich.console import Console

from benchmarks.command_line import run as run_commands
from benchmarks.public.baselines import TRACKERS, TrackerName, Users, run_baseline
from benchmarks.public.card import describe_captures
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES, SIZES
from benchmarks.public.making import make_benchmark
from benchmarks.public.manifest import PUBLISHED, differing_files, load_benchmark
from benchmarks.public.score_tables import figure_text, score_record, score_tables
from benchmarks.public.scoring import score_results
from benchmarks.record import describe
from handsim import HandSimWarning
from handsim.app.messages import print_line, progress_bar
from handsim.files.outputs import atomic_write, check_outputs, save_json, shown_bytes

_TABLE: Final = ("frame_accuracy", "slot_accuracy", "mpjpe", "angle_error")
_MOST_SHOWN: Final = 3  # files that differ


def make(
    out: Path,
    size: Literal["small", "full"] = "small",
    workers: int | None = None,
) -> None:
    """Make the captures of the public benchmark and their truth; run it again to continue where it stopped.

    Args:
        out: Folder for captures, truth, data card and manifest.
        size: Which benchmark; results name it.
        workers: Processes; all cores when not given.
    """
    with progress_bar("frames") as bar:
        benchmark = make_benchmark(
            SIZES[size],
            out,
            workers=workers,
            progress=bar,
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
    with progress_bar("frames") as bar:
        bar(0, sum(one.num_frames for one in benchmark.captures))
        run_baseline(benchmark, tracker, out, users=users, progress=bar.advance)
    print_line(
        f"{out}: results of {len(benchmark.captures)} captures; python -m benchmarks.public score counts them"
    )


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
    with progress_bar("captures") as bar:
        bar(0, len(benchmark.captures))
        counted = score_results(benchmark, results, done=bar.advance)
    console = Console()
    for table in score_tables(counted):
        console.print(table)
    if json is not None:
        save_json(json, score_record(counted, results.name))


def table(out: Path, trackers: tuple[TrackerName, ...] = TRACKERS) -> None:
    """Our trackers on the small benchmark: frames and slots with right labels, joints and angles.

    Args:
        out: Folder for the benchmark and the results; what is in it is not made again.
        trackers: Which.
    """
    plan = SIZES["small"]
    began = time.perf_counter()
    benchmark = make_benchmark(plan, out / plan.size, workers=1)
    megabytes = sum(file.stat().st_size for file in benchmark.folder.rglob("*") if file.is_file()) / 1e6
    print_line(f"{describe()}\nmade in {time.perf_counter() - began:.0f} s by one core, {megabytes:.1f} MB")
    for name, counts in describe_captures(plan, benchmark.folder).items():
        print_line(
            f"{name}: {100 * counts.missing:.2f} % missing, {counts.gaps:.1f} gaps/s, "
            f"{counts.ghosts:.2f} ghosts"
        )
    print_line(f"easy, medium, hard: {', '.join(_TABLE)}")
    for tracker, users in itertools.product(trackers, get_args(Users)):
        results = out / f"{tracker}-{users}"
        run_baseline(benchmark, tracker, results, users=users)
        score_ = score_results(benchmark, results)
        means = [score_.mean(difficulty=name) for name in DIFFICULTIES]
        cells = " ".join(figure_text(name, one[name]) for name in _TABLE for one in means)
        print_line(f"{tracker} {users}: {cells}")


def publish(out: Path) -> None:
    """Write published.json, the checksums that `make` compares its files with; for a new version alone.

    Args:
        out: Folder for every size; what is in it is not made again.
    """
    made = {size: make_benchmark(plan, out / size).files for size, plan in SIZES.items()}
    files = {
        size: {name: digest for name, digest in files.items() if name != "README.md"}
        for size, files in made.items()
    }
    with atomic_write(PUBLISHED) as path:
        path.write_text(json_text({"benchmark": BENCHMARK, "files": files}, indent=1) + "\n", "utf-8")
    print_line(f"{PUBLISHED}: {', '.join(f'{len(names)} files of {size}' for size, names in files.items())}")


COMMANDS: Final[dict[str, Callable[..., None]]] = {
    "make": make,
    "run": run,
    "score": score,
    "table": table,
    "publish": publish,
}

if __name__ == "__main__":
    sys.exit(run_commands("benchmarks.public", __doc__, COMMANDS))
