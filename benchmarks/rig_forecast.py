"""How well `handsim rig score` forecasts what simulated captures miss: rank correlation over rigs.

Eight rigs, shipped, planned and bad ones, of 3 to 16 cameras. The captures have other people and motions than
the forecast, with the forecast's well-kept optical system and with the losses fitted to each kind of capture.

python -m benchmarks.rig_forecast [--frames 1500] [--folder RIGS]

The rigs are written into the folder, for `python -m benchmarks.paper cameras --rig FILE`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks.record import describe
from gloves.captures.gaps import run_lengths
from gloves.layout import load_layout
from handsim.space.camera import look_at
from handsim.space.cameras import ROOM_CENTER, CameraRig, list_rigs, named_rig
from train.rig_advice.forecast import ROOM, forecast, light
from train.rig_advice.plan import plan
from train.rig_advice.work import sample_work
from train.simulation.room_settings import OpticsOptions, SimulatedKind
from train.simulation.takes import TakeConfig, record_config

GLOVE = "dense19"
CAPTURES: tuple[tuple[SimulatedKind, int], ...] = (
    ("real-like", 101),
    ("free", 102),
    ("hand-hand", 103),
    ("hand-controller", 104),
    ("calibration", 105),
)
CENTER, SIDES = np.array(ROOM_CENTER), np.full(3, 0.6)
FRAME = np.array([2.4, 1.8, 2.2])
CAMERA = named_rig("six").cameras[0]
WELL_KEPT = OpticsOptions(
    **{
        name: getattr(ROOM.optics, name)
        for name in ("blob_loss", "dropout", "dropout_length", "dropout_cameras", "min_rays_to_start")
    }
)
FIGURES = ("missing [%]", "gaps [1/marker/min]", "median length [frames]")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1500, help="of each capture")
    parser.add_argument("--folder", type=Path, help="where the rigs are written; a temporary one by default")
    options = parser.parse_args()
    print(describe("numpy", "numba"))
    if options.folder is not None:
        options.folder.mkdir(parents=True, exist_ok=True)
        compare(options.folder, options.frames)
        return
    with tempfile.TemporaryDirectory() as folder:
        compare(Path(folder), options.frames)


def compare(folder: Path, frames: int) -> None:
    """Print the forecast and the captures of every rig, and how alike their ranks are."""
    work = sample_work(load_layout(GLOVE), CENTER, SIDES, 900, 2, rng=np.random.default_rng(0))
    scenes = [one for part in work.values() for one in part]
    table = []
    for rig in rigs():
        path = folder / f"{rig.name}.toml"
        rig.save(path)
        told = forecast(light(scenes, rig, rng=np.random.default_rng(0)), rig)
        expected = (100 * told.missing, told.gaps, 120 * told.gap_median)
        kept = captured(path, frames, WELL_KEPT)
        fitted = captured(path, frames, OpticsOptions())
        table.append((expected, kept, fitted))
        print(f"{rig.name} ({len(rig.positions)} cameras): {', '.join(FIGURES)}", flush=True)
        for title, figures in (("forecast", expected), ("well-kept", kept), ("as fitted", fitted)):
            print(f"  {title:10s} " + "  ".join(f"{one:7.1f}" for one in figures), flush=True)
    for column, title in ((1, "well-kept"), (2, "as fitted")):
        for number, figure in enumerate(FIGURES):
            rank = spearmanr([row[0][number] for row in table], [row[column][number] for row in table])
            print(f"rank correlation, captures {title}, {figure}: {rank.statistic:.3f}")


def rigs() -> list[CameraRig]:
    """Shipped, planned and bad rigs."""
    layout = load_layout(GLOVE)
    planned = [
        plan(count, FRAME, ("truss",), layout, CENTER, SIDES, CAMERA, name=f"planned{count}").rig
        for count in (4, 8, 12)
    ]
    row = [CAMERA.at(look_at(np.array([x, -1.5, 1.8]), CENTER)) for x in (-0.75, -0.25, 0.25, 0.75)]
    return [
        *(named_rig(name) for name in list_rigs()),
        *planned,
        CameraRig("three", named_rig("six").cameras[:3]),
        CameraRig("row", row),
    ]


def captured(rig: Path, frames: int, optics: OpticsOptions) -> tuple[float, float, float]:
    """What simulated captures miss: share of marker-frames [%], gaps per marker-minute, median length."""
    missing, lengths, total = 0, [], 0
    for kind, seed in CAPTURES:
        take = record_config(TakeConfig(kind, frames, GLOVE, str(rig), seed, optics))
        present = take.markers_present()[:, : take.hand_labels[-1].stop]
        missing += int((~present).sum())
        total += present.size
        lengths.append(run_lengths(~present))
    gaps = np.concatenate(lengths)
    median = float(np.median(gaps)) if len(gaps) else 0.0
    return 100 * missing / total, len(gaps) / (total / 120.0 / 60.0), median


if __name__ == "__main__":
    main()
