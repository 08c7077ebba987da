"""An hour of `handsim track --live`: people come, leave and change, hands hide, and the server dies twice.

python -m benchmarks.long_session FOLDER [--seconds 3600]

Three minutes, one of each of three simulated people, are played again and again by a NatNet server in a
process of its own, which is killed and started again twice. The command line tracks and records the stream,
and sends it to a reader, which is a process of its own. Ctrl-C ends it. Then its take and what was sent are
compared with each other and with the truth, the last minute of each person with the second one. FOLDER keeps
all of it. Exit code 1 tells that a bound is missed.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from types import SimpleNamespace
from typing import Final, NamedTuple

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.live_output import free_ports, messages
from benchmarks.record import describe, resident_memory, run
from gloves import Take, load_layout, load_take
from gloves.takes.points import Status
from handsim import load_rig
from handsim.hand.model import hand_keypoints
from handsim.hand.shape import NUM_KEYPOINTS
from track import ReplayServer
from track.streams import LOOPBACK
from train.simulation.room import record_take, usual_room
from train.simulation.scenes import Kind, sample_scene_motion
from train.simulation.training_frames import sample_adult_hands, wear_gloves

SPAWN = multiprocessing.get_context("spawn")
RATE: Final = 120.0  # of the simulated captures [Hz]
SIDES: Final = ("right", "left")
PIECE: Final = 2340  # frames of a piece
MINUTE: Final = 7200  # frames of a person
ROUND: Final = 3 * MINUTE  # frames that are repeated
PIECES: Final[tuple[tuple[int, Kind, int], ...]] = (
    # Number of the person, kind of capture, and number of empty frames that follow; 120 or more are a pause.
    (0, "hand-hand", 84),
    (0, "single-hand", 0),
    (0, "hand-hand", 96),
    (1, "single-hand", 0),
    (1, "hand-hand", 0),
    (1, "single-hand", 180),
    (2, "hand-hand", 180),
    (2, "single-hand", 0),
    (2, "hand-hand", 0),
)
HIDDEN: Final = ((480, 600, 0), (900, 990, 1))  # frames of each piece without points of a hand
DEATHS: Final = ((1, 2, 1000), (3, 4, 4000))  # share of the frames, and frames after it
DOWN: Final = 3.0  # [s] from the death of a server to the next one
SAMPLED: Final = 10.0  # [s] between two looks at the memory
FLAT, SAME, AWAY = 1.03, 0.03, 0.5  # bounds: ratio of memory, change of a minute, distance [mm]


class Round(NamedTuple):
    """What the server repeats, and the truth."""

    points: np.ndarray  # (T, N, 3) [m]
    ids: np.ndarray  # (T, N)
    keypoints: np.ndarray  # (T, 2, 21, 3) of the right and the left hand [m]; NaN where they are away


def make_round() -> Round:
    """Captures of three people, one after the other."""
    layout, rig = load_layout("dense19"), load_rig("figure5")
    people = []
    for number in range(3):
        rng = np.random.default_rng((number, 76))
        models = sample_adult_hands(rng=rng)
        people.append(wear_gloves(layout, models, along=0.05, around=np.deg2rad(5.0), rng=rng))
    points, ids = np.full((ROUND, 80, 3), np.nan), np.full((ROUND, 80), -1)
    keypoints = np.full((ROUND, 2, NUM_KEYPOINTS, 3), np.nan)
    first = 0
    for place, (number, kind, away) in enumerate(PIECES):
        rng = np.random.default_rng((place, 77))
        scene = sample_scene_motion(kind, people[number], PIECE, rng=rng)
        take = record_take(scene, rig, usual_room(kind), {}, rng=rng)
        rows, width = slice(first, first + PIECE), take.points.shape[1]
        points[rows, :width] = take.points
        ids[rows, :width] = np.where(take.ids < 0, -1, take.ids + ids.max() + 1)
        for start, stop, hand in HIDDEN:
            own = np.isin(take.labels, take.hand_labels[hand])
            points[rows, :width][start:stop][own[start:stop]] = np.nan
            ids[rows, :width][stop:][own[stop:]] += 10_000  # seen again, they have new IDs
        for hand in range(2):
            keypoints[rows, hand] = hand_keypoints(take.hands[hand].model, take.qpos[:, hand])
        first += PIECE + away
    return Round(points, ids, keypoints)


class CountedServer(ReplayServer):
    """A server that repeats the round from a frame on, until `count` frames are sent."""

    def __init__(self, played: Round, first: int, count: int, port: int) -> None:
        self._count = count
        points, ids = (np.roll(one, -first, axis=0) for one in (played.points, played.ids))
        super().__init__(SimpleNamespace(points=points, ids=ids, rate=RATE), port=port, loop=True)

    @property
    def finished(self) -> bool:
        """Whether the last frame was sent."""
        return self.sent >= self._count


def serve(folder: Path, first: int, count: int, port: int, sent: Synchronized[int]) -> None:
    """Send frames until this process is killed."""
    with CountedServer(load_round(folder), first, count, port) as server:
        while True:
            sent.value = first + server.sent
            time.sleep(0.02)


def load_round(folder: Path) -> Round:
    """What the server of a session repeats."""
    path = folder / "round.npz"
    if not path.exists():
        np.savez(path, **make_round()._asdict())
    with np.load(path) as stored:
        return Round(*(stored[name] for name in Round._fields))


def listen(folder: Path, port: int, most: int) -> None:
    """Keep the number and the keypoints of each frame that a client of the command gets."""
    numbers = np.lib.format.open_memmap(folder / "numbers.npy", "w+", np.int32, (most,))
    shape = (most, 2, NUM_KEYPOINTS, 3)
    keypoints = np.lib.format.open_memmap(folder / "keypoints.npy", "w+", np.float32, shape)
    numbers[:], count = -1, 0
    while True:
        try:
            server = connect(f"ws://{LOOPBACK}:{port}/?every=1")
            break
        except OSError:
            time.sleep(0.1)
    with server, suppress(ConnectionClosed):
        for _, document in messages(server, 0.0, asks=False):
            if document["type"] != "frame" or document["silent"]:
                continue
            numbers[count] = document["number"]
            for hand in document["hands"]:
                keypoints[count, SIDES.index(hand["side"])] = hand["positions"] or np.nan
            count += 1


def hold(folder: Path, frames: int) -> None:
    """Run the session."""
    folder.mkdir(parents=True, exist_ok=True)
    load_round(folder)
    command, web = free_ports(socket.SOCK_DGRAM, socket.SOCK_STREAM)
    out, sent = folder / "take.npz", SPAWN.Value("q", 0)
    for old in (out, Path(f"{out}.part")):
        old.unlink(missing_ok=True)
    program = [sys.executable, "-m", "handsim", "track", "--live", f"natnet://{LOOPBACK}:{command}"]
    program += ["--out", str(out), "--send", f"ws://{LOOPBACK}:{web}"]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell's background jobs ignore Ctrl-C.
    memory = (folder / "memory.csv").open("w")
    with (folder / "track.log").open("w") as log:
        tracker = subprocess.Popen(program, stdout=log, stderr=subprocess.STDOUT)
    reader = SPAWN.Process(target=listen, args=(folder, web, frames + 10_000), daemon=True)
    reader.start()
    ends = [*lives(frames)[1:], frames]
    for first, last in zip(lives(frames), ends, strict=True):
        given = (folder, first, last - first, command, sent)
        server = SPAWN.Process(target=serve, args=given, daemon=True)
        server.start()
        while sent.value < last and tracker.poll() is None:
            memory.write(f"{time.time():.0f},{sent.value},{','.join(map(str, memory_of(tracker.pid)))}\n")
            memory.flush()
            until = time.monotonic() + SAMPLED
            while sent.value < last and time.monotonic() < until:
                time.sleep(0.05)
        time.sleep(0.5)
        server.kill()
        server.join()
        time.sleep(DOWN if last < frames else 0.0)
    at = time.monotonic()
    tracker.send_signal(signal.SIGINT)
    code = tracker.wait()
    reader.join(30.0)
    told = {"frames": frames, "exit code": code, "end [s]": time.monotonic() - at}
    (folder / "session.json").write_text(json.dumps(told))


def lives(frames: int) -> list[int]:
    """The first frame of each server."""
    return [0, *(frames * part // whole + more for part, whole, more in DEATHS)]


def memory_of(process: int) -> tuple[int, int]:
    """Memory of a process and of its children [bytes]."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return resident_memory(process), sum(resident_memory(int(child)) for child in children)


def places(numbers: np.ndarray, frames: int) -> np.ndarray:
    """Which frame of the session each number of a server is; numbers begin anew with each server."""
    life = np.cumsum(np.diff(numbers, prepend=numbers[:1]) < -ROUND // 2)
    return np.asarray(numbers + np.array(lives(frames))[life])


Check = tuple[str, float, float]
"""What is asked, what was found, and the most that is allowed."""


def judge(folder: Path) -> bool:
    """Print what became of the session; whether all bounds are held."""
    told, played = json.loads((folder / "session.json").read_text()), load_round(folder)
    take = load_take(folder / "take.npz")
    assert take.numbers is not None
    place = places(take.numbers, told["frames"])
    keypoints = take.keypoints()[:, [take.sides.index(side) for side in SIDES]]
    print(f"{told}; {take.settings['stream']}; {len(take.former)} former hands")
    checks = [("exit code", float(told["exit code"]), 0.0)]
    checks += kept_once(folder, take, place, keypoints, told["frames"])
    checks += memory_checks(folder)
    checks += drift(take, played, place, keypoints, told["frames"])
    for name, found, most in checks:
        print(f"{'held  ' if found <= most else 'MISSED'} | {name} | {found:.4g} | at most {most:g}")
    return all(found <= most for _, found, most in checks)


def kept_once(
    folder: Path, take: Take, place: np.ndarray, keypoints: np.ndarray, frames: int
) -> Iterator[Check]:
    """Count lost and doubled frames, and compare the keypoints of the messages and the take."""
    recorded, dropped = np.bincount(place, minlength=frames), take.settings["stream"]["dropped_frames"]
    yield "served frames neither in the take nor told as dropped", (recorded == 0).sum() - dropped, 0.0
    yield "frames told as dropped, as the tracker did not keep up [%]", 100.0 * dropped / frames, 0.0
    yield "frames twice in the take", (recorded > 1).sum(), 0.0
    numbers = np.load(folder / "numbers.npy")
    at = places(numbers[numbers >= 0], frames)
    sent = np.load(folder / "keypoints.npy", mmap_mode="r")[: len(at)]
    read = np.bincount(at, minlength=frames)
    yield "recorded frames that were not sent", ((recorded > 0) & (read == 0)).sum(), 0.0
    yield "frames sent twice", (read > 1).sum(), 0.0
    rows = np.full(frames, -1)
    rows[place] = np.arange(len(place))
    both = rows[at] >= 0
    yield "sent keypoints off those of the take [mm]", farthest(sent[both], keypoints[rows[at[both]]]), AWAY


def memory_checks(folder: Path) -> Iterator[Check]:
    """Memory of the last sixth of the session over that of the second sixth, in the median."""
    resident = np.loadtxt(folder / "memory.csv", delimiter=",", ndmin=2)[:, 2:]
    sixth = len(resident) // 6
    before, after = np.median(resident[sixth : 2 * sixth], axis=0), np.median(resident[-sixth:], axis=0)
    for name, first, last in zip(("the tracker", "the process that measures"), before, after, strict=True):
        words = f"memory of {name}, from {1e-6 * first:.1f} to {1e-6 * last:.1f} MB: ratio"
        yield words, last / max(first, 1.0), FLAT


def drift(
    take: Take, played: Round, place: np.ndarray, keypoints: np.ndarray, frames: int
) -> Iterator[Check]:
    """The last minute of each person over the second one, in frames that both have."""
    order = [take.sides.index(side) for side in SIDES]
    off = np.linalg.norm(keypoints - played.keypoints[place % ROUND], axis=-1).mean(axis=-1)
    values = 1e3 * np.stack([take.rms[:, order], off])
    values[:, take.status[:, order] != Status.TRACKED] = np.nan
    minutes = np.full((2, 2, ROUND, 2), np.nan)  # residual and error, second and last minute, row, hand
    for which, first in enumerate((ROUND, (frames + 1) // ROUND * ROUND - ROUND)):
        some = place // ROUND == first // ROUND
        minutes[:, which, place[some] % ROUND] = values[:, some]
    minutes[:, :, np.isnan(minutes).any(axis=(0, 1))] = np.nan
    means = np.nanmean(minutes, axis=(2, 3))
    for name, (second, last) in zip(("residual", "keypoints' error"), means, strict=True):
        words = f"{name}, from {second:.3f} to {last:.3f} mm in the last minute over the second, less 1"
        yield words, abs(last / second - 1.0), SAME


def farthest(sent: np.ndarray, others: np.ndarray) -> float:
    """Largest distance of keypoints [mm]; infinite where only one of them is there."""
    distances = 1e3 * np.linalg.norm(sent - others, axis=-1)
    if (np.isnan(sent[..., 0]) != np.isnan(others[..., 0])).any():
        return np.inf
    return float(np.nanmax(distances))


def main(folder: Path, seconds: float = 3600.0) -> None:
    print(describe("numba", "torch", "websockets"))
    hold(folder, round(seconds * RATE) - 1)
    if not judge(folder):
        sys.exit(1)


if __name__ == "__main__":
    run(main, __doc__)
