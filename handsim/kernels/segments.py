"""Distances of two points and of two straight segments, compiled; the test of contact and of visibility."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from handsim.kernels.kernel import kernel


@kernel(inline=True)
def squared_distance(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Squared distance of two points [m^2]."""
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2  # type: ignore[no-any-return]


@kernel(inline=True)
def point_distance(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Distance of two points [m]."""
    return np.sqrt(squared_distance(one, other))  # type: ignore[no-any-return]


@kernel(inline=True)
def segment_distance_squared(
    p: Float[np.ndarray, "3"], q: Float[np.ndarray, "3"], a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]
) -> float:
    """Squared distance [m^2] between the segments p-q and a-b, each point (3,) [m].

    Ericson, Real-Time Collision Detection (2005), section 5.1.9; degenerate segments are points.
    """
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    uw = ux * wx + uy * wy + uz * wz
    vw = vx * wx + vy * wy + vz * wz
    tiny = 1e-18
    s = 0.0
    if uu > tiny:
        determinant = uu * vv - uv * uv
        if determinant > 1e-12 * uu * vv:
            s = min(1.0, max(0.0, (uv * vw - vv * uw) / determinant))
    t = (uv * s + vw) / vv if vv > tiny else 0.0
    if t < 0.0 or t > 1.0 or vv <= tiny:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (uv * t - uw) / uu)) if uu > tiny else 0.0
    dx, dy, dz = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return float(dx * dx + dy * dy + dz * dz)
