"""What `handsim rig plan` is worth: planned rigs beside rigs by hand, of 4 to 12 cameras on the same truss.

The captures have other people and motions than the plan, and the losses and reflections that `handsim
simulate` has by default for each kind of work.

python -m benchmarks.rig_plan [--frames 1500]
"""

from __future__ import annotations

import dataclasses

import numpy as np

from benchmarks.record import describe, run
from gloves.captures.capture import run_lengths
from handsim import CameraRig, load_rig, look_at
from handsim.space.rig import ROOM_CENTER
from train import plan_rig, simulate_take
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
FIGURES = ("missing [%]", "gaps [1/marker/min]", "ghosts [1/frame]", "error [mm]")
COUNTS = (4, 5, 6, 8, 10, 12)  # cameras of the rigs that are planned and hung by hand


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


def main(frames: int = 1500) -> None:
    print(describe("numpy", "numba"))
    better = np.zeros(4, int)
    for count in COUNTS:
        hung, planned = (
            np.mean([captured(rig, frames, kind, seed) for kind, seed in CAPTURES], axis=0)
            for rig in (hung_rig(count), planned_rig(count))
        )
        better += planned < hung
        pairs = ", ".join(f"{one:.2f} / {other:.2f}" for one, other in zip(hung, planned, strict=True))
        print(f"{count} cameras, by hand / planned, {', '.join(FIGURES)}: {pairs}", flush=True)
    print(f"planned better in {' / '.join(map(str, better))} of {len(COUNTS)}")


def captured(
    rig: CameraRig, frames: int, kind: SimulatedKind, seed: int
) -> tuple[float, float, float, float]:
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
