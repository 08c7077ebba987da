"""Where cameras can be hung in a room: on its walls, on a truss, on tripods; and where they can look."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from handsim.space.camera import look_at
from handsim.space.rig import HAND_REACH

Mount = Literal["walls", "truss", "tripods"]
MOUNTS: Final[tuple[Mount, ...]] = get_args(Mount)
_MOST: Final = 400  # places; the step between them grows with the room
_STEPS: Final = (0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)  # between places [m]
_OFF: Final = 0.1  # of a lens from wall, ceiling or beam [m]
_LOWEST: Final = 0.5  # of cameras on walls and posts [m]
_TRIPODS: Final = (0.9, 1.4, 1.9)  # heights of heads [m]
_LARGE: Final = 1.0  # side of a volume from which on cameras look elsewhere than at its middle [m]
_ASIDE: Final = 0.3  # of a side


class Places(NamedTuple):
    """K ways to hang one camera."""

    T_world_camera: Float[np.ndarray, "K 4 4"]
    targets: Float[np.ndarray, "K 3"]
    """What each looks at [m]."""


def places(
    room: Float[np.ndarray, "3"],
    mounts: Sequence[Mount],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
) -> Places:
    """All positions on the mounts, each with all aims.

    Args:
        room: Width along x, depth along y and height of the room or truss, which stands on the floor with
            its middle below that of the volume [m].
        mounts: Which mounts there are.
        center: Middle of the volume that hands work in [m].

    Raises:
        ArgumentError: There is no place outside the reach of the hands.
    """
    for step in _STEPS:
        found = np.unique(np.concatenate([_ON[mount](room, step) for mount in mounts]).round(6), axis=0)
        found[:, :2] += center[:2]
        nearest = np.clip(found, center - sides / 2, center + sides / 2)
        found = found[np.linalg.norm(found - nearest, axis=1) >= HAND_REACH]
        if len(found) <= _MOST:
            break
    if not len(found):
        raise ArgumentError(
            f"in a room of {_lengths(room)} no place on {' and '.join(mounts)} is {HAND_REACH:g} m or more "
            f"from the volume of {_lengths(sides)}; expected a larger room"
        )
    aims = [center]
    for axis in range(3):
        if sides[axis] > _LARGE:
            offset = np.eye(3)[axis] * _ASIDE * sides
            aims += [center + offset, center - offset]
    pairs = [(position, aim) for position in found for aim in aims]
    return Places(
        np.stack([look_at(position, aim) for position, aim in pairs]), np.stack([aim for _, aim in pairs])
    )


def _on_walls(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    width, depth = room[:2] / 2 - _OFF
    return _product(_outline(width, depth, step), _line(_LOWEST, room[2] - _OFF, step))


def _on_truss(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Beams along the top of all four sides, and the posts below their ends."""
    width, depth = room[:2] / 2
    beams = _product(_outline(width, depth, step), np.array([room[2] - _OFF]))
    corners = np.array([[x, y] for x in (-width, width) for y in (-depth, depth)])
    return np.concatenate([beams, _product(corners, _line(_LOWEST, room[2] - _OFF, step))])


def _on_tripods(room: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    width, depth = room[:2] / 2 - 3 * _OFF
    along, across = _line(-width, width, step), _line(-depth, depth, step)
    floor = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    return _product(floor, np.array([height for height in _TRIPODS if height < room[2] - _OFF]))


_ON: Final = {"walls": _on_walls, "truss": _on_truss, "tripods": _on_tripods}


def _outline(width: float, depth: float, step: float) -> NDArray[np.float64]:
    """Points (N, 2) on a rectangle of these half sides."""
    along, across = _line(-width, width, step), _line(-depth, depth, step)
    sides = [np.stack([along, np.full(len(along), end)], axis=1) for end in (-depth, depth)]
    sides += [np.stack([np.full(len(across), end), across], axis=1) for end in (-width, width)]
    return np.concatenate(sides)


def _line(low: float, high: float, step: float) -> NDArray[np.float64]:
    """Numbers from end to end, about a step apart."""
    return np.linspace(low, high, max(1, round((high - low) / step)) + 1)


def _product(floor: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each point (N, 2) at each height."""
    above = np.repeat(floor, len(heights), axis=0)
    return np.column_stack([above, np.tile(heights, len(floor))])


def _lengths(sides: NDArray[np.float64]) -> str:
    return " x ".join(f"{one:g}" for one in sides) + " m"
