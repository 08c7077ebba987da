"""Blobs in the pictures of single cameras, compiled: noise, blobs that merge, and the rays through them.

Blobs are kept in undistorted pixels from the principal point, of each camera's focal lengths; their noise is
one of real pixels, taken through the lens.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from handsim.kernels.kernel import kernel
from handsim.space.camera import PINHOLE, distort_jacobian

MARKER_RADIUS: Final = 0.0032
"""Radius of the spheres of Han et al. 2018 (section 3) [m]: of markers on objects, and of strays."""


_BLIND: Final = 1e-6  # determinant of a lens's Jacobian below which it makes no blob


@kernel
def draw_blobs(
    sources: Any, sizes: Any, seen: Any, cameras: Any, optics: Any, rng: Any, centers: Any, radii: Any
) -> None:
    """Write noisy blob centers (C, S, 2) and radii (C, S) [px] of one frame; radius 0 where there is no blob.

    The error of a disc's centroid comes from the pixels of its border, whose number grows with the radius,
    and is divided by the disc's area, which grows with its square: it falls with the radius's root.

    Args:
        sources: Positions of everything that shines (S, 3) [m]; NaN where there is none.
        sizes: Radius of each (S,) [m].
        seen: Which cameras have a free view of each (S, C).
        cameras: `CameraArrays` of C cameras.
        optics: Noise of a source of `MARKER_RADIUS` [px], chance to lose a blob, roundness.
        rng: The draws go by camera, then source.
    """
    loss = optics[1]
    for c in range(len(cameras.lenses)):
        pose, lens = cameras.T_world_camera[c], cameras.lenses[c]
        fx, fy = cameras.intrinsics[c, 0], cameras.intrinsics[c, 1]
        focal = np.sqrt(fx * fy)
        for s in range(len(sources)):
            radii[c, s] = 0.0
            if not seen[s, c] or np.isnan(sources[s, 0]) or (loss > 0.0 and rng.random() < loss):
                continue
            x, y, z = sources[s, 0] - pose[0, 3], sources[s, 1] - pose[1, 3], sources[s, 2] - pose[2, 3]
            depth = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
            if depth <= 1e-6:
                continue
            right = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
            down = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
            noise = optics[0] * np.sqrt(MARKER_RADIUS / sizes[s])
            du, dv = noise * rng.standard_normal(), noise * rng.standard_normal()
            if lens[0] != PINHOLE:
                xx, xy, yx, yy = distort_jacobian(lens, right, down, depth)
                determinant = xx * yy - xy * yx
                if not determinant > _BLIND:  # also where the lens does not see: NaN
                    continue
                across, along = du / fx, dv / fy
                du, dv = (
                    fx * (yy * across - xy * along) / determinant,
                    fy * (xx * along - yx * across) / determinant,
                )
            radii[c, s] = focal * sizes[s] / depth
            centers[c, s, 0] = fx * right / depth + du
            centers[c, s, 1] = fy * down / depth + dv


@kernel
def cast_rays(
    seen: Any, cameras: Any, optics: Any, centers: Any, radii: Any, directions: Any, usable: Any
) -> None:
    """Write the unit rays (S, C, 3) of every source's blob in every camera; blobs that touch have merged.

    `usable` (S, C) gets whether a camera has a ray to a source. The other arguments are those of
    `draw_blobs`.
    """
    roundness = optics[2]
    count = seen.shape[0]
    for c in range(len(cameras.lenses)):
        pose, inner = cameras.T_world_camera[c], cameras.intrinsics[c]
        for s in range(count):
            usable[s, c] = radii[c, s] > 0.0
            if not usable[s, c]:
                continue
            u, v, members = centers[c, s, 0], centers[c, s, 1], 1
            for o in range(count):
                if o == s or radii[c, o] == 0.0:
                    continue
                du, dv = centers[c, o, 0] - centers[c, s, 0], centers[c, o, 1] - centers[c, s, 1]
                reach = radii[c, o] + radii[c, s]
                squared = du * du + dv * dv
                if squared >= reach * reach:
                    continue
                if squared > (roundness * reach) ** 2:
                    usable[s, c] = False
                    break
                u, v, members = u + centers[c, o, 0], v + centers[c, o, 1], members + 1
            u, v = u / (members * inner[0]), v / (members * inner[1])
            length = np.sqrt(u * u + v * v + 1.0)
            for i in range(3):
                directions[s, c, i] = (pose[i, 0] * u + pose[i, 1] * v + pose[i, 2]) / length
