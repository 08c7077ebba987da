"""Shading of surface points by texture, lamps and shadows, with glTF 2.0's microfacet model.

Diffuse light is Lambert's under Schlick's Fresnel term. Specular light is GGX with Smith's occlusion in
Schlick's form (Khronos glTF 2.0 specification, appendix B). pyrender's shader computes the same, so that both
painters agree.

Points are columns of a table with a row for each number, so that loops over points are compiled into vector
instructions: a loop writes one row and reads few, or the compiler cannot tell that rows do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy.typing import NDArray

from handsim.kernels import kernel
from handsim.space.camera import Camera
from handsim.space.transforms import cross
from render.color_sensor import GAMMA, light_of
from render.frames import Doubles, Flags, Floats
from render.painting.figures import Drawn
from render.painting.rasterizer import NEAR, cut_off, nearest_faces, project
from render.scenery.backgrounds import Backdrop
from render.scenery.lights import Lighting

_TEXELS: Final = 256  # side of a shadow map; edges are a few millimeters soft on half a meter, as in rooms
_LOOKED_UP: Final = 4  # texels each way that one look-up reads
_FREE: Final = 3.0  # free border of a shadow map, for reads of neighbors [texels]
_COARSE: Final = 4  # size of a pixel of the shadow's mask, whose edges are soft, in pixels of the picture
_MARGIN: Final = 0.15  # border around a picture where a hand still counts as in it, as a share of its size
_FLATTEST: Final = 0.15  # cosine between a lamp and a backdrop's normal below which there is no shadow
_SHADED: Final = 0.9  # share of a lamp's light that a shadow takes; the rest is reflected into it
MIRRORED: Final = np.float32(0.028)
"""Specular reflectance at normal incidence, of skin (index 1.4)."""
_LIFT: Final = 1.7  # distance from a slanted surface at which shadows are looked up [biases]
_UNDER: Final = 0.012  # thickness of skin that light passes at a scatter of 1 [m]
_PI: Final = np.float32(np.pi)
_ZERO: Final = np.float32(0.0)
_ONE: Final = np.float32(1.0)
_HALF: Final = np.float32(0.5)
_TINY: Final = np.float32(1e-12)
_LEAST: Final = np.float32(1e-30)
ROUGHEST: Final = np.float32(0.04)
"""Roughness of the smoothest mirror."""
_EDGE: Final = np.float32(0.001)  # least cosine between a view and a normal
_LEVELS: Final = 2048  # entries of the table of display values
_PARTS: Final = np.float32(8.0)  # entries of the table of linear light per sRGB level
TO_LINEAR: Final = light_of(np.arange(255 * int(_PARTS) + 1) / float(_PARTS)).astype(np.float32)
"""Linear light of sRGB values from 0 to 255 in eighths."""
TO_DISPLAY: Final = (np.minimum(np.arange(_LEVELS + 1) / (_LEVELS - 1), 1.0) ** (2.0 / GAMMA)).astype(
    np.float32
)
"""Display values in [0, 1] by the square root of linear light, where the curve is nearly straight."""
SPOT: Final = 23
"""Number of rows of a table of surface points, which has a column for each point.

Position [m] (3) and normal (3) in the camera's axes; tint (3); linear color (3); roughness; the direction
in which u grows (3) and the texture's normal (3), both unused without a texture; and what `shade` computes:
the unit vector to the camera (3) and its cosine with the normal."""
POSITION, NORMAL, TINT, COLOR, ROUGH, TANGENT, BUMP, VIEW, FACING = 0, 3, 6, 9, 12, 13, 16, 19, 22


class ShadowMap(NamedTuple):
    """How near the first surface on each ray of a far lamp is to it."""

    to_map: Float[np.ndarray, "3 4"]
    """Maps positions [m] to columns and rows [texels] and nearness to the lamp [m]."""
    nearest: Float32[np.ndarray, "3 N N"]
    """Nearness [m], minus infinity where nothing is; then the largest and the least of the 4 x 4 texels that
    begin at each."""
    bias: float  # how much nearer a surface must be to cast a shadow [m]: about a texel


def shadow_map(
    points: Float32[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    towards: Float[np.ndarray, "3"],
    seen: Bool[np.ndarray, "V"],
) -> ShadowMap:
    """The shadow map of a surface for a lamp in this unit direction, with room for its seen vertices."""
    aside = cross(np.eye(3)[np.abs(towards).argmin()], towards)
    aside /= np.linalg.norm(aside)
    rotation = np.stack([aside, cross(aside, towards), towards])  # rows run down, as in pictures
    corners, to_map, scale = _onto_map(points, rotation, seen if seen.any() else ~seen)
    nearest = np.empty((3, _TEXELS, _TEXELS), np.float32)
    nearest[0], _ = nearest_faces([(corners, faces)], (_TEXELS, _TEXELS), farthest=-np.inf)
    around = np.ones((_LOOKED_UP, _LOOKED_UP), np.uint8)
    cv2.dilate(nearest[0], around, nearest[1], anchor=(0, 0))
    cv2.erode(nearest[0], around, nearest[2], anchor=(0, 0))
    return ShadowMap(to_map, nearest, 1.5 / scale)


@kernel
def _onto_map(points: Floats, rotation: Doubles, seen: Flags) -> Any:
    """Points (V, 3) in a map with room for those seen, `ShadowMap.to_map`, and the map's texels per meter."""
    corners = np.empty((len(points), 3))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for point in range(len(points)):
        for axis in range(3):
            value = rotation[axis, 0] * points[point, 0]
            value += rotation[axis, 1] * points[point, 1] + rotation[axis, 2] * points[point, 2]
            corners[point, axis] = value
            if seen[point]:
                low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
    scale = (_TEXELS - 2.0 * _FREE) / max(high[0] - low[0], high[1] - low[1], 1e-6)
    to_map = np.zeros((3, 4))
    to_map[:, :3] = rotation
    to_map[:2] *= scale
    for axis in range(2):
        to_map[axis, 3] = _FREE - scale * low[axis]
        for point in range(len(points)):
            corners[point, axis] = scale * corners[point, axis] + to_map[axis, 3]
    return corners, to_map, scale


@kernel
def lit_share(to_map: Doubles, nearest: Floats, bias: float, x: float, y: float, z: float) -> float:
    """Share of the lamp seen from (x, y, z) [m], a mean over 3 x 3 texels of a `ShadowMap`'s fields."""
    across = to_map[0, 0] * x + to_map[0, 1] * y + to_map[0, 2] * z + to_map[0, 3] - 0.5
    down = to_map[1, 0] * x + to_map[1, 1] * y + to_map[1, 2] * z + to_map[1, 3] - 0.5
    near = to_map[2, 0] * x + to_map[2, 1] * y + to_map[2, 2] * z + to_map[2, 3] + bias
    column, row = int(np.floor(across)) - 1, int(np.floor(down)) - 1
    size = nearest.shape[1]
    if column < 0 or row < 0 or column + _LOOKED_UP > size or row + _LOOKED_UP > size:
        return 1.0
    if nearest[1, row, column] <= near:  # most points are in the light or in the shadow as a whole
        return 1.0
    if nearest[2, row, column] > near:
        return 0.0
    right, below = across - np.floor(across), down - np.floor(down)
    lit = 0.0
    for i in range(_LOOKED_UP):
        high = 1.0 - below if i == 0 else below if i == 3 else 1.0
        for j in range(_LOOKED_UP):
            if nearest[0, row + i, column + j] <= near:
                lit += high * (1.0 - right if j == 0 else right if j == 3 else 1.0)
    return lit / 9.0


def level_behind(backdrop: Backdrop, camera: Camera, drawn: Sequence[Drawn]) -> float:
    """Level along its normal in the camera's axes [m] at which depth shows a backdrop: behind arms, too."""
    nearest, normal = np.inf, backdrop.normal
    if backdrop.level is None and drawn:
        some = 1 if backdrop.shadows else 8  # far walls need not be exact
        points = camera.local(np.concatenate([one.triangles.vertices[::some] for one in drawn]))
        nearest = _nearest_seen(points, normal, camera.K, np.array(camera.size, np.float64))[0]
    level = backdrop.behind(nearest if np.isfinite(nearest) else -1.0)
    return level if backdrop.arms is None else min(level, backdrop.arms)


def light_behind(
    camera: Camera, drawn: Sequence[Drawn], lighting: Lighting, backdrop: Backdrop
) -> Float32[np.ndarray, "H W"] | None:
    """Light on a backdrop with the first lamp's shadows over that without them; None without shadows."""
    drawn = [one for one in drawn if len(one.casting)]
    if not drawn or not lighting.lamps:
        return None
    normal = backdrop.normal
    lighting = lighting.turned(camera.T_world_camera[:3, :3].T)
    towards = np.array(lighting.lamps[0].direction) / np.linalg.norm(lighting.lamps[0].direction)
    if normal @ towards < _FLATTEST:
        return None
    surfaces = [one.triangles for one in drawn]
    points = camera.local(np.concatenate([surface.vertices for surface in surfaces]))
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = np.concatenate([one.casting + start for one, start in zip(drawn, starts, strict=False)])
    nearest, seen = _nearest_seen(points, normal, camera.K, np.array(camera.size, np.float64))
    fallen, distance = np.full_like(points, np.nan), np.zeros(2)
    _fall(points, seen, normal, towards, backdrop.behind(nearest), fallen, distance)
    if distance[1] == 0.0:
        return None
    width, height = (-(-side // _COARSE) for side in camera.size)
    cut = cut_off(fallen, faces)
    corners = project(cut.local, camera.K)
    corners[:, :2] /= _COARSE
    _, front = nearest_faces([(corners, cut.faces)], (width, height), farthest=0.0)
    mask = (front >= 0).astype(np.float32)
    if not mask.any():
        return None
    blur = backdrop.softness * distance[0] / distance[1] * camera.K[0, 0] / _COARSE
    mask = cv2.GaussianBlur(mask, (0, 0), max(0.8, float(blur)))
    falls = []  # light of each lamp on the backdrop
    for lamp in lighting.lamps:
        direction = np.array(lamp.direction)
        falls.append(lamp.strength * max(0.0, float(direction @ normal)) / float(np.linalg.norm(direction)))
    first_share = falls[0] / max(sum(falls) + float(np.mean(lighting.ambient)), 1e-6)
    light = 1.0 - np.float32(_SHADED * first_share) * mask
    whole = cv2.resize(light, (width * _COARSE, height * _COARSE), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[: camera.size[1], : camera.size[0]])


@kernel
def _nearest_seen(points: Doubles, normal: Doubles, K: Doubles, size: Doubles) -> Any:
    """Least position along a normal of the points (V, 3) in or near the picture, and which are there (V,)."""
    seen = np.zeros(len(points), dtype=np.bool_)
    nearest = np.inf
    for number in range(len(points)):
        x, y, z = points[number]
        if z > NEAR:
            across = (K[0, 0] * x / z + K[0, 2]) / size[0]
            down = (K[1, 1] * y / z + K[1, 2]) / size[1]
            if -_MARGIN < across < 1.0 + _MARGIN and -_MARGIN < down < 1.0 + _MARGIN:
                seen[number] = True
                nearest = min(nearest, x * normal[0] + y * normal[1] + z * normal[2])
    return nearest, seen


@kernel
def _fall(
    points: Doubles,
    seen: Flags,
    normal: Doubles,
    towards: Doubles,
    level: float,
    fallen: Doubles,
    distance: Doubles,
) -> None:
    """Write where the shadows of points (V, 3) fall on a backdrop, in the camera's axes [m].

    The backdrop's normal looks towards the camera, and it has this level along the normal. Points behind it
    have no shadow, and their rows are not written. `distance` (2,) gets the mean distance of the points that
    are seen from the backdrop and its mean depth behind them, or zeros if none is.
    """
    steep = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
    count = 0
    for number in range(len(points)):
        x, y, z = points[number]
        height = x * normal[0] + y * normal[1] + z * normal[2] - level
        if height >= 0.0:
            for axis in range(3):
                fallen[number, axis] = points[number, axis] - height / steep * towards[axis]
        if seen[number]:
            count += 1
            distance[0] += height
            distance[1] += fallen[number, 2]
    if count:
        distance /= count


@kernel
def display(light: Floats, tint: Floats, table: Floats) -> None:
    """Replace linear light (N,), times a tint (N,), by display values: `TO_DISPLAY` up to 1, or unbounded."""
    if len(table) == 0:
        for n in range(len(light)):
            value = tint[n] * light[n]
            light[n] = (value if value > _ZERO else _ZERO) ** np.float32(1.0 / GAMMA)
        return
    for n in range(len(light)):
        value = tint[n] * light[n]
        value = value if value > _ZERO else _ZERO
        light[n] = np.sqrt(value if value < _ONE else _ONE) * np.float32(_LEVELS - 1)
    for n in range(len(light)):
        low = np.int32(light[n])
        light[n] = table[low] + (light[n] - np.float32(low)) * (table[low + 1] - table[low])


@kernel
def _read_texels(spots: Floats, texels: NDArray[np.uint32], finish: Doubles, table: Floats) -> None:
    """Write color, roughness and relief of surface points, bilinear between texels; see `shade`."""
    rows, columns = texels.shape[:2]
    flat, count = texels.reshape(-1), spots.shape[1]
    right, below = np.empty(count, np.float32), np.empty(count, np.float32)
    at = np.empty(count, np.int64)
    wide, high, u, v = np.float32(columns), np.float32(rows), spots[BUMP], spots[BUMP + 1]
    last, lowest = np.float32(columns - 1.001), np.float32(rows - 1.001)
    for n in range(count):
        across, down = u[n] * wide - _HALF, (_ONE - v[n]) * high - _HALF
        across, down = across if across > _ZERO else _ZERO, down if down > _ZERO else _ZERO
        across, down = across if across < last else last, down if down < lowest else lowest
        column, row = np.int32(across), np.int32(down)
        right[n], below[n] = across - np.float32(column), down - np.float32(row)
        at[n] = 2 * (row * columns + column)
    near = np.empty((4, count), np.uint32)
    for half in range(2):
        for n in range(count):
            first = np.uint64(at[n] + half)
            second = np.uint64(at[n] + half + 2 * columns)
            near[0, n], near[1, n] = flat[first], flat[first + np.uint64(2)]
            near[2, n], near[3, n] = flat[second], flat[second + np.uint64(2)]
        for k in range(4 - half):
            _mix_bytes(near, np.uint32(8 * k), right, below, spots[(BUMP if half else COLOR) + k])
    for k in range(3):
        color, relief, factor = spots[COLOR + k], spots[BUMP + k], np.float32(finish[k])
        for n in range(count):
            color[n] = factor * table[np.uint32(_PARTS * color[n] + _HALF)]
        for n in range(count):
            relief[n] = relief[n] * np.float32(1.0 / 127.5) - _ONE
    rough, factor = spots[ROUGH], np.float32(finish[3] / 255.0)
    for n in range(count):
        value = factor * rough[n]
        rough[n] = value if value > ROUGHEST else ROUGHEST


@kernel
def _mix_bytes(
    near: NDArray[np.uint32], bits: np.uint32, right: Floats, below: Floats, mixed: Floats
) -> None:
    """Interpolate a byte of four texels (4, N): the left and right ones above, then those below."""
    a, b, c, d = near[0], near[1], near[2], near[3]
    low = np.uint32(255)
    for n in range(len(mixed)):
        first, second = np.float32(np.int32((a[n] >> bits) & low)), np.float32(np.int32((b[n] >> bits) & low))
        third, fourth = np.float32(np.int32((c[n] >> bits) & low)), np.float32(np.int32((d[n] >> bits) & low))
        first += right[n] * (second - first)
        third += right[n] * (fourth - third)
        mixed[n] = first + below[n] * (third - first)


@kernel
def shade(
    spots: Floats,
    texels: NDArray[np.uint32],
    finish: Doubles,
    table: Floats,
    lamps: Doubles,
    ambient: Doubles,
    to_map: Doubles,
    nearest: Floats,
    bias: float,
) -> Any:
    """Linear light (3, N) that surface points send to the camera in the origin.

    Args:
        spots: Table (23, N); see `SPOT`. Normals become unit normals of the relief.
        texels: Texture (h, w, 2), two words a texel; empty for a surface without one.
        finish: Linear color (3), roughness, glow, scatter (3); see `Material`.
        table: `TO_LINEAR`.
        lamps: Rows (L, 9): unit vector to the lamp, its light with shadows, and its light without.
        ambient: Ambient light by the normal (9, 3); see `lights.irradiance`.
        to_map: `ShadowMap.to_map` (3, 4) of the first lamp.
        nearest: `ShadowMap.nearest` (3, N, N) of the first lamp [m].
        bias: `ShadowMap.bias` of the first lamp [m].
    """
    count = spots.shape[1]
    normals, views = spots[NORMAL : NORMAL + 3], spots[VIEW : VIEW + 3]
    _normalize(normals)
    if len(texels):
        _read_texels(spots, texels, finish, table)
        _map_normals(normals, spots[TANGENT : TANGENT + 3], spots[BUMP : BUMP + 3])
    views[:] = -spots[POSITION : POSITION + 3]
    _normalize(views)
    _dot(normals, views, spots[FACING])
    light = np.empty((3, count), np.float32)
    for i in range(3):
        _add_ambient(spots, ambient[:, i].astype(np.float32), np.float32(finish[4]), i, light[i])
    cosine, fresnel = np.empty(count, np.float32), np.empty(count, np.float32)
    mirrored, lit = np.empty(count, np.float32), np.ones(count, np.float32)
    for lamp in range(len(lamps)):
        x, y, z = np.float32(lamps[lamp, 0]), np.float32(lamps[lamp, 1]), np.float32(lamps[lamp, 2])
        _reflect(spots, x, y, z, cosine, fresnel, mirrored)
        if lamp == 0:
            _cast_shadows(spots, lamps[0], finish[5], cosine, to_map, nearest, bias, lit)
        for i in range(3):
            color, scatter = spots[COLOR + i], np.float32(finish[5 + i])
            hard, soft = np.float32(lamps[lamp, 3 + i]), np.float32(lamps[lamp, 6 + i])
            _add_lamp(color, scatter, hard, soft, cosine, fresnel, mirrored, lit, light[i])
    return light


@kernel
def _dot(first: Floats, second: Floats, product: Floats) -> None:
    """Write the scalar products (N,) of vectors (3, N)."""
    x, y, z, u, v, w = first[0], first[1], first[2], second[0], second[1], second[2]
    for n in range(len(product)):
        product[n] = x[n] * u[n] + y[n] * v[n] + z[n] * w[n]


@kernel
def _add_scaled(target: Floats, vectors: Floats, factor: Floats) -> None:
    """Add vectors (3, N) times factors (N,) to others (3, N)."""
    for i in range(3):
        row, other = target[i], vectors[i]
        for n in range(len(factor)):
            row[n] += factor[n] * other[n]


@kernel
def _normalize(vectors: Floats) -> None:
    """Scale vectors (3, N) to unit length; zeros stay zeros."""
    length = np.empty_like(vectors[0])
    _dot(vectors, vectors, length)
    for n in range(len(length)):
        length[n] = _ONE / np.sqrt(length[n] if length[n] > _LEAST else _LEAST)
    for i in range(3):
        row = vectors[i]
        for n in range(len(length)):
            row[n] *= length[n]


@kernel
def _map_normals(normals: Floats, tangents: Floats, bumps: Floats) -> None:
    """Replace unit normals (3, N) by those of a relief.

    Tangents (3, N) point where u grows and become unit tangents. Bumps (3, N) are the relief's normals along
    the tangent, along normal x tangent, and along the normal.
    """
    along = np.empty_like(normals[0])
    _dot(normals, tangents, along)
    for n in range(len(along)):
        along[n] = -along[n]
    _add_scaled(tangents, normals, along)
    _normalize(tangents)
    across = np.empty_like(normals)
    for i in range(3):
        ny, nz = normals[(i + 1) % 3], normals[(i + 2) % 3]
        ty, tz, row = tangents[(i + 1) % 3], tangents[(i + 2) % 3], across[i]
        for n in range(len(along)):
            row[n] = ny[n] * tz[n] - nz[n] * ty[n]
    for i in range(3):
        row, out = normals[i], bumps[2]
        for n in range(len(along)):
            row[n] *= out[n]
    _add_scaled(normals, tangents, bumps[0])
    _add_scaled(normals, across, bumps[1])
    _normalize(normals)


@kernel
def _add_ambient(spots: Floats, around: Floats, glow: np.float32, i: int, light: Floats) -> None:
    """Write the light (N,) of one color that surface points send by ambient light (9,) and by a glow."""
    x, y, z, color = spots[NORMAL], spots[NORMAL + 1], spots[NORMAL + 2], spots[COLOR + i]
    a, b, c, d, e = around[0], around[1], around[2], around[3], around[4]
    f, g, h, k = around[5], around[6], around[7], around[8]
    three = np.float32(3.0)
    for n in range(len(light)):
        total = a + x[n] * b + y[n] * c + z[n] * d + x[n] * y[n] * e + y[n] * z[n] * f + x[n] * z[n] * g
        total += (x[n] * x[n] - y[n] * y[n]) * h + (three * z[n] * z[n] - _ONE) * k
        light[n] = color[n] * ((total if total > _ZERO else _ZERO) + glow)


@kernel
def _reflect(
    spots: Floats,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    cosine: Floats,
    fresnel: Floats,
    mirrored: Floats,
) -> None:
    """Write cosine, Schlick's term and mirrored share (N,) of surface points for a lamp at (x, y, z)."""
    nx, ny, nz = spots[NORMAL], spots[NORMAL + 1], spots[NORMAL + 2]
    vx, vy, vz = spots[VIEW], spots[VIEW + 1], spots[VIEW + 2]
    facing, roughness = spots[FACING], spots[ROUGH]
    two, four, eighth = np.float32(2.0), np.float32(4.0), np.float32(0.125)
    for n in range(len(cosine)):
        cosine[n] = nx[n] * x + ny[n] * y + nz[n] * z
    for n in range(len(cosine)):
        square = two + two * (vx[n] * x + vy[n] * y + vz[n] * z)  # of the half vector's length
        grazing = _ONE - _HALF * np.sqrt(square if square > _TINY else _TINY)  # the length is twice a cosine
        fresnel[n] = MIRRORED + (_ONE - MIRRORED) * grazing * grazing * grazing * grazing * grazing
    for n in range(len(cosine)):
        hx, hy, hz = x + vx[n], y + vy[n], z + vz[n]
        length = hx * hx + hy * hy + hz * hz
        length = np.sqrt(length if length > _TINY else _TINY)
        half = (nx[n] * hx + ny[n] * hy + nz[n] * hz) / length
        half = half if half > _ZERO else _ZERO
        grazing = _ONE - _HALF * length
        schlick = MIRRORED + (_ONE - MIRRORED) * grazing * grazing * grazing * grazing * grazing
        towards = nx[n] * x + ny[n] * y + nz[n] * z
        towards = towards if towards > _ZERO else _ZERO
        rough = roughness[n]
        square = rough * rough * rough * rough
        k = (rough + _ONE) * (rough + _ONE) * eighth
        peak = half * half * (square - _ONE) + _ONE
        seen = facing[n] if facing[n] > _ZERO else -facing[n]
        seen = seen if seen > _EDGE else _EDGE
        occlusion = four * (seen * (_ONE - k) + k) * (towards * (_ONE - k) + k)
        mirrored[n] = towards * schlick * square / (_PI * peak * peak * occlusion)


@kernel
def _cast_shadows(
    spots: Floats,
    lamp: Doubles,
    scatter: float,
    cosine: Floats,
    to_map: Doubles,
    nearest: Floats,
    bias: float,
    lit: Floats,
) -> None:
    """Write the share (N,) of the first lamp that surface points see; `scatter` is that of red light."""
    for n in range(len(lit)):
        if cosine[n] <= -scatter:
            continue
        lift = _LIFT * bias * np.sqrt(max(1.0 - cosine[n] * cosine[n], 0.0))
        # Under the surface, light passes through flesh of this thickness.
        under = scatter * _UNDER * (1.0 - cosine[n])
        x = spots[POSITION, n] + lift * spots[NORMAL, n] + under * lamp[0]
        y = spots[POSITION + 1, n] + lift * spots[NORMAL + 1, n] + under * lamp[1]
        z = spots[POSITION + 2, n] + lift * spots[NORMAL + 2, n] + under * lamp[2]
        lit[n] = lit_share(to_map, nearest, bias, x, y, z)


@kernel
def _add_lamp(
    color: Floats,
    scatter: np.float32,
    hard: np.float32,
    soft: np.float32,
    cosine: Floats,
    fresnel: Floats,
    mirrored: Floats,
    lit: Floats,
    light: Floats,
) -> None:
    """Add one color of a lamp's light to `light` (N,).

    The `hard` light reaches the share `lit` of each point, the `soft` light all of it. `scatter` is the
    cosine beyond grazing at which the lamp still lights a point.
    """
    diffuse = (_ONE - MIRRORED) / (_PI * (_ONE + scatter))
    for n in range(len(light)):
        wrapped = cosine[n] + scatter  # light reaches around the edge of the lit side
        wrapped = (wrapped if wrapped > _ZERO else _ZERO) * (_ONE - fresnel[n]) * diffuse
        light[n] += (wrapped * color[n] + mirrored[n]) * (lit[n] * hard + soft)
