"""How fast training sets are made, every ray from every marker to every camera cast.

    python -m benchmarks.generation [--frames 170330]

The floor of a frame is what cannot be left out: its rays, 19 markers x 16 cameras, each against 21 capsules,
and its row on the disk. Then come the stages of `train.simulation.generation` for a hand alone, a new
person every 128 frames, in microseconds of processor time per frame, and `handsim generate` whole: single
hands with one worker and with two, then the default mix of hands alone, together and holding something.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.record import Figures, add_save, describe, save_figures
from gloves.attachment import wear
from gloves.layout import load_layout
from gloves.optics.ghosts import sample_ghosts
from gloves.optics.reconstruction import reconstruct
from gloves.optics.visibility import free_rays, pack_cameras, visible_cameras
from handsim.hand.model import join_qpos
from handsim.space.cameras import named_rig
from handsim.space.transforms import random_quaternions
from poses.shapes.validity import sample_valid_angles
from train.data.shards import row_dtype
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import SceneMix
from train.simulation.generation import make_dataset
from train.simulation.people import sample_hands

CONFIG = DatasetConfig()
HANDS = 48
FRAMES = CONFIG.frames_per_hand


class Stopwatch:
    """Processor time [s] of every stage, a list of runs each."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what runs inside."""
        start = time.process_time()
        yield
        self.times.setdefault(name, []).append(time.process_time() - start)

    def per_frame(self) -> dict[str, float]:
        """Median of every stage [us] a frame."""
        return {name: 1e6 * float(np.median(times)) / FRAMES for name, times in self.times.items()}


def one_hand(watch: Stopwatch, rng: np.random.Generator) -> None:
    """What `train.simulation.generation` does for one person, stage by stage."""
    layout, rig = load_layout(CONFIG.glove), named_rig(CONFIG.rig)
    with watch.stage("person: shape, skeleton, room at rest"):
        model = sample_hands(CONFIG.population, rng=rng)[0]
    with watch.stage("skin: cage fitted to the shape"):
        _ = model.surface
    with watch.stage("glove: 19 slipped markers on the skin"):
        slip = np.deg2rad(CONFIG.slip_around)
        attachment = wear(layout, model, along=CONFIG.slip_along, around=slip, rng=rng)
    with watch.stage("poses: drawn and made valid"):
        angles = sample_valid_angles(model, FRAMES, CONFIG.poses, rng=rng)
    turns = random_quaternions(FRAMES, rng=rng)
    qpos = join_qpos(angles, position=[0.0, 0.0, 1.1], quaternion=turns)
    with watch.stage("kinematics: bones, markers, capsules"):
        bones = model.forward_kinematics(qpos)
        markers, normals = attachment.markers(model, bones)
        segments, radii = model.capsules.posed(bones), model.capsules.radii
    with watch.stage("sight: rays, facing, field of view"):
        seen = visible_cameras(markers, normals, rig, segments, radii)
        pack_cameras(seen)
    with watch.stage("  of these the rays alone"):
        free_rays(markers, rig.positions, segments, radii)
    with watch.stage("ghosts: mirror images and strays"):
        sample_ghosts(markers, rig, segments, radii, CONFIG.ghosts, min_cameras=2, rng=rng)
    with watch.stage("optics: blobs, triangulation, false points"):
        reconstruct(markers, seen, rig, CONFIG.optics, continuous=False, rng=rng)


def stages() -> dict[str, float]:
    rng = np.random.default_rng(0)
    one_hand(Stopwatch(), rng)  # compiles
    watch = Stopwatch()
    for _ in range(HANDS):
        one_hand(watch, rng)
    return watch.per_frame()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=CONFIG.num_frames)
    add_save(parser)
    arguments = parser.parse_args()
    frames = arguments.frames
    print(describe("mujoco", "numba"))
    parts = stages()
    rays = load_layout(CONFIG.glove).num_markers * len(named_rig(CONFIG.rig).positions)
    size = row_dtype(load_layout(CONFIG.glove).num_markers).itemsize
    kernel = parts["  of these the rays alone"]
    print(
        f"floor of a frame: {rays} rays x 21 capsules = {rays * 21:,} ray tests, {kernel:.1f} us "
        f"({rays / kernel:.1f} million rays/s); a row of {size} bytes"
    )
    for name, microseconds in parts.items():
        print(f"  {name:40s} {microseconds:6.1f} us/frame")
    print(f"  {'sum':40s} {sum(parts.values()) - kernel:6.1f} us/frame")
    figures: Figures = {"rays": ("rays alone, one core [million/s]", rays / kernel)}
    single = SceneMix(alone=1.0, together=0.0, holding=0.0)
    for key, name, scenes, workers in (
        ("single_alone", "single hands", single, 1),
        ("single", "single hands", single, 2),
        ("mix", "the mix", SceneMix(), 2),
    ):
        with tempfile.TemporaryDirectory() as folder:
            config = DatasetConfig(num_frames=frames, scenes=scenes)
            start, busy = time.perf_counter(), sum(os.times()[:4])
            make_dataset(config, Path(folder) / "set", workers=workers)
            seconds, busy = time.perf_counter() - start, sum(os.times()[:4]) - busy  # workers' time too
        print(
            f"{name}, {workers} worker(s): {frames:,} frames in {seconds:.1f} s, {frames / seconds:,.0f} "
            f"frames/s; {frames / busy:,.0f} frames a second of processor time"
        )
        figures[key] = (f"training frames of {name}, {workers} worker(s) [frames/s]", frames / seconds)
    save_figures(arguments.save, figures)


if __name__ == "__main__":
    main()
