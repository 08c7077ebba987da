"""Shading of a surface point by its texture and glTF 2.0's microfacet model.

Lambert's diffuse light under Schlick's Fresnel term, GGX with Smith's occlusion in Schlick's form (Khronos
glTF 2.0 specification, appendix B), as in pyrender's shader, so that both painters agree.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from render.painting.shadows import lit_share

GAMMA: Final = 2.2
_FACING: Final = 0.04  # specular reflectance of dielectrics at normal incidence
_LIFT: Final = 1.7  # offset of shadow look-ups from slanted surfaces, against self-shadowing [bias]
_UNDER: Final = 0.012  # depth that scattered light passes at a scatter of 1 [m]
_LEVELS: Final = 2048
_BYTES = np.arange(256) / 255.0
TO_LINEAR: Final = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4)
"""Linear light of sRGB bytes."""
TO_DISPLAY: Final = np.linspace(0.0, 1.0, _LEVELS) ** (2.0 / GAMMA)
"""Display values in [0, 1] by the square root of linear light, where the curve is nearly straight."""

SPOT: Final = 21
"""Length of the row of numbers that describes a surface point (a spot).

Pixel and one over the depth (3), position [m] (3) and unit normal (3) in the camera's axes, tint (3), texture
coordinates (2), linear color (3), roughness, the texture's normal (3)."""


@kernel
def display(light: float, table: NDArray[np.float64]) -> float:
    """The display value of linear light, clipped to [0, 1]; `table` is `TO_DISPLAY` (2048,)."""
    root = np.sqrt(min(max(light, 0.0), 1.0)) * (_LEVELS - 1)
    low = min(int(root), _LEVELS - 2)
    value: float = table[low] + (root - low) * (table[low + 1] - table[low])
    return value


@kernel
def read_texels(texels: NDArray[np.uint8], table: NDArray[np.float64], spot: NDArray[np.float64]) -> None:
    """Multiply a surface point's color and roughness by the texture's, and write its normal; bilinear.

    Args:
        texels: Texture (h, w, 8); see `Material.texels`.
        table: `TO_LINEAR` (256,).
        spot: See `SPOT`.
    """
    rows, columns = texels.shape[:2]
    across = min(max(spot[12] * columns - 0.5, 0.0), columns - 1.001)
    down = min(max((1.0 - spot[13]) * rows - 0.5, 0.0), rows - 1.001)
    column, row = int(across), int(down)
    right, below = across - column, down - row
    red = green = blue = rough = x = y = z = 0.0
    for i in range(2):
        for j in range(2):
            share = (below if i else 1.0 - below) * (right if j else 1.0 - right)
            red += share * table[texels[row + i, column + j, 0]]
            green += share * table[texels[row + i, column + j, 1]]
            blue += share * table[texels[row + i, column + j, 2]]
            rough += share * texels[row + i, column + j, 3]
            x += share * texels[row + i, column + j, 4]
            y += share * texels[row + i, column + j, 5]
            z += share * texels[row + i, column + j, 6]
    spot[14] *= red
    spot[15] *= green
    spot[16] *= blue
    spot[17] *= rough / 255.0
    spot[18], spot[19], spot[20] = x / 127.5 - 1.0, y / 127.5 - 1.0, z / 127.5 - 1.0


@kernel
def shade(
    spot: NDArray[np.float64],
    finish: NDArray[np.float64],
    lamps: NDArray[np.float64],
    ambient: NDArray[np.float64],
    to_map: NDArray[np.float64],
    nearest: NDArray[np.float32],
    bias: float,
    light: NDArray[np.float64],
) -> None:
    """Write the linear light (red, green, blue) that a surface point sends to the camera in the origin.

    Args:
        spot: See `SPOT`.
        finish: Linear color (3), roughness, glow, scatter (3); see `Material`.
        lamps: Rows (L, 9): unit vector to the lamp, its light with shadows, and its light without.
        ambient: Ambient light by the normal (9, 3); see `surroundings.irradiance`.
        to_map: `ShadowMap.to_map` (3, 4) of the first lamp.
        nearest: `ShadowMap.nearest` (N, N) of the first lamp [m].
        bias: `ShadowMap.bias` of the first lamp [m].
        light: Three numbers, written.
    """
    px, py, pz, nx, ny, nz = spot[3], spot[4], spot[5], spot[6], spot[7], spot[8]
    away = -1.0 / np.sqrt(px * px + py * py + pz * pz)
    vx, vy, vz = px * away, py * away, pz * away
    facing = min(max(abs(nx * vx + ny * vy + nz * vz), 0.001), 1.0)
    rough = max(spot[17], 0.04)
    square, k = rough**4, (rough + 1.0) ** 2 / 8.0
    for i in range(3):
        around = ambient[0, i] + nx * ambient[1, i] + ny * ambient[2, i] + nz * ambient[3, i]
        around += nx * ny * ambient[4, i] + ny * nz * ambient[5, i] + nx * nz * ambient[6, i]
        around += (nx * nx - ny * ny) * ambient[7, i] + (3.0 * nz * nz - 1.0) * ambient[8, i]
        light[i] = spot[14 + i] * (max(around, 0.0) + finish[4])
    for lamp in range(len(lamps)):
        lx, ly, lz = lamps[lamp, 0], lamps[lamp, 1], lamps[lamp, 2]
        cosine = nx * lx + ny * ly + nz * lz
        if cosine <= -finish[5]:
            continue
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        length = np.sqrt(max(hx * hx + hy * hy + hz * hz, 1e-12))
        half = max((nx * hx + ny * hy + nz * hz) / length, 0.0)
        grazing = 1.0 - 0.5 * length  # the half vector's length is twice its cosine with either
        fresnel = _FACING + (1.0 - _FACING) * grazing**5
        peak = half * half * (square - 1.0) + 1.0
        occlusion = 4.0 * (facing * (1.0 - k) + k) * (max(cosine, 0.0) * (1.0 - k) + k)
        mirrored = 0.0
        if cosine > 0.0:
            mirrored = cosine * fresnel * square / (np.pi * peak * peak * occlusion)
        lit = 1.0
        if lamp == 0:
            lift = _LIFT * bias * np.sqrt(1.0 - min(cosine, 1.0) ** 2)
            # Light under the surface passes what is this thick before it.
            under = finish[5] * _UNDER * (1.0 - cosine)
            x, y, z = px + lift * nx + under * lx, py + lift * ny + under * ly, pz + lift * nz + under * lz
            lit = lit_share(to_map, nearest, bias, x, y, z)
        for i in range(3):
            # The cosine, wrapped around the edge of the light.
            wrapped = max((cosine + finish[5 + i]) / (1.0 + finish[5 + i]), 0.0)
            scattered = wrapped * (1.0 - fresnel) * (1.0 - _FACING) / np.pi
            arriving = lit * lamps[lamp, 3 + i] + lamps[lamp, 6 + i]
            light[i] += (scattered * spot[14 + i] + mirrored) * arriving
