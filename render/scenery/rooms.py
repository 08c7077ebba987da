"""Ray-cast pictures of random rooms: walls, floor and ceiling with patterns, and boxes for furniture."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Int8
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.fields import normal_numbers
from render.frames import Doubles, Floats, Integers

_FURNITURE: Final = (4, 14)  # range of the number of boxes
_PLAIN, _STRIPES, _TILES, _BOARDS = 3, 0, 1, 2  # patterns of walls
_WALLS: Final = (0.12, 0.08, 0.12, 0.68)  # probabilities of stripes, tiles, boards and no pattern on a wall
_FLOORS: Final = (0.25, 0.4, 0.35)  # probabilities of tiles, boards and no pattern on a floor
_FLOOR: Final = 4  # number of the floor among the six sides
_CONTRAST: Final = (0.15, 0.7)  # contrast of a pattern over that of any two paints
_COLORED: Final = 0.4  # share of paints with a strong color
_QUARTERS: Final = np.array([(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)])  # four rays of a pixel
_CROSS: Final = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_STEP: Final = 0.04  # least difference of the root of light around a pixel that makes an edge
_FRAME: Final = 0.06  # width of the frame of a picture or window, as a share of its sides


class _Walls(NamedTuple):
    """Paint of the six sides, two for each of x, y and z: at the room's origin and at its far corner."""

    patterns: Integers
    pitches: Doubles  # widths of stripes, tiles and boards (6,) [m]
    colors: Doubles  # two linear colors of each side (6, 2, 3)
    boards: Doubles  # tones of boards (512,)
    frames: Doubles
    """Three pictures or windows of each side (6, 3, 11): left, low, width (0: none), height [m], colors of
    frame and glass, slope of the light on the glass."""


class RoomLight(NamedTuple):
    """Light, distance and side of the surfaces in a room that N rays meet."""

    light: Float32[np.ndarray, "N 3"]  # linear light
    distances: Float32[np.ndarray, "N"]  # distance [m]
    walls: Int8[np.ndarray, "N"]  # twice the axis of the surface's normal, plus one for rays along it


class RoomPicture(NamedTuple):
    """A picture of a room, and the surfaces behind the centers of its pixels."""

    light: Float32[np.ndarray, "H W 3"]  # linear light
    depth: Float32[np.ndarray, "H W"]  # along the axis of the picture's own camera [m]
    walls: Int8[np.ndarray, "H W"]  # as of `RoomLight`
    focal: float  # focal length [picture heights]; the axis meets the middle of the picture
    rotation: Doubles  # the room's axes as columns in the camera's (3, 3)


class _Boxes(NamedTuple):
    """Furniture: B boxes."""

    corners: Doubles  # low and high corners (B, 2, 3) [m]
    colors: Doubles  # two linear colors of each box (B, 2, 3)
    bands: Doubles  # number of drawers or shelves, and the share of each with the second color (B, 2)
    shades: Doubles  # brightness of the faces along x, y and z (B, 3)


@functools.lru_cache(maxsize=2)  # its light and its depth are asked for one after the other
def draw_room(size: tuple[int, int], seed: int) -> RoomPicture:
    """Draw a random room as a camera at a random position in it sees it."""
    (width, height), scene = size, _scene(seed)

    def seen(across: Floats, down: Floats) -> RoomLight:
        """What is at columns and rows (N,) of the picture [px]."""
        rays = np.empty((len(across), 3), dtype=np.float32)
        _aim(across, down, 0.5 * width, 0.5 * height, scene.focal * height, scene.axes, rays)
        return _cast_all(rays, scene.eye, scene.room, scene.walls, scene.boxes, scene.lamp, scene.strength)

    down, across = np.mgrid[:height, :width].reshape(2, -1).astype(np.float32) + np.float32(0.5)
    met = seen(across, down)
    picture = met.light.reshape(height, width, 3).copy()
    smooth_edges(picture, lambda places: seen(*places.T.astype(np.float32, order="C")).light)
    grain = normal_numbers((height, width, 1), rng=np.random.default_rng([seed, 1]))
    picture *= np.float32(1.0) + np.float32(0.05) * grain
    aside = ((across - 0.5 * width) ** 2 + (down - 0.5 * height) ** 2) / (scene.focal * height) ** 2
    depth = met.distances / np.sqrt(aside + 1.0)
    light = cv2.GaussianBlur(picture, (0, 0), 0.9)  # because rays have no width, but pixels do
    shape = height, width
    return RoomPicture(light, depth.reshape(shape), met.walls.reshape(shape), scene.focal, scene.axes)


def smooth_edges(picture: Floats, look: Callable[[Doubles], Floats]) -> None:
    """Give the pixels at edges of a picture (H, W, 3) of linear light the mean of their four quarters.

    `look` has the light (N, 3) at columns and rows (N, 2) of the picture [px].
    """
    roots = cv2.sqrt(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    edges = cv2.morphologyEx(roots, cv2.MORPH_GRADIENT, _CROSS) > _STEP
    places = np.argwhere(edges)[:, ::-1] + _QUARTERS[:, None]
    picture[edges] = look(places.reshape(-1, 2)).reshape(*places.shape[:2], 3).mean(axis=0)


@kernel
def _aim(
    across: Floats, down: Floats, middle: float, center: float, focal: float, axes: Doubles, rays: Floats
) -> None:
    """Write the directions (N, 3), without zeros, of columns and rows (N,) of a picture [px].

    `middle` and `center` are the column and the row of the camera's axis; `axes` are `_Scene.axes`.
    """
    for n in range(len(rays)):
        x, y = (across[n] - middle) / focal, (down[n] - center) / focal
        length = np.sqrt(x * x + y * y + 1.0)
        for axis in range(3):
            way = (x * axes[0, axis] + y * axes[1, axis] + axes[2, axis]) / length
            rays[n, axis] = way if abs(way) > 1e-6 else 1e-6


class _Scene(NamedTuple):
    """A room and a camera in it."""

    room: Doubles  # far corner [m]; the near one is at the origin, z up
    eye: Doubles  # position of the camera [m]
    focal: float  # focal length [picture heights]
    axes: Doubles  # the camera's axes as rows (3, 3): right, down, ahead
    lamp: Doubles  # position of the lamp [m]
    strength: float  # strength of the lamp
    walls: _Walls
    boxes: _Boxes


@functools.lru_cache(maxsize=2)  # each is drawn twice: small for its light, then behind the hands
def _scene(seed: int) -> _Scene:
    """A random room and camera."""
    rng = np.random.default_rng(seed)
    room = rng.uniform((2.5, 2.5, 2.3), (7.0, 7.0, 3.2))
    eye = room * rng.uniform((0.25, 0.05, 0.35), (0.75, 0.3, 0.75))
    focal = float(rng.uniform(0.8, 1.5))
    yaw, pitch, roll = rng.normal(0.0, 0.45), rng.normal(-0.12, 0.25), rng.normal(0.0, 0.06)
    lamp, strength = room * rng.uniform((0.1, 0.1, 0.7), (0.9, 0.9, 1.0)), rng.uniform(0.55, 1.1)
    walls = _paint_walls(room, rng)
    (sy, cy), (sp, cp), (sr, cr) = ((np.sin(angle), np.cos(angle)) for angle in (yaw, pitch, roll))
    aside, upright, level = np.array([cy, sy, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([-sy, cy, 0.0])
    ahead, down = cp * level + sp * upright, sp * level - cp * upright
    axes = np.stack([cr * aside + sr * down, cr * down - sr * aside, ahead])
    boxes = _place_boxes(room, eye, rng)
    return _Scene(room, eye, focal, axes, lamp, strength, walls, boxes)


def cast_room(
    rays: Floats, eye: Doubles, room: Doubles, free: Doubles, lamp: Doubles, *, rng: np.random.Generator
) -> RoomLight:
    """A random room of this size (3,) with this lamp along rays (N, 3) from an eye; no furniture in `free`.

    An equal `rng` gives the same room for every eye.
    """
    strength = rng.uniform(0.55, 1.1)
    walls, boxes = _paint_walls(room, rng), _place_boxes(room, np.full(3, -np.inf), rng)
    kept = ((boxes.corners[:, 1] < free[0]) | (boxes.corners[:, 0] > free[1])).any(axis=1)
    return _cast_all(rays, eye, room, walls, _Boxes(*(part[kept] for part in boxes)), lamp, strength)


def _cast_all(
    rays: Floats, eye: Doubles, room: Doubles, walls: _Walls, boxes: _Boxes, lamp: Doubles, strength: float
) -> RoomLight:
    """Cast all rays (N, 3) from an eye."""
    shape = rays.shape[:1]
    seen = RoomLight(np.empty_like(rays), np.empty(shape, np.float32), np.empty(shape, np.int8))
    _cast(rays, eye, room, *walls, *boxes, lamp, strength, *seen)
    return seen


def _paint_walls(room: Doubles, rng: np.random.Generator) -> _Walls:
    frames = np.zeros((6, 3, 11))
    for wall in range(4):  # not on floor and ceiling
        across = room[1 - wall // 2]
        for number in range(int(rng.integers(0, 4))):
            wide, high = rng.uniform((0.3, 0.3), (1.4, 1.2))
            left, low = rng.uniform(0.0, 1.0, 2) * np.maximum([across - wide, room[2] - high], 0.01)
            window = rng.random() < 0.3
            frame, glass = _paint(rng, 2)
            glass = np.ones(3) if window else glass
            frames[wall, number] = left, low, wide, high, *frame, *glass, rng.uniform(-0.5, 0.5)
    patterns = rng.choice([_STRIPES, _TILES, _BOARDS, _PLAIN], 6, p=_WALLS)
    patterns[_FLOOR:] = rng.choice([_TILES, _BOARDS, _PLAIN], p=_FLOORS), _PLAIN
    colors = _paint(rng, 12).reshape(6, 2, 3)
    colors[:, 1] = colors[:, 0] + rng.uniform(*_CONTRAST, (6, 1)) * (colors[:, 1] - colors[:, 0])
    return _Walls(patterns, rng.uniform(0.06, 0.5, 6), colors, rng.uniform(0.0, 0.5, 512), frames)


def _place_boxes(room: Doubles, eye: Doubles, rng: np.random.Generator) -> _Boxes:
    """Furniture that stands on the floor, or hangs on or stands by a wall."""
    count = int(rng.integers(*_FURNITURE))
    extents = rng.uniform((0.2, 0.2, 0.1), (1.6, 1.0, 1.9), (count, 3)) * rng.uniform(0.4, 1.0, (count, 1))
    low = rng.uniform(0.001, 0.999, (count, 3)) * np.maximum(room - extents, 0.01)
    low[:, 1] = np.maximum(low[:, 1], eye[1] + 0.7)  # ahead of the camera
    low[rng.random(count) < 0.7, 2] = 0.0
    return _Boxes(
        np.stack([low, low + extents], axis=1),
        _paint(rng, 2 * count).reshape(count, 2, 3),
        np.column_stack([rng.integers(0, 5, count), rng.uniform(0.05, 0.5, count)]),
        rng.uniform(0.55, 1.0, (count, 3)),
    )


# Arrays are separate arguments: numba counts references to each array of a tuple, which costs time per call.
@kernel
def _cast(
    rays: Floats,
    eye: Doubles,
    room: Doubles,
    patterns: Integers,
    pitches: Doubles,
    colors: Doubles,
    boards: Doubles,
    frames: Doubles,
    corners: Doubles,
    box_colors: Doubles,
    bands: Doubles,
    shades: Doubles,
    lamp: Doubles,
    strength: float,
    picture: Floats,
    distances: Floats,
    walls: NDArray[np.int8],
) -> None:
    """Write the light (N, 3) along each ray, its distance (N,) [m], and the wall (N,), see `RoomLight`."""
    position, color, inverse = np.empty(3), np.empty(3), np.empty(3)
    offsets = corners - eye
    cones = _cones(offsets)
    for ray in range(len(rays)):
        distance, wall = np.inf, 0
        for axis in range(3):
            inverse[axis] = 1.0 / rays[ray, axis]
            far = inverse[axis] > 0.0
            way = ((room[axis] if far else 0.0) - eye[axis]) * inverse[axis]
            if way < distance:
                distance, wall = way, 2 * axis + int(far)
        box, side, distance = _nearest_box(rays[ray], inverse, offsets, cones, distance)
        distances[ray], walls[ray] = distance, 2 * side + (rays[ray, side] > 0.0) if box >= 0 else wall
        light = 0.35
        for axis in range(3):
            position[axis] = eye[axis] + distance * rays[ray, axis]
            light += 0.09 * (position[axis] - lamp[axis]) ** 2
        light = strength / light
        if box < 0:
            _wall_color(position, wall, patterns, pitches, colors, boards, frames, color)
        else:
            height = 0.999 * (position[2] - corners[box, 0, 2]) / (corners[box, 1, 2] - corners[box, 0, 2])
            second = int(bands[box, 0] > 0.0 and (height * bands[box, 0]) % 1.0 < bands[box, 1])
            light *= shades[box, side]
            for channel in range(3):
                color[channel] = box_colors[box, second, channel]
        for channel in range(3):
            picture[ray, channel] = light * color[channel]


@kernel
def _cones(offsets: Doubles) -> Any:
    """Cones around boxes (B, 4): unit direction of the axis, and the cosine of half the angle."""
    cones = np.empty((len(offsets), 4))
    for box in range(len(offsets)):
        axis = 0.5 * (offsets[box, 0] + offsets[box, 1])
        axis /= np.sqrt((axis * axis).sum())
        least = 1.0
        for corner in range(8):
            along, square = 0.0, 0.0
            for i in range(3):
                place = offsets[box, (corner >> i) & 1, i]
                along, square = along + place * axis[i], square + place * place
            least = min(least, along / np.sqrt(square))
        cones[box, :3] = axis
        cones[box, 3] = least - 1e-5 if least > 0.0 else -2.0  # without a limit beyond a right angle
    return cones


@kernel(inline=True)
def _nearest_box(ray: Floats, inverse: Doubles, offsets: Doubles, cones: Doubles, distance: float) -> Any:
    """The first box along a ray within a distance, the axis of its face, and its distance; -1 for none."""
    nearest, face = -1, 0
    for box in range(len(offsets)):
        if ray[0] * cones[box, 0] + ray[1] * cones[box, 1] + ray[2] * cones[box, 2] < cones[box, 3]:
            continue
        enter, leave, side = -np.inf, np.inf, 0
        for axis in range(3):
            low, high = offsets[box, 0, axis] * inverse[axis], offsets[box, 1, axis] * inverse[axis]
            if min(low, high) > enter:
                enter, side = min(low, high), axis
            leave = min(leave, max(low, high))
        if 0.05 < enter < leave and enter < distance:
            nearest, face, distance = box, side, enter
    return nearest, face, distance


@kernel(inline=True)
def _wall_color(
    position: Doubles,
    wall: int,
    patterns: Integers,
    pitches: Doubles,
    colors: Doubles,
    boards: Doubles,
    frames: Doubles,
    color: Doubles,
) -> None:
    """Write the color of a wall at a position: plain, stripes, tiles or boards, pictures and windows."""
    axis = wall // 2
    first, second = position[1 if axis == 0 else 0], position[1 if axis == 2 else 2]
    pitch, pattern, share = pitches[wall], patterns[wall], 0.0
    across, up = int(np.floor(first / pitch)), int(np.floor(second / pitch))
    if pattern == _STRIPES:
        share = across % 2
    elif pattern == _TILES:
        share = (across + up) % 2
    elif pattern == _BOARDS:
        share = boards[(up + 7 * int(first // (6.0 * pitch))) % len(boards)]
    for channel in range(3):
        color[channel] = colors[wall, 0, channel]
        color[channel] += 0.5 * share * (colors[wall, 1, channel] - colors[wall, 0, channel])
    for number in range(frames.shape[1]):
        left, low = frames[wall, number, 0], frames[wall, number, 1]
        wide, high = frames[wall, number, 2], frames[wall, number, 3]
        if wide == 0.0:
            continue
        aside, above = (first - left) / wide, (second - low) / high
        edge = min(aside, 1.0 - aside, above, 1.0 - above)
        if edge > 0.0:
            start = 4 if edge < _FRAME else 7
            bright = 1.0 if edge < _FRAME else 1.0 + above * frames[wall, number, 10]
            for channel in range(3):
                color[channel] = bright * frames[wall, number, start + channel]


def _paint(rng: np.random.Generator, count: int) -> Doubles:
    """Linear light (count, 3) of some paints, woods or cloths."""
    gray = rng.uniform(0.1, 0.95, (count, 1)) ** 2.2
    return np.clip(gray * np.exp(paint_tints(rng, count)), 0.003, 0.95)


def paint_tints(rng: np.random.Generator, count: int) -> Doubles:
    """Logarithms (count, 3) of paints' colors over their gray; few are strong, green or magenta."""
    strong = rng.random(count) < _COLORED
    warm = rng.normal(0.08, np.where(strong, 0.32, 0.10))
    green = rng.normal(0.0, np.where(strong, 0.10, 0.04))
    return np.stack([warm, green, -1.1 * warm], axis=1)
