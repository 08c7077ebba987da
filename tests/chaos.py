"""Kill every long command at random moments, run it again, and compare.

    python -m tests.chaos [generate train ...] [--kills 20 --seed 0]

Each command runs once undisturbed, one that enlarges an output after the one before it. Then it is killed
by SIGTERM, SIGKILL, SIGINT and SIGHUP in turn, at a random moment, and run again to its end. The table
counts what must be zero: reruns whose files differ, processes that outlive the command, temporary files
after the rerun, files that stay in /dev/shm, and ends with a traceback or with an exit code that is not the
signal's. Ctrl-C goes to the whole group of processes, as from a terminal; the other signals go to the
command alone. The last column is the longest time from SIGTERM or SIGINT to the end. Exit code 1 when a
count is not zero.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import tyro

from render.illustrations import write_video
from tests.film.filmed import SIZE, Filming, moving_take

SIGNALS = (signal.SIGTERM, signal.SIGKILL, signal.SIGINT, signal.SIGHUP)
ROOT = Path(__file__).resolve().parents[1]
COMMAND = "import sys; from handsim.cli.main import main; sys.exit(main())"
# Python runs this as the command and its workers start, so that a small set has several shards. Processes
# that libraries start while they are imported must not import them again.
SMALL_SHARDS = f"""
import sys
if any(word.startswith(({COMMAND!r}, "from multiprocessing.")) for word in sys.orig_argv):
    from train.simulation import generation
    generation.ROWS_PER_SHARD = 150
"""
PATIENCE = 10.0  # [s] A killed command is gone by then; workers that are starting end when they have started.
ALONE = ("--scenes.together", "0", "--scenes.holding", "0")
NETWORK = ("--network.width", "8", "--network.gates", "2", "--network.depth", "1", "--batch", "32")


@dataclass(frozen=True)
class Case:
    """A command; WORK stands for the folder with its inputs, OUT for what it writes."""

    args: tuple[str, ...]
    files: str = "**/*"
    """Those of its files that depend on nothing but the settings."""
    before: tuple[str, ...] = ()
    """A command that ends before it in the same folder, whose output it enlarges."""


GENERATE = ("generate", *ALONE, "--workers", "2", "--out", "OUT", "--num-frames")
TRAIN = ("train", "WORK/set", "--out", "OUT", *NETWORK, "--threads", "1", "--samples")

CASES = {
    "generate": Case((*GENERATE, "900"), "*.[nj]*"),
    "grow-set": Case((*GENERATE, "900"), "*.[nj]*", before=(*GENERATE, "420")),
    "train": Case((*TRAIN, "20000"), "*.safetensors"),
    "grow-run": Case((*TRAIN, "20000"), "*.safetensors", before=(*TRAIN, "6400")),
    "render": Case(
        (
            *("render", "WORK/take.truth.npz", "--every", "4", "--frames-per-shard", "4", "--camera", "vga"),
            *("--workers", "2", "--out", "OUT"),
        )
    ),
    "simulate": Case(("simulate", "--num-frames", "240", "--out", "OUT/take.c3d")),
    "track": Case(("track", "WORK/take.c3d", "--out", "OUT/tracked.npz")),
    "calibrate": Case(("calibrate", "WORK/long.c3d", "--hands", "right", "--out", "OUT/user.json")),
    "label": Case(("label", "WORK/take.c3d", "--out", "OUT/labeled.c3d")),
    "folder": Case(("label", "WORK/captures", "--out", "OUT")),
    "report": Case(("report", "WORK/take.truth.npz", "--out", "OUT/page.html")),
    "export": Case(("export", "WORK/take.truth.npz", "--out", "OUT/hands.glb")),
    "film": Case(
        ("film", "WORK/filmed.npz", "WORK/video.mp4", "--num-frames", "4", "--workers", "2", "--out", "OUT"),
        "**/*.tar",
    ),
    "cnn": Case(
        (
            *("train", "WORK/set", "--out", "OUT", "--labeler", "cnn", "--samples", "640", "--batch", "32"),
            *("--threads", "1"),
        ),
        "*.safetensors",
    ),
    "improve": Case(("glove", "improve", "sparse13", "--minutes", "0", "--out", "OUT/better.toml")),
    "plan": Case(("rig", "plan", "--cameras", "3", "--room", "3", "3", "2.5", "--out", "OUT/rig.toml")),
}
Command = Literal[
    "generate", "grow-set", "train", "grow-run", "render", "simulate", "track", "calibrate", "label",
    "folder", "report", "export", "film", "cnn", "improve", "plan",
]  # fmt: skip
ALL: tuple[Command, ...] = get_args(Command)


@dataclass
class Counts:
    """What must be zero for a command, and how fast it ended."""

    kills: int = 0
    differing: int = 0
    orphans: int = 0
    temporary: int = 0
    segments: int = 0
    untold: int = 0
    slowest: float = 0.0

    def failed(self) -> bool:
        """Whether a count is not zero."""
        return bool(self.differing or self.orphans or self.temporary or self.segments or self.untold)


QUIET = {"stdout": subprocess.DEVNULL, "stdin": subprocess.DEVNULL, "cwd": ROOT}


def main(commands: tyro.conf.Positional[tuple[Command, ...]] = ALL, kills: int = 20, seed: int = 0) -> None:
    print(
        f"{'command':12s}{'kills':>7s}{'differ':>8s}{'orphans':>9s}{'temporary':>11s}{'shm':>5s}{'untold':>8s}{'slowest':>9s}"
    )
    failed = False
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder:
        work = Path(folder)
        (work / "sitecustomize.py").write_text(SMALL_SHARDS)
        os.environ["PYTHONPATH"] = os.pathsep.join([folder, os.environ.get("PYTHONPATH", str(ROOT))])
        prepare(work)
        for name in commands:
            counts = torment(name, work, kills, random.Random(f"{seed} {name}"))
            failed |= counts.failed()
            print(
                f"{name:12s}{counts.kills:7d}{counts.differing:8d}{counts.orphans:9d}{counts.temporary:11d}"
                f"{counts.segments:5d}{counts.untold:8d}{counts.slowest:7.1f} s",
                flush=True,
            )
    raise SystemExit(int(failed))


def prepare(work: Path) -> None:
    """Make what the commands read."""
    finish(("generate", "--num-frames", "900", *ALONE, "--out", f"{work}/set"))
    finish(("simulate", "--num-frames", "120", "--out", f"{work}/take.c3d"))
    finish(("simulate", "--kind", "hand-hand", "--num-frames", "900", "--out", f"{work}/long.c3d"))
    (work / "captures").mkdir()
    for name in ("a.c3d", "b.c3d", "c.c3d"):
        shutil.copy(work / "take.c3d", work / "captures" / name)
    filming, take = Filming(seed=21, seconds=8.0, rate=8.0, missing=0.0, swapped=0.0), moving_take()
    take.save(work / "filmed.npz")
    write_video(work / "video.mp4", iter(filming.pictures(take)), rate=filming.rate, size=SIZE)


def torment(name: str, work: Path, kills: int, rng: random.Random) -> Counts:
    """Run a command undisturbed, then kill it and run it again many times."""
    case, counts = CASES[name], Counts()
    whole, out, small = (work / f"{name}-{kind}" for kind in ("whole", "out", "small"))
    if case.before:
        finish(arguments(case.before, work, small))
        shutil.copytree(small, whole)
    start = time.monotonic()
    finish(arguments(case.args, work, whole))
    length = time.monotonic() - start
    expected = contents(whole, case.files)
    for number in range(kills):
        shutil.rmtree(out, ignore_errors=True)
        if case.before:
            shutil.copytree(small, out)
        shared = set(os.listdir("/dev/shm"))
        args = arguments(case.args, work, out)
        counts.slowest = max(
            counts.slowest, kill(args, rng.uniform(0.0, length), SIGNALS[number % len(SIGNALS)], counts)
        )
        counts.segments += len(set(os.listdir("/dev/shm")) - shared)
        finish(args)
        counts.kills += 1
        counts.differing += contents(out, case.files) != expected
        counts.temporary += len(list(out.glob("**/.*tmp*")))
    return counts


def kill(args: tuple[str, ...], after: float, number: signal.Signals, counts: Counts) -> float:
    """Kill a command after some seconds; count what outlives it, and return how long it took to end."""
    said = tempfile.TemporaryFile()
    process = subprocess.Popen(program(args), start_new_session=True, stderr=said, **QUIET)
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        if number == signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
    start = time.monotonic()
    ended = process.wait()
    took = time.monotonic() - start
    while (left := members(process.pid)) and time.monotonic() < start + took + PATIENCE:
        time.sleep(0.02)
    counts.orphans += len(left)
    for orphan in left:
        os.kill(orphan, signal.SIGKILL)
    said.seek(0)
    words = said.read()
    # Before the command has begun, Python itself is ended by the signal.
    counts.untold += ended not in (0, -number, 128 + number) or (b"Traceback" in words and ended != -number)
    return 0.0 if number == signal.SIGKILL else took


def members(session: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            state, _, _, of = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
        except (OSError, ValueError):
            continue
        if entry.name.isdecimal() and int(of) == session and state not in "ZX":
            found.append(int(entry.name))
    return found


def finish(args: tuple[str, ...]) -> None:
    """Run a command to its end."""
    result = subprocess.run(program(args), stderr=subprocess.PIPE, text=True, check=False, **QUIET)
    if result.returncode:
        raise SystemExit(f"{' '.join(args)} ended with {result.returncode}: {result.stderr}")


def program(args: tuple[str, ...]) -> list[str]:
    """The command as Python runs it."""
    return [sys.executable, "-c", COMMAND, *args]


def arguments(words: tuple[str, ...], work: Path, out: Path) -> tuple[str, ...]:
    out.parent.mkdir(exist_ok=True)
    return tuple(word.replace("WORK", str(work)).replace("OUT", str(out)) for word in words)


def contents(folder: Path, files: str) -> dict[str, str]:
    """SHA-256 of the files below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob(files))
        if path.is_file()
    }


if __name__ == "__main__":
    tyro.cli(main, description=__doc__, config=(tyro.conf.PositionalRequiredArgs,))
