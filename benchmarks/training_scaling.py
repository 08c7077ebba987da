"""Training in one process and in several: samples a second, loss and accuracy after equal samples, memory.

python -m benchmarks.training_scaling [--samples 100000] [--seeds 3] [--devices 1 2] [--frames 40000]
                                      [--set DIR] [-- OPTIONS OF handsim train]

Each process has one thread. The memory is that of the training's processes at its largest; PSS counts a page
that several processes share once in all. Losses and accuracies of the seeds say how much is noise.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import describe
from train.loop import CHECKPOINT
from train.simulation.generation import make_dataset
from train.simulation.training_frames import DatasetConfig

HANDSIM = [sys.executable, "-c", "import sys; from handsim.cli.main import main; sys.exit(main())"]
EVERY = 1.0  # [s] between two looks at the memory
PARTS = (0.25, 0.5, 0.75, 1.0)  # of the run, where losses are compared
ROWS = re.compile(r"/rows-\d+\.npy$", re.M)


@dataclass
class Memory:
    """Of one process [MB]; `rows` is the training set's share."""

    rss: float = 0.0
    pss: float = 0.0
    rows_rss: float = 0.0
    rows_pss: float = 0.0


@dataclass
class Run:
    """What a run came to."""

    speed: float
    losses: list[float]
    accuracy: float
    corrupted: float
    memory: list[Memory] = field(default_factory=list)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=40_000)
    parser.add_argument("--set", type=Path)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    print(describe("torch", "lightning-fabric"))
    with tempfile.TemporaryDirectory() as folder:
        dataset = given.set or Path(folder) / "set"
        if given.set is None:
            make_dataset(DatasetConfig(num_frames=given.frames), dataset)
        runs: dict[int, list[Run]] = {devices: [] for devices in given.devices}
        for seed in range(given.seeds):
            for devices in given.devices:
                out = Path(folder) / f"{devices}-{seed}"
                options = ["--samples", str(given.samples), "--seed", str(seed), *given.options]
                runs[devices].append(train(dataset, out, devices, options))
                print(f"seed {seed}, {devices} processes: {runs[devices][-1]}", file=sys.stderr)
        size = sum(file.stat().st_size for file in dataset.glob("rows-*.npy")) / 1e6
    report(runs, size)


def train(dataset: Path, out: Path, devices: int, options: list[str]) -> Run:
    """Run `handsim train` and look at the memory of its processes now and then."""
    several = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={devices}"]
    start = [*several, "-m", "handsim.cli.main"] if devices > 1 else HANDSIM
    command = [*start, "train", str(dataset), "--out", str(out)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([*command, "--threads", "1", *options], stdout=said, stderr=said)
        largest: list[Memory] = []
        while process.poll() is None:
            looked = [memory_of(number) for number in ranks_of(process.pid, devices)]
            if sum(one.pss for one in looked) > sum(one.pss for one in largest):
                largest = looked
            time.sleep(EVERY)
        said.seek(0)
        if process.returncode:
            sys.exit(said.read().decode())
    history = torch.load(out / CHECKPOINT, weights_only=True)["history"]
    card = json.loads((out / "labeler.json").read_text())
    done, losses, _ = np.array(history["losses"]).T
    figures = list(card["held_out_simulated"].values())
    return Run(
        speed=done[-1] / (60.0 * history["minutes"]),
        losses=[float(np.interp(part * done[-1], done, losses)) for part in PARTS],
        accuracy=figures[0]["slot_accuracy"],
        corrupted=figures[1]["slot_accuracy"],
        memory=largest,
    )


def ranks_of(process: int, devices: int) -> list[int]:
    """The processes that train: this one, or those that it started and that know the training set."""
    if devices == 1:
        return [process]
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [int(child) for child in children if ROWS.search(maps_of(int(child)))]


def maps_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/maps").read_text()
    except OSError:
        return ""


def memory_of(process: int) -> Memory:
    """The memory of a process; nothing if it has ended."""
    memory, in_rows = Memory(), False
    try:
        lines = Path(f"/proc/{process}/smaps").read_text().splitlines()
    except OSError:
        return memory
    for line in lines:
        name, _, value = line.partition(":")
        if name in ("Rss", "Pss"):
            amount = int(value.split()[0]) / 1e3
            setattr(memory, name.lower(), getattr(memory, name.lower()) + amount)
            if in_rows:
                attribute = f"rows_{name.lower()}"
                setattr(memory, attribute, getattr(memory, attribute) + amount)
        elif "-" in name.split(" ")[0]:  # the head of a mapping: addresses, rights, file
            in_rows = bool(ROWS.search(line))
    return memory


def report(runs: dict[int, list[Run]], size: float) -> None:
    """Print the means over seeds and their standard deviations."""
    print(f"training set: {size:.1f} MB of rows")
    print(
        "processes  samples/s (min-max)   loss at " + "  ".join(f"{part:4.0%}      " for part in PARTS),
        end="",
    )
    print("held out, clean [%]  corrupted [%]")
    for devices, done in runs.items():
        speeds = [run.speed for run in done]
        losses = np.array([run.losses for run in done])
        told = "  ".join(map(spread, losses.T))
        clean, corrupted = ([getattr(run, name) * 100 for run in done] for name in ("accuracy", "corrupted"))
        print(
            f"{devices:9}  {np.median(speeds):7.0f} ({min(speeds):.0f}-{max(speeds):.0f})   {told}  "
            f"{spread(clean, 2)}  {spread(corrupted, 2)}"
        )
    print("processes  memory of each [MB]: RSS, PSS; of these the rows: RSS, PSS")
    for devices, done in runs.items():
        for memory in done[-1].memory:
            print(
                f"{devices:9}  {memory.rss:6.0f} {memory.pss:6.0f}   "
                f"{memory.rows_rss:6.1f} {memory.rows_pss:6.1f}"
            )


def spread(values: list[float] | np.ndarray, digits: int = 4) -> str:
    """Mean and standard deviation."""
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.{digits}f}±{deviation:.{digits}f}"


if __name__ == "__main__":
    main()
