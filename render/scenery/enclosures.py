"""Backgrounds that several cameras share: a box around all hands and cameras, with depth.

A picture behind the hands has no place in the world, which one camera does not notice. Two cameras do: what
they see behind a hand must be shifted by its distance. With several cameras a background is therefore a place
of that kind: a room with its furniture, or a box with a picture on each of its walls.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8
from numpy.typing import NDArray

from handsim.space.camera import Camera, Lens
from render.frames import Pictures
from render.scenery.backgrounds import Background, draw_background
from render.scenery.photographs import photos_beside
from render.scenery.rooms import RoomLight, cast_room

Corner = tuple[float, float, float]
_MARGIN: Final = (0.8, 2.2)  # [m] between the outermost camera or hand and a wall
_FREE: Final = 0.5  # [m] around hands and cameras without furniture
_TEXTURE: Final = 512  # [px] of a wall each way
_GAMMA: Final = 2.2
_SHORTEST: Final = 1e-6  # component of a ray, so that it meets each pair of walls


@dataclass(frozen=True, slots=True)
class Enclosure:
    """A box that holds everything, in the world's axes, z up."""

    low: Corner
    """[m]."""
    high: Corner
    free: tuple[Corner, Corner]
    """Low and high corner of the box that hands and cameras stay in [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What one camera sees behind hands and objects."""

    rgb: UInt8[np.ndarray, "H W 3"]
    """sRGB; 0 where the lens sees nothing."""
    depth: Float32[np.ndarray, "H W"]
    """Along the camera's axis [m]; 0 for what is not ahead."""
    axes: Int8[np.ndarray, "H W"]
    """Axis of the world that the surface's normal has."""
    signs: Int8[np.ndarray, "H W"]
    """Whether it points along that axis (1) or against it (-1)."""

    def put_behind(self, pictures: Pictures, camera: Camera) -> Pictures:
        """Pictures of hands and objects with depth and normals behind them, too.

        Args:
            pictures: Depth, normals if any, and instances.
            camera: The camera of both.
        """
        assert pictures.depth is not None and pictures.instances is not None
        bare = (pictures.instances == 0) & (self.depth > 0.0)
        normals = pictures.normals
        if normals is not None:
            normals = normals.copy()
            normals[bare] = camera.T_world_camera[:3, :3][self.axes[bare]] * self.signs[bare][:, None]
        return dataclasses.replace(
            pictures, depth=np.where(bare, self.depth, pictures.depth), normals=normals
        )


def enclose(positions: Float[np.ndarray, "N 3"], seed: int) -> Enclosure:
    """A random box around cameras and hands.

    Args:
        positions: Where they are [m].
        seed: Seed of the distances of the walls.
    """
    below, above = np.random.default_rng([seed, 0]).uniform(*_MARGIN, (2, 3))
    low, high = positions.min(axis=0), positions.max(axis=0)
    return Enclosure(
        _corner(low - below), _corner(high + above), (_corner(low - _FREE), _corner(high + _FREE))
    )


def _corner(point: NDArray[np.float64]) -> Corner:
    x, y, z = point.tolist()
    return x, y, z


def draw_surroundings(background: Background, enclosure: Enclosure, camera: Camera) -> Surroundings:
    """What a camera inside the box, with any lens, sees of it; what stands still is drawn once.

    Raises:
        HandSimError: The photograph cannot be read.
    """
    focal = tuple(camera.K.ravel().tolist())
    lens = camera.lens
    return _drawn(background, enclosure, camera.size, focal, lens, camera.T_world_camera.tobytes())


@functools.lru_cache(maxsize=16)
def _drawn(
    background: Background,
    enclosure: Enclosure,
    size: tuple[int, int],
    focal: tuple[float, ...],
    lens: Lens,
    pose: bytes,
) -> Surroundings:
    T_world_camera = np.frombuffer(pose).reshape(4, 4)
    rays = Camera("rays", size, np.reshape(focal, (3, 3)), lens=lens).rays()
    known = np.isfinite(rays).all(axis=-1)
    world = (np.where(known[..., None], rays, 1.0) @ T_world_camera[:3, :3].T).reshape(-1, 3)
    world[np.abs(world) < _SHORTEST] = _SHORTEST
    low, high = np.array(enclosure.low), np.array(enclosure.high)
    eye, rng = T_world_camera[:3, 3] - low, np.random.default_rng([background.seed, 1])
    if background.kind == "room":
        free = np.array(enclosure.free) - low
        met = cast_room(world.astype(np.float32), eye, high - low, free, rng=rng)
    else:
        met = _meet_walls(world, eye, high - low, _wall_pictures(background, enclosure))
    shape = size[::-1]
    light = np.clip(met.light, 0.0, 1.0).reshape(*shape, 3) * known[..., None]
    if background.blur * shape[0] > 0.3:
        light = cv2.GaussianBlur(light, (0, 0), background.blur * shape[0])
    rgb = np.rint(255.0 * cv2.pow(light.astype(np.float32), 1.0 / _GAMMA)).astype(np.uint8)
    depth = met.distances.reshape(shape) * np.where(known, rays[..., 2], 0.0)
    along = np.take_along_axis(world, met.axes.reshape(-1, 1).astype(np.int64), axis=1)
    signs = -np.sign(along).astype(np.int8).reshape(shape)
    return Surroundings(rgb, np.maximum(depth, 0.0).astype(np.float32), met.axes.reshape(shape), signs)


@functools.lru_cache(maxsize=2)
def _wall_pictures(background: Background, enclosure: Enclosure) -> Float32[np.ndarray, "R S 3"]:
    """Linear pictures of the six walls, one below the other; a photograph of its own fills each."""
    walls = [
        dataclasses.replace(background, seed=(background.seed + wall) % 2**31, blur=0.0) for wall in range(6)
    ]
    if background.photo is None:
        return np.concatenate([draw_background(wall, (_TEXTURE, _TEXTURE)) for wall in walls])
    room = np.array(enclosure.high) - np.array(enclosure.low)
    pictures = []
    for number, (wall, photo) in enumerate(zip(walls, photos_beside(Path(background.photo), 6), strict=True)):
        sides = np.delete(room, number // 2)  # across and up
        width, height = np.ceil(_TEXTURE * sides / sides.max()).astype(int).tolist()
        picture = draw_background(dataclasses.replace(wall, photo=str(photo)), (width, height))
        pictures.append(cv2.resize(picture, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_LINEAR))
    return np.concatenate(pictures)


def _meet_walls(
    rays: NDArray[np.float64],
    eye: NDArray[np.float64],
    room: NDArray[np.float64],
    pictures: NDArray[np.float32],
) -> RoomLight:
    """Where rays (N, 3) from the eye (3,) meet the walls of an empty room (3,), and the pictures there."""
    far = rays > 0.0
    ways = (np.where(far, room, 0.0) - eye) / rays
    axes = ways.argmin(axis=1)
    row = np.arange(len(rays))
    distances = ways[row, axes]
    share = np.clip((eye + distances[:, None] * rays) / room, 0.0, 1.0)
    across, up = share[row, np.where(axes == 0, 1, 0)], share[row, np.where(axes == 2, 1, 2)]
    inner = _TEXTURE - 1.0
    wall = 2 * axes + far[row, axes]
    columns = (across * inner).astype(np.float32)
    rows = (wall * _TEXTURE + (1.0 - up) * inner).astype(np.float32)
    strip = 2**14  # pictures of `remap` have at most 32767 rows
    light = np.empty((len(rays), 3), dtype=np.float32)
    for begin in range(0, len(rays), strip):
        part = slice(begin, begin + strip)
        light[part] = cv2.remap(pictures, columns[part], rows[part], cv2.INTER_LINEAR).reshape(-1, 3)
    return RoomLight(light, distances.astype(np.float32), axes.astype(np.int8))
