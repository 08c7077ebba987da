"""Accuracy of drawn depth and ids against embree; and the pictures that `benchmarks.speed` times.

    python -m benchmarks.rendering [--frames 200]

What is timed are 640 x 480 pictures of two hands from a simulated take: depth alone; colors, depth, ids and
keypoints; the same painted by OpenGL, and written as WebDataset.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from torch.utils.data import DataLoader

from benchmarks.record import Figures, describe, report, run, timed
from gloves import Take
from handsim.app.workers import run_jobs
from render import PictureStream, RenderConfig, RenderedFrame, ViewConfig
from render.config import resolve
from render.drawing import Drawing
from render.formats.writer import open_writer
from render.painting.rasterizer import join, rasterize
from render.studio import Moment, Studio
from render.subject import subject_of_take
from render.viewpoints import Viewpoints
from train import simulate_take

CROP, BATCH = 256, 16  # of the stream's pictures [px], and in a batch
ROUNDS: Final = 3
PLAIN: Final = RenderConfig(depth_sensor=None, color_sensor=None, painter="compiled")
DEPTH: Final = dataclasses.replace(PLAIN, passes=("depth",))
COLORS: Final = dataclasses.replace(PLAIN, passes=("rgb", "depth", "ids"))
KINDS: Final = {
    "depth": ("depth", DEPTH),
    "colors": ("colors, depth, ids, keypoints", COLORS),
    "opengl": ("the same painted by OpenGL", dataclasses.replace(COLORS, painter="opengl")),
}


@functools.lru_cache(maxsize=1)
def a_take(frames: int) -> Take:
    return simulate_take(kind="hand-hand", num_frames=frames)


def pictures(config: RenderConfig, frames: int, shard: int) -> Iterator[RenderedFrame]:
    """One worker's share."""
    drawing = Drawing(subject_of_take(a_take(frames)), resolve(config))
    return drawing.frames(shard, enumerate(range(frames)))


def draw(config: RenderConfig, frames: int, shard: int) -> int:
    for _ in pictures(config, frames, shard):
        pass
    return shard


def draw_and_write(config: RenderConfig, folder: Path, frames: int, shard: int) -> int:
    open_writer("webdataset", folder).write(shard, pictures(config, frames, shard))
    return shard


def rate(job: Callable[[], object], count: int) -> float:
    """Pictures per second, the median of some rounds after a warm-up."""
    job()
    return count / float(np.median([timed(job) for _ in range(ROUNDS)]))


def rate_in_processes(job: Callable[[int], int], cores: int, frames: int) -> float:
    """Pictures per second while all processes are at work: from the second shard of each on."""
    ends = []
    for _ in run_jobs(job, range(1 + 6 * cores), cores):
        ends.append(time.perf_counter())
    steady = ends[1 + cores : -cores]  # the first is drawn before there are processes
    return (len(steady) - 1) * frames / (steady[-1] - steady[0])


def jobs(frames: int, folder: Path) -> dict[str, tuple[str, Callable[[int], int]]]:
    """What is drawn, with its name in words; a job draws one shard, in `folder` if it writes it."""
    drawn: dict[str, tuple[str, Callable[[int], int]]] = {
        key: (name, functools.partial(draw, config, frames)) for key, (name, config) in KINDS.items()
    }
    writing = functools.partial(draw_and_write, COLORS, folder, frames)
    return drawn | {"written": ("the same written as WebDataset", writing)}


def a_stream() -> PictureStream:
    """Pictures of one hand for training loops: colors, depth, ids, keypoints, sensors."""
    config = RenderConfig(passes=("rgb", "depth", "ids"))
    return PictureStream(config=config, crop=CROP, batch=BATCH, seed=0)


def stream_batches() -> Iterator[object]:
    """Batches of the stream from a worker a core, once all have drawn some."""
    cores = os.cpu_count() or 1
    batches = iter(DataLoader(a_stream(), batch_size=BATCH, num_workers=cores))
    for _ in range(4 * cores):
        next(batches)
    return batches


def accuracy(frames: int) -> Figures:
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    take = a_take(frames)
    view = Viewpoints(ViewConfig("orbit"), take, rng=np.random.default_rng(1))
    studio = bare_studio(take)
    off, agree = [], []
    for frame in np.linspace(0, take.num_frames - 1, 8).astype(int):
        camera = view.cameras(frame)[0]
        surface = join([one.triangles for one in studio.surfaces(Moment(take, int(frame)))])
        mine = rasterize(camera, surface)
        vertices = np.asarray(surface.vertices, dtype=np.float64)
        caster = RayMeshIntersector(trimesh.Trimesh(vertices, surface.faces, process=False))
        directions = camera.rays().reshape(-1, 3) @ camera.T_world_camera[:3, :3].T
        origins = np.broadcast_to(camera.T_world_camera[:3, 3], directions.shape)
        positions, rays, faces = caster.intersects_location(origins, directions, multiple_hits=False)
        depth, part = np.zeros(len(directions)), np.zeros(len(directions), dtype=np.uint8)
        depth[rays], part[rays] = camera.local(positions)[:, 2], surface.parts[faces]
        depth, part = depth.reshape(480, 640), part.reshape(480, 640)
        both = (depth > 0) & (mine.depth > 0)
        off.append(1e3 * np.abs(depth - mine.depth)[both])
        agree.append(np.mean(part == mine.parts))
    errors = np.concatenate(off)
    return {
        "median": ("drawn depth against embree, median [mm]", np.median(errors)),
        "most": ("drawn depth against embree, 99.9 % within [mm]", np.quantile(errors, 0.999)),
        "agree": ("pixels on which ids and silhouettes agree, at least [%]", 100 * min(agree)),
    }


def bare_studio(take: Take) -> Studio:
    return Studio(take.hands, PLAIN, rng=np.random.default_rng(0))


def main(frames: int = 200, save: str | None = None) -> None:
    print(describe())
    report(save, accuracy(frames))


if __name__ == "__main__":
    run(main, __doc__)
