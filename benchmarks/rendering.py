"""Accuracy of drawn depth and ids against embree: `python -m benchmarks.rendering`."""

from __future__ import annotations

import numpy as np
import trimesh

from benchmarks.record import Figures, describe, report, run
from render import RenderConfig, ViewConfig
from render.painting.rasterizer import join, rasterize
from render.studio import Moment, Studio
from render.viewpoints import Viewpoints
from train import simulate_take


def accuracy() -> Figures:
    """Depth and ids of 640 x 480 pictures of two hands."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    take = simulate_take(kind="hand-hand", num_frames=200)
    view = Viewpoints(ViewConfig("orbit"), take, rng=np.random.default_rng(1))
    plain = RenderConfig(depth_sensor=None, color_sensor=None, painter="compiled")
    studio = Studio(take.hands, plain, rng=np.random.default_rng(0))
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


def main(save: str | None = None) -> None:
    print(describe())
    report(save, accuracy())


if __name__ == "__main__":
    run(main, __doc__)
