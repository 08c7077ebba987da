"""The public benchmark: make its captures, score anybody's results."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro
from rich.console import Console

from benchmarks.public.difficulties import BENCHMARK, SIZES
from benchmarks.public.making import make_benchmark
from benchmarks.public.manifest import differing_files, load_benchmark
from benchmarks.public.scoring import score_record, score_results, score_table
from benchmarks.record import run_commands
from handsim import HandSimWarning
from handsim.app.messages import print_line, progress_bar
from handsim.files.outputs import check_outputs, save_json

_MOST_SHOWN: Final = 3  # files that differ


def make(out: Path, size: Literal["small", "full"] = "small", workers: int | None = None) -> None:
    """Make the captures of the public benchmark and their truth; run it again to continue where it stopped.

    Args:
        out: Folder for captures, truth and manifest.
        size: Which benchmark; results name it.
        workers: Processes; all cores when not given.
    """
    with progress_bar("frames") as bar:
        benchmark = make_benchmark(SIZES[size], out, workers=workers, progress=bar)
    frames = sum(one.num_frames for one in benchmark.captures)
    print_line(f"{out}: {BENCHMARK}, {size}: {len(benchmark.captures)} captures, {frames} frames")
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


def score(
    folder: Annotated[Path, tyro.conf.Positional],
    results: Annotated[Path, tyro.conf.Positional],
    json: Path | None = None,
) -> None:
    """Count results against the truth of a benchmark: labels, joints, joint angles.

    Args:
        folder: The benchmark.
        results: Folder with a file for every capture: NAME.csv (frame,point,label), NAME.npz (labels, joints,
            angles), or what handsim track writes.
        json: File for all figures.
    """
    benchmark = load_benchmark(folder)
    inputs = [folder / file for file in benchmark.files] if json is not None else []
    check_outputs((*inputs, *(results.glob("*") if json is not None else ())), [json])
    with progress_bar("captures") as bar:
        bar(0, len(benchmark.captures))
        counted = score_results(benchmark, results, done=bar.advance)
    Console().print(score_table(counted))
    if json is not None:
        save_json(json, score_record(counted, results.name))


COMMANDS: Final[dict[str, Callable[..., None]]] = {
    "make": make,
    "score": score,
}

if __name__ == "__main__":
    sys.exit(run_commands("benchmarks.public", __doc__, COMMANDS))
