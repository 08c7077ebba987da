"""Pictures of made-up rooms: walls, floor and ceiling with patterns, and boxes for furniture, ray by ray.

A third of the picture's resolution is enough: a background is out of focus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float32
    from numpy.typing import NDArray

_REDUCED: Final = 3
_FURNITURE: Final = (4, 14)


def draw_room(size: tuple[int, int], *, rng: np.random.Generator) -> Float32[np.ndarray, "H W 3"]:
    """A random room from a random place, linear light.

    Args:
        size: Width and height [pixels].
        rng: Where the choices come from.
    """
    width, height = (max(1, length // _REDUCED) for length in size)
    room = rng.uniform((2.5, 2.5, 2.3), (7.0, 7.0, 3.2))  # [m], corner at the origin, z up
    eye = room * rng.uniform((0.25, 0.05, 0.35), (0.75, 0.3, 0.75))
    rays = _rays(width, height, rng)
    picture, reach = _walls(eye, rays, room, rng)
    for _ in range(int(rng.integers(*_FURNITURE))):
        _add_box(picture, reach, eye, rays, room, rng)
    # Lamps and windows leave some places darker than others.
    lamp = room * rng.uniform((0.1, 0.1, 0.7), (0.9, 0.9, 1.0))
    points = eye + reach[:, None] * rays
    light = 1.0 / (0.35 + 0.09 * ((points - lamp) ** 2).sum(axis=1))
    picture *= (light * rng.uniform(0.55, 1.1))[:, None]
    grain = 1.0 + 0.05 * rng.standard_normal((height, width, 1), dtype=np.float32)
    small = picture.reshape(height, width, 3).astype(np.float32) * grain
    small = cv2.GaussianBlur(small, (0, 0), 0.7)  # or edges would show the coarse pixels
    drawn: NDArray[np.float32] = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
    return drawn


def _rays(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Directions (H W, 3) of a camera that looks into the room, a little up or down and askew."""
    focal = height * rng.uniform(0.8, 1.5)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    turn, tip, roll = rng.normal(0.0, 0.45), rng.normal(-0.12, 0.25), rng.normal(0.0, 0.06)
    x, y = np.cos(roll) * x - np.sin(roll) * y, np.sin(roll) * x + np.cos(roll) * y
    ahead, up = focal * np.cos(tip) + y * np.sin(tip), focal * np.sin(tip) - y * np.cos(tip)
    along = np.stack(
        [np.cos(turn) * x - np.sin(turn) * ahead, np.sin(turn) * x + np.cos(turn) * ahead, up], -1
    )
    along = along.reshape(-1, 3)
    along[np.abs(along) < 1e-6] = 1e-6
    rays: NDArray[np.float32] = (along / np.linalg.norm(along, axis=1, keepdims=True)).astype(np.float32)
    return rays


def _walls(
    eye: NDArray[np.float64], rays: NDArray[np.float32], room: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the room's six sides look like along each ray, and how far away they are."""
    ways = np.where(rays > 0.0, room - eye, -eye).astype(np.float32) / rays
    axis = ways.argmin(axis=1)
    reach = ways.min(axis=1)
    points = eye.astype(np.float32) + reach[:, None] * rays
    picture = np.zeros_like(rays)
    for wall in range(6):
        side, far = wall // 2, wall % 2
        mine = np.flatnonzero((axis == side) & ((rays[:, side] > 0.0) == bool(far)))
        first, second = (other for other in range(3) if other != side)
        places = points[mine][:, [first, second]]
        picture[mine] = _surface(places, room[[first, second]], rng, pictures=side != 2)
    return picture, reach


def _add_box(
    picture: NDArray[np.float32],
    reach: NDArray[np.float32],
    eye: NDArray[np.float64],
    rays: NDArray[np.float32],
    room: NDArray[np.float64],
    rng: np.random.Generator,
) -> None:
    """Draw a piece of furniture that stands on the floor, or hangs on or stands by a wall."""
    extent = rng.uniform((0.2, 0.2, 0.1), (1.6, 1.0, 1.9)) * rng.uniform(0.4, 1.0)
    corner = rng.uniform(0.0, 1.0, 3) * np.maximum(room - extent, 0.01)
    corner[1] = max(corner[1], eye[1] + 0.7)  # ahead of the camera
    if rng.random() < 0.7:
        corner[2] = 0.0
    color, other = _paint(rng), _paint(rng)
    with np.errstate(over="ignore"):
        low = ((corner - eye).astype(np.float32)) / rays
        high = ((corner + extent - eye).astype(np.float32)) / rays
    enter_each = np.minimum(low, high)
    enter, leave = enter_each.max(axis=1), np.maximum(low, high).min(axis=1)
    hit = np.flatnonzero((enter > 0.05) & (enter < leave) & (enter < reach))
    if not len(hit):
        return
    axis = enter_each[hit].argmax(axis=1)
    points = eye.astype(np.float32) + enter[hit, None] * rays[hit]
    shade = rng.uniform(0.55, 1.0, 3).astype(np.float32)[axis]
    # Drawers and shelves: bands of a second colour over the height
    bands = rng.integers(0, 5)
    if bands:
        phase = (points[:, 2] - corner[2]) / extent[2] * bands % 1.0
        use = (phase < rng.uniform(0.05, 0.5))[:, None]
        painted = np.where(use, other, color)
    else:
        painted = np.broadcast_to(color, (len(hit), 3))
    picture[hit] = painted * shade[:, None]
    reach[hit] = enter[hit]


def _surface(
    places: NDArray[np.float32], extent: NDArray[np.float64], rng: np.random.Generator, *, pictures: bool
) -> NDArray[np.float32]:
    """Paint on a wall or a floor: plain, stripes, tiles or planks, and pictures or windows on walls."""
    first, second = _paint(rng), _paint(rng)
    pattern, pitch = rng.integers(0, 5), rng.uniform(0.06, 0.5)
    cells = np.floor(places / pitch).astype(int)
    if pattern == 0:
        share = (cells[:, 0] % 2).astype(np.float32)
    elif pattern == 1:
        share = (cells.sum(axis=1) % 2).astype(np.float32)
    elif pattern == 2:  # boards of one wood
        tones = rng.uniform(0.0, 0.5, 512).astype(np.float32)
        share = tones[(cells[:, 1] + 7 * (places[:, 0] // (6 * pitch)).astype(int)) % 512]
    else:
        share = np.zeros(len(places), dtype=np.float32)
    color = first + (0.5 * share)[:, None] * (second - first)
    for _ in range(int(rng.integers(0, 4)) if pictures else 0):
        wide, high = rng.uniform((0.3, 0.3), (1.4, 1.2))
        left, low = rng.uniform(0.0, 1.0, 2) * np.maximum(extent - (wide, high), 0.01)
        aside, above = (places[:, 0] - left) / wide, (places[:, 1] - low) / high
        inside = (aside > 0.0) & (aside < 1.0) & (above > 0.0) & (above < 1.0)
        frame = np.minimum(np.minimum(aside, 1.0 - aside), np.minimum(above, 1.0 - above)) < 0.06
        bright = 1.0 if rng.random() < 0.3 else 0.0  # a window
        glass = _paint(rng) * (1.0 - bright) + bright
        slope = (above * rng.uniform(-0.5, 0.5) + 1.0)[:, None]
        color = np.where(inside[:, None], np.where(frame[:, None], _paint(rng), glass * slope), color)
    painted: NDArray[np.float32] = color.astype(np.float32)
    return painted


def _paint(rng: np.random.Generator) -> NDArray[np.float32]:
    """Linear light of some paint, wood or cloth."""
    grey = rng.uniform(0.1, 0.95) ** 2.2
    tint = np.exp(paint_tint(rng))
    color: NDArray[np.float32] = np.clip(grey * tint, 0.003, 0.95).astype(np.float32)
    return color


def paint_tint(rng: np.random.Generator) -> NDArray[np.float64]:
    """Logarithms of a paint's red, green and blue over its grey: warm or cool, seldom green or magenta."""
    warm, green = rng.normal(0.12, 0.28), rng.normal(0.0, 0.10)
    tint: NDArray[np.float64] = np.array([warm, green, -1.1 * warm])
    return tint
