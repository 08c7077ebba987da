"""Every speed that pages quote, in one run, each also in a unit that the machine gave a moment before.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed
        [--only tracker labels commands] [--seeds 0 1 2 3 4] [--quick] [--save speed]

The unit is the time of 1,000 calls of MuJoCo's `mj_kinematics` on our hand, measured anew before each
section: where another machine or another hour has another unit, compare figures in units. Times are the
median, the 99th percentile and the longest over all seeds.

tracker: a frame with two hands, for each kind of capture, of the true hands; of hand-hand with a new ID for
    every point in every frame; a frame in which both hands are initialized.
labels: one hand with drops and ghosts; of a glove without weights, and learning it.
commands: what users type, with its defaults, from its start to its end; five times each, with the kernels
    compiled but for the rows that say otherwise. Captures are of two hands, apart or touching.

Run it where nothing else runs. --quick tries every part with a few frames and one seed. The conditions of the
run are printed and saved with its figures: seeds, what was left out, processors, threads and load.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, get_args
from unittest import mock

import mujoco
import numpy as np
import torch

from benchmarks.held_out import held_out_markers
from benchmarks.paper.take_evaluation import nominal_users, seen_frame, true_users
from benchmarks.record import Figures, describe, run, save_figures, timed
from gloves import GloveFit, Take, write_capture
from handsim import HandModel
from track import Tracker
from train import Corruption, Labeler, corrupt, load_labeler, simulate_take
from train.simulation.scenes import KINDS, Kind

NEW_GLOVE: Final = Path(__file__).parents[1] / "examples" / "ten_markers.toml"
WARM_UP: Final = 30  # frames of a tracker that do not count
Section = Literal["tracker", "labels", "commands"]
CAPTURES: Final[tuple[tuple[str, Kind, int], ...]] = (
    ("short", "single-hand", 24),
    ("hand", "single-hand", 1632),
    ("touching", "hand-hand", 1200),
    ("minute", "hand-hand", 7200),
)
RENDER: Final = "render touching.npz --out {out} --num-frames"
COMMANDS: Final = (
    ("label_first", "label of 24 frames from an empty cache", "label short.c3d --out {out}.trc"),
    ("label_24", "label of 24 frames", "label short.c3d --out {out}.trc"),
    ("label_7200", "label of a minute of touching hands", "label minute.c3d --out {out}.trc"),
    ("track_7200", "track of a minute of touching hands", "track minute.c3d --out {out}.npz"),
    ("track_calibrate", "track --calibrate of 13.6 s", "track hand.c3d --calibrate --out {out}.npz"),
    ("render_600", "render of 600 pictures", f"{RENDER} 600"),
    ("render_depth", "render of 200 pictures, depth alone", f"{RENDER} 200 --passes depth"),
    ("generate_60000", "generate of 60,000 frames", "generate --num-frames 60000 --out {out}"),
)  # fmt: skip


class Speeds:
    """What is measured: printed, and kept as figures."""

    def __init__(self, seeds: tuple[int, ...], *, quick: bool) -> None:
        self.seeds = seeds
        self._quick = quick
        self.figures: Figures = {}
        self._unit = unit()
        self._units = [self._unit]

    def some(self, full: int, few: int) -> int:
        """A number of frames, or of other things: all, or a few for a try."""
        return few if self._quick else full

    def begin(self, section: str) -> None:
        """Measure the unit for a section."""
        self._unit = unit()
        self._units.append(self._unit)
        what = "1,000 calls of mj_kinematics before each section, least and most [ms]"
        self.figures["unit"] = (what, [1e3 * min(self._units), 1e3 * max(self._units)])
        print(f"\n{section}; the unit is {1e3 * self._unit:.2f} ms", flush=True)

    def times(self, key: str, what: str, seconds: Sequence[float]) -> None:
        """Keep the distribution of a time [s]."""
        milliseconds = 1e3 * np.asarray(seconds)
        row = [*np.quantile(milliseconds, [0.5, 0.99, 1.0]), np.median(seconds) / self._unit]
        self.figures[key] = (f"{what}: median, 99th percentile, longest [ms]; median in units", row)
        shown = "{:9.3f} {:9.3f} {:9.3f} ms {:9.4f} units".format(*row)
        print(f"  {what:66s} {shown}", flush=True)


def unit() -> float:
    """Time of 1,000 calls of `mj_kinematics` on our hand [s]."""
    model = HandModel.named("M").mj_model
    data = mujoco.MjData(model)
    data.qpos[7:] = 0.3
    return float(np.median([timed(lambda: [mujoco.mj_kinematics(model, data) for _ in range(1000)])
                            for _ in range(15)]))  # fmt: skip


def each_hand(some: Labeler, hands: list[np.ndarray]) -> list[float]:
    """Time of each hand's labels [s], after a tenth of them to warm up."""
    for hand in hands[: len(hands) // 10 + 1]:
        some.label_frames([hand])
    return [timed(functools.partial(some.label_frames, [hand])) for hand in hands]


@cache
def labeler() -> Labeler:
    """The shipped labeler of dense19."""
    return load_labeler("dense19")


def tracker(speeds: Speeds) -> None:
    frames = speeds.some(1200, 120)
    takes = {
        kind: [simulate_take(kind=kind, num_frames=frames, seed=seed).without_body() for seed in speeds.seeds]
        for kind in KINDS
    }
    for kind, some in takes.items():
        Tracker(nominal_users(some[0]), labeler()).warm_up()
        key = kind.replace("-", "_")
        true = [follow(take, true_users(take)) for take in some]
        speeds.times(f"{key}_true", f"a frame of {kind}, two true hands", np.concatenate(true))
    fresh = [follow(take, true_users(take), fresh=True) for take in takes["hand-hand"]]
    speeds.times("fresh_ids", "a frame of hand-hand, every ID new in every frame", np.concatenate(fresh))
    every = [take for some in takes.values() for take in some]
    count = speeds.some(25, 5)
    starts = [first_frame(take, at) for take in every for at in spread(take.num_frames, count)]
    speeds.times("initialization", "a frame in which both hands are initialized", starts)


def spread(end: int, count: int) -> list[int]:
    """So many numbers below an end, evenly apart."""
    return np.linspace(0, end - 1, count).astype(int).tolist()


def follow(take: Take, users: Sequence[GloveFit], *, fresh: bool = False) -> list[float]:
    """Time of each frame of a take [s]; with `fresh` every point has a new ID in every frame."""
    tracking, lap, times = Tracker(users, labeler()), int(take.ids.max()) + 1, []
    for number in range(take.num_frames):
        seen = seen_frame(take, number)
        ids = seen.ids + number * lap if fresh else seen.ids
        times.append(timed(functools.partial(tracking.step, seen.points, ids, number / take.rate)))
    return times[WARM_UP:]


def first_frame(take: Take, at: int) -> float:
    """Time of a new tracker's first frame [s]."""
    tracking, seen = Tracker(true_users(take), labeler()), seen_frame(take, at)
    return timed(lambda: tracking.step(seen.points, seen.ids, 0.0))


def clouds(glove: str, count: int, seeds: tuple[int, ...]) -> list[np.ndarray]:
    """Held-out hands [m] with the paper's drops and ghosts."""
    found: list[np.ndarray] = []
    for seed in seeds:
        markers = held_out_markers(glove, count, seed=seed)
        cloud = corrupt(markers, Corruption(), rng=np.random.default_rng(seed))
        found += [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]
    return found


def labels(speeds: Speeds) -> None:
    hands = clouds("dense19", speeds.some(1000, 50), tuple(speeds.seeds))
    speeds.times("set", "one hand, set labeler", each_hand(labeler(), hands))
    with tempfile.TemporaryDirectory() as empty, mock.patch.dict(os.environ, XDG_CACHE_HOME=empty):
        start = time.perf_counter()
        learned = load_labeler(NEW_GLOVE, "any-layout")
        took = time.perf_counter() - start
    speeds.times("new_glove_learned", "learning a glove without weights", [took])
    hands = clouds(str(NEW_GLOVE), speeds.some(300, 20), tuple(speeds.seeds))
    speeds.times("new_glove", "one hand, a glove without weights", each_hand(learned, hands))


def commands(speeds: Speeds) -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # users have compiled modules after the first run
    os.environ.pop("NUMBA_NUM_THREADS", None)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for shown, kind, frames in CAPTURES:
            take = simulate_take(kind=kind, num_frames=speeds.some(frames, 24), seed=speeds.seeds[0])
            write_capture(folder / f"{shown}.c3d", take.capture())
            take.save(folder / f"{shown}.npz")
        type_in("doctor --compile", folder)
        for key, what, words in COMMANDS:
            times = []
            for number in range(speeds.some(5, 1)):
                cache = {"NUMBA_CACHE_DIR": f"{folder}/cache{number}"} if "empty cache" in what else {}
                typed = words.format(out=f"{key}{number}")
                times.append(timed(functools.partial(type_in, typed, folder, cache)))
            speeds.times(key, f"handsim {what}", times)


def type_in(words: str, folder: Path, environment: Mapping[str, str] = MappingProxyType({})) -> None:
    """Run `handsim` with these words in a folder, and wait until it ends."""
    command = [sys.executable, "-m", "handsim", *words.split()]
    subprocess.run(command, cwd=folder, env={**os.environ, **environment}, check=True, capture_output=True)


def main(
    only: tuple[Section, ...] = get_args(Section),
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
    quick: bool = False,
    save: str | None = None,
) -> None:
    if save and quick:
        raise SystemExit("--quick is a try and saves nothing")
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(describe("mujoco", "numba", "torch"))
    speeds = Speeds(seeds[:1] if quick else seeds, quick=quick)
    load = os.getloadavg()[0]
    for name in only:
        speeds.begin(name)
        globals()[name](speeds)
    left_out = ", ".join(name for name in get_args(Section) if name not in only) or "nothing"
    openblas = os.environ.get("OPENBLAS_NUM_THREADS", "as many as processors")
    cores, vectors = len(os.sched_getaffinity(0)), torch.backends.cpu.get_cpu_capability()
    conditions = (
        f"This run was of{' a few frames of' if quick else ''} the seeds "
        f"{', '.join(map(str, speeds.seeds))}, on {cores} processors with {vectors}. Left out: {left_out}. "
        f"Threads: torch {torch.get_num_threads()}, OpenBLAS {openblas}. {load:.1f} processes wanted to run "
        f"before it, and {os.getloadavg()[0]:.1f} at its end."
    )
    print(f"\n{conditions}")
    save_figures(save, speeds.figures, conditions=conditions)


if __name__ == "__main__":
    run(main, __doc__)
