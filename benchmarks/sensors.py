"""Processor time of the sensors per frame, in milliseconds on one thread.

    python -m benchmarks.sensors [--width 640 --height 480 --repeats 50]

A sphere before a wall, seen through every model of render's sensors: depth noise, exposure, motion blur, and
pictures looked up through lenses. The least of the repeats, and their median: the machine may be shared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from benchmarks.record import describe, run, timed
from handsim import Camera, Lens
from handsim.space.camera import pinhole
from render.color_sensor import Exposure, combine, expose, linear_of, shutter_times
from render.depth_sensor import DEPTH_NOISES, SENSORS, apply_depth_noise, reflectance_of
from render.painting.rasterizer import faces_for, warp, warp_depth, warp_normals


def sphere_and_wall(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, normals and colors."""
    rays, center, radius = camera.rays(), np.array([0.0, 0.0, 0.6]), 0.12
    along = rays @ center
    root = along**2 - center @ center + radius**2
    points = rays * (along - np.sqrt(np.maximum(root, 0.0)))[..., None]
    hit = root > 0.0
    depth = np.where(hit, points[..., 2], 0.9).astype(np.float32)
    normals = np.where(hit[..., None], (points - center) / radius, [0.0, 0.0, -1.0]).astype(np.float32)
    rgb = np.where(hit[..., None], [190, 140, 115], 150).astype(np.uint8)
    return depth, normals, rgb


def clock(name: str, job: Callable[[], Any], repeats: int) -> None:
    """Print how long a job takes."""
    job()
    times = [1e3 * timed(job, time.process_time) for _ in range(repeats)]
    print(f"  {name:34s} {min(times):6.2f} ms   median {np.median(times):6.2f}")


def main(width: int = 640, height: int = 480, repeats: int = 50) -> None:
    size = (width, height)
    cv2.setNumThreads(1)
    print(describe("opencv-python-headless"))
    rng = np.random.default_rng(0)
    camera = pinhole("pinhole", size, 0.9 * size[0])
    depth, normals, rgb = sphere_and_wall(camera)

    print(f"\ndepth noise, {size[0]} x {size[1]}, with normals and colors")
    for name in SENSORS:
        noise = DEPTH_NOISES[name]
        clock(
            name,
            lambda noise=noise: apply_depth_noise(
                depth, normals, noise, camera=camera, reflectance=reflectance_of(rgb), rng=rng
            ),
            repeats,
        )

    print("\ncolor")
    light = linear_of(rgb)
    taken = Exposure(0.2, (1.05, 1.0, 0.97), 4000.0, 3.0, 0.2)
    clock("light of sRGB", lambda: linear_of(rgb), repeats)
    clock("exposure", lambda: expose(light, taken, rng=rng), repeats)
    through = Exposure(0.2, (1.05, 1.0, 0.97), 4000.0, 3.0, 0.2, jpeg_quality=90)
    clock("exposure and JPEG", lambda: expose(light, through, rng=rng), repeats)
    for name, readout in (("global", 0.0), ("rolling", 0.015)):
        _, weights = shutter_times(0.008, readout, 8, size[1])
        clock(
            f"blur of 8 moments, {name} shutter", lambda weights=weights: combine([rgb] * 8, weights), repeats
        )

    K = np.array([[0.6 * size[0], 0, size[0] / 2], [0, 0.6 * size[0], size[1] / 2], [0, 0, 1]])
    wide = np.array([[0.375 * size[0], 0, size[0] / 2], [0, 0.375 * size[0], size[1] / 2], [0, 0, 1]])
    for lensed in (
        Camera("brown", size, K, lens=Lens("brown", (-0.30, 0.11, -0.001, 0.0015, -0.02))),
        Camera("fisheye", size, wide, lens=Lens("fisheye", (0.02, -0.006, 0.0, 0.0))),
    ):
        start = time.process_time()
        faces = faces_for(lensed)
        planned = time.process_time() - start
        pixels = sum(face.size[0] * face.size[1] for face in faces) / (size[0] * size[1])
        print(
            f"\nthrough a {lensed.name} lens: {len(faces)} face(s), {pixels:.1f} times the picture's pixels, "
            f"planned once in {1e3 * planned:.0f} ms"
        )
        drawn = [sphere_and_wall(face.at(np.eye(4))) for face in faces]
        depths, directions, colors = (list(kind) for kind in zip(*drawn, strict=True))
        ids = [np.ascontiguousarray(color[..., 0]) for color in colors]
        clock("colors", lambda c=lensed, p=colors: warp(c, p, cv2.INTER_LINEAR), repeats)
        clock("ids", lambda c=lensed, p=ids: warp(c, p), repeats)
        clock("depth", lambda c=lensed, p=depths: warp_depth(c, p), repeats)
        clock("normals", lambda c=lensed, p=directions: warp_normals(c, p), repeats)


if __name__ == "__main__":
    run(main, __doc__)
