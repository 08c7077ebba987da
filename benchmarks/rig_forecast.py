"""How well `handsim rig score` forecasts what simulated captures miss, and what `handsim rig plan` is worth.

Rank correlation over eight rigs, shipped, planned and bad ones, of 3 to 16 cameras. The captures have other
people and motions than the forecast, and the losses and reflections that `handsim simulate` has by default
for each kind of work. Then planned rigs beside rigs by hand, of 4 to 12 cameras on the same truss.

python -m benchmarks.rig_forecast [--frames 1500] [--folder RIGS]

The rigs are written into the folder, for `python -m benchmarks.paper cameras --rig FILE`.
"""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks.record import describe, run
from gloves import load_layout
from gloves.captures.capture import run_lengths
from handsim import CameraRig, load_rig, look_at
from handsim.space.rig import ROOM_CENTER, list_rigs
from train import Forecast, plan_rig, simulate_take
from train.forecast.rig_forecast import forecast, light_work, sample_work
from train.simulation.scenes import SimulatedKind

GLOVE = "dense19"
CAPTURES: tuple[tuple[SimulatedKind, int], ...] = (
    ("real-like", 101),
    ("single-hand", 102),
    ("hand-hand", 103),
    ("hand-pen", 104),
    ("hand-controller", 105),
)
CENTER, SIDES = np.array(ROOM_CENTER), np.full(3, 0.6)
FRAME = np.array([2.4, 1.8, 2.2])
CAMERA = load_rig("six").cameras[0]
FIGURES = ("missing [%]", "gaps [1/marker/min]", "ghosts [1/frame]")
ERROR = "error [mm]"
COUNTS = (4, 5, 6, 8, 10, 12)  # cameras of the rigs that are planned and hung by hand


def main(frames: int = 1500, folder: Path | None = None) -> None:
    print(describe("numpy", "numba"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        compare(folder, frames)
        compare_placements(folder, frames)


def compare(folder: Path, frames: int) -> None:
    """Print the forecast and the captures of every rig by kind of work, and how alike their ranks are."""
    work = sample_work(load_layout(GLOVE), CENTER, SIDES, 900, 2, rng=np.random.default_rng(0))
    told, found = [], []
    for rig in rigs():
        path = folder / f"{rig.name}.toml"
        rig.save(path)
        lit = light_work(work, rig, rng=np.random.default_rng(0))
        told.append([figures_of(forecast(lit[kind], rig)) for kind, _ in CAPTURES])
        found.append([captured(path, frames, kind, seed)[:-1] for kind, seed in CAPTURES])
        print(f"{rig.name} ({len(rig.positions)} cameras), forecast / captured: {', '.join(FIGURES)}")
        for (kind, _), expected, seen in zip(CAPTURES, told[-1], found[-1], strict=True):
            pairs = "  ".join(f"{one:7.1f} /{other:7.1f}" for one, other in zip(expected, seen, strict=True))
            print(f"  {kind:16s} {pairs}", flush=True)
    for number, figure in enumerate(FIGURES):
        ranks = [
            spearmanr(np.array(told)[:, kind, number], np.array(found)[:, kind, number]).statistic
            for kind in range(len(CAPTURES))
        ]
        listed = ", ".join(f"{kind} {rank:.2f}" for (kind, _), rank in zip(CAPTURES, ranks, strict=True))
        print(f"rank correlation over the rigs, {figure}: {listed}")


def figures_of(one: Forecast) -> tuple[float, float, float]:
    """The figures that are compared."""
    return 100 * one.missing, one.gaps, one.ghosts


def rigs() -> list[CameraRig]:
    """Shipped, planned and bad rigs."""
    planned = [planned_rig(count) for count in (4, 8, 12)]
    row = [
        dataclasses.replace(
            CAMERA, name=f"camera{number}", T_world_camera=look_at(np.array([x, -1.5, 1.8]), CENTER)
        )
        for number, x in enumerate((-0.75, -0.25, 0.25, 0.75), 1)
    ]
    return [
        *(load_rig(name) for name in list_rigs()),
        *planned,
        CameraRig("three", load_rig("six").cameras[:3]),
        CameraRig("row", row),
    ]


def planned_rig(count: int) -> CameraRig:
    """So many cameras on the truss, where `handsim rig plan` has them."""
    name = f"planned{count}"
    where = {"mounts": ("truss",), "volume": tuple(SIDES), "center": ROOM_CENTER}
    return plan_rig(count, FRAME, name=name, camera=CAMERA, glove=GLOVE, **where).rig


def hung_rig(count: int) -> CameraRig:
    """So many cameras spread evenly over the upper beams of the truss, as people hang them."""
    width, depth, height = FRAME
    corners = 0.5 * np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]])
    lengths = np.array([width, depth, width, depth])
    cameras = []
    for number in range(count):
        along = (number + 0.5) / count * lengths.sum()
        side = int(np.searchsorted(np.cumsum(lengths), along))
        share = (along - lengths[:side].sum()) / lengths[side]
        x, y = corners[side] + share * (corners[(side + 1) % 4] - corners[side])
        pose = look_at(np.array([x, y, height]), CENTER)
        cameras.append(dataclasses.replace(CAMERA, name=f"camera{number + 1}", T_world_camera=pose))
    return CameraRig(f"hung{count}", cameras)


def compare_placements(folder: Path, frames: int) -> None:
    """Print what captures before planned rigs miss, and before rigs by hand."""
    better = np.zeros(4, int)
    for count in COUNTS:
        means = []
        for rig in (hung_rig(count), planned_rig(count)):
            path = folder / f"{rig.name}.toml"
            rig.save(path)
            means.append(np.mean([captured(path, frames, kind, seed) for kind, seed in CAPTURES], axis=0))
        better += means[1] < means[0]
        pairs = ", ".join(f"{one:.2f} / {other:.2f}" for one, other in zip(*means, strict=True))
        print(f"{count} cameras, by hand / planned, {', '.join((*FIGURES, ERROR))}: {pairs}", flush=True)
    print(f"planned better in {' / '.join(map(str, better))} of {len(COUNTS)}")


def captured(rig: Path, frames: int, kind: SimulatedKind, seed: int) -> tuple[float, float, float, float]:
    """What a simulated capture misses: share of marker-frames [%], gaps per marker-minute, ghosts a frame.

    And the root mean square distance of its points from the markers [mm].
    """
    take = simulate_take(kind, glove=GLOVE, num_frames=frames, rig=rig, seed=seed)
    present = take.markers_present()[:, : take.hand_labels[-1].stop]
    ghosts = np.isfinite(take.points[..., 0]) & (take.labels < 0)
    minutes = present.size / take.rate / 60.0
    true = np.concatenate([hand.fit.markers(hand.qpos)[0] for hand in take.moving_hands()], axis=1)
    squares = np.sum((take.observed(range(true.shape[1])) - true) ** 2, axis=-1)
    error = 1e3 * float(np.sqrt(np.nanmean(squares)))
    gaps = len(run_lengths(~present)) / minutes
    return 100 * (~present).mean(), gaps, ghosts.sum(axis=1).mean(), error


if __name__ == "__main__":
    run(main, __doc__)
