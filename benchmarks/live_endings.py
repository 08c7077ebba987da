"""End a live recording by signals, many times, and look at what is on disk.

    python -m benchmarks.live_endings [--times 20 --rates 30 120 1000 --busy 2 --seed 0]

Each recording is of a stream that does not end, beside processes that keep all cores busy. SIGINT or SIGTERM
comes once or twice, the second one up to 0.3 s after the first. The table has the times from the last
signal to the end of the process, and counts recordings that ended well: after one signal with exit code 0 and
the whole take; after two also with 128 and the signal's number, and a readable recording. The last column
counts recordings that still ran when the second signal came. Exit code 1 when one did not end well, or took
two seconds.
"""

from __future__ import annotations

import argparse
import io
import itertools
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gloves import load_take, write_capture
from gloves.takes.archives import CutOffWarning, GrownArchive
from handsim.cli.main import main as handsim
from train import simulate_take

MOST = 2.0  # seconds from the last signal to the end
HANGS = 30.0  # seconds after which a recording is killed
BETWEEN = 0.3  # seconds between two signals, at most
SIGNALS = (signal.SIGINT, signal.SIGTERM)
FORK = get_context("fork")  # modules and kernels are loaded once


class End(NamedTuple):
    """How a recording ended."""

    seconds: float
    """From the last signal on."""
    well: bool
    met: bool
    """Whether it still ran when a second signal came."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--rates", type=float, nargs="+", default=[30.0, 120.0, 1000.0])
    parser.add_argument("--busy", type=int, default=2, help="processes that only compute")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    failed = False
    with tempfile.TemporaryDirectory(prefix="endings-") as folder:
        capture = Path(folder) / "take.c3d"
        write_capture(capture, simulate_take(num_frames=240).capture())
        with redirect_stdout(io.StringIO()):  # loads what forks share
            handsim(["track", str(capture), "--size", "M", "--out", str(capture.with_suffix(".npz"))])
        for _ in range(options.busy):
            FORK.Process(target=compute, daemon=True).start()
        print(f"{'rate':>7s} {'signals':12s}{'median':>8s}{'slowest':>9s}{'well':>6s}{'of':>4s}{'met':>5s}")
        for rate in options.rates:
            with served(capture, rate) as url:
                for number, count in itertools.product(SIGNALS, (1, 2)):
                    ends = [ended(url, Path(folder), number, count, rng) for _ in range(options.times)]
                    print(f"{rate:4.0f} Hz {count} {number.name:10s}{row(ends)}", flush=True)
                    failed |= not all(end.well and end.seconds < MOST for end in ends)
    return int(failed)


def row(ends: Sequence[End]) -> str:
    """The figures of some recordings in one line."""
    seconds = [end.seconds for end in ends]
    counts = f"{sum(end.well for end in ends):6d}{len(ends):4d}{sum(end.met for end in ends):5d}"
    return f"{statistics.median(seconds):6.2f} s{max(seconds):7.2f} s{counts}"


def compute() -> None:
    """Keep a core busy."""
    while True:
        pass


@contextmanager
def served(capture: Path, rate: float) -> Iterator[str]:
    """The address of a server that plays a capture again and again."""
    run = "import sys; from handsim.cli.main import main; main(sys.argv[1:])"
    command = [sys.executable, "-u", "-c", run, "replay", str(capture), "--loop", "--port", "0"]
    with subprocess.Popen(
        [*command, "--rate", str(rate)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            yield str(server.stdout.readline()).split()[-1]  # type: ignore[union-attr]
        finally:
            server.kill()


def ended(url: str, folder: Path, number: signal.Signals, count: int, rng: random.Random) -> End:
    """Record a stream, and end that by so many signals."""
    out, part, said = folder / "live.npz", folder / "live.npz.part", folder / "said.txt"
    recording = FORK.Process(target=record, args=(url, out, said), daemon=True)
    recording.start()
    while frames_in(part) < 2 and recording.is_alive():
        time.sleep(0.01)
    recording.join(rng.uniform(0.0, BETWEEN))
    there = frames_in(part)
    for later in range(count):
        if later:
            recording.join(rng.uniform(0.0, BETWEEN))
        runs, start = recording.is_alive(), time.monotonic()
        if runs:
            os.kill(int(recording.pid or 0), number)
    recording.join(HANGS)
    seconds = time.monotonic() - start
    if recording.is_alive():
        recording.kill()
        recording.join()
    well = ended_well(recording, out, part, there, (0,) if count == 1 else (0, 128 + number))
    if not well:
        print(f"code {recording.exitcode}, {sorted(os.listdir(folder))}: {said.read_text()}", flush=True)
    for file in folder.glob("*live*"):
        file.unlink()
    return End(seconds, well, count == 2 and runs)


def record(url: str, out: Path, said: Path) -> None:
    """The process that records."""
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    with said.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os._exit(handsim(["track", "--live", url, "--size", "M", "--out", str(out)]))


def frames_in(part: Path) -> int:
    """The frames that are in a recording so far."""
    try:
        return GrownArchive(part).num_frames
    except (OSError, ValueError):  # it is not there yet, or not its whole header
        return 0


def ended_well(process: BaseProcess, out: Path, part: Path, there: int, expected: tuple[int, ...]) -> bool:
    """Whether the exit code is one of the expected ones, and the frames that were there are on disk."""
    kept = out if out.exists() else part
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CutOffWarning)
        take = load_take(kept)
    is_whole = take.num_frames >= there and bool((np.diff(take.numbers) > 0).all())
    is_done = kept == out and not part.exists() and not list(out.parent.glob(".*"))
    return process.exitcode in expected and is_whole and (is_done or process.exitcode != 0)


if __name__ == "__main__":
    sys.exit(main())
