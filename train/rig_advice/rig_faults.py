"""What is suspicious about a camera rig, from its geometry alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.optics.reconstruction import MARKER_RADIUS
from handsim.space.rig import HAND_REACH, ROOM_CENTER, CameraRig

HALF_SIDE: Final = 0.3
"""Half side of the cube around the rig's middle that hands work in [m]."""
_CLOSE: Final = 0.10  # two cameras nearer than this see the same [m]
_AWAY: Final = 0.5  # [m] from where simulated hands are
_NARROW: Final = 30.0  # least useful angle between two cameras [deg]
_SMALL: Final = 2.0  # diameter of a marker that is found well [px]
_COVERED: Final = 0.9  # of the cube, by two cameras
_UPSIDE_DOWN: Final = -0.2  # of the picture's up, along the world's


def working_point(rig: CameraRig) -> NDArray[np.float64]:
    """The point (3,) nearest to all optical axes [m]; `ROOM_CENTER` where they are parallel."""
    axes = rig.T_world_camera[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > 1e6:
        return np.array(ROOM_CENTER)
    return np.linalg.solve(total, np.einsum("cij,cj->i", across, rig.positions))


def cube_points(
    center: Float[np.ndarray, "3"], sides: Float[np.ndarray, "3"], count: int = 7
) -> NDArray[np.float64]:
    """A grid of points (count ** 3, 3) in a box of these sides around a center [m]."""
    steps = np.linspace(-0.5, 0.5, count)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(center + grid * sides)


def faults(rig: CameraRig) -> list[str]:
    """Sentences, each about something that a usable rig seldom has."""
    point = working_point(rig)
    return [*_axes(rig, point), *_places(rig, point), *_coverage(rig, point)]


def _axes(rig: CameraRig, point: NDArray[np.float64]) -> Iterator[str]:
    rays = point - rig.positions
    ahead = np.einsum("ci,ci->c", rays, rig.T_world_camera[:, :3, 2])
    if (ahead < 0.0).sum() > len(ahead) / 2:
        yield (
            "most cameras look away from the point where their axes meet: expected OpenCV's axes, z into the "
            "picture and y down, are these OpenGL's?"
        )
        return
    seen = rig.in_view(point)
    for number in np.flatnonzero(~seen) + 1:
        yield f"camera {number} looks away: {_place(point)}, where the others look, is not in its picture"
    ups = -rig.T_world_camera[:, 2, 1]
    for number in np.flatnonzero(ups < _UPSIDE_DOWN) + 1:
        yield f"camera {number} is upside down: y of its picture points up in the world, expected down"


def _places(rig: CameraRig, point: NDArray[np.float64]) -> Iterator[str]:
    positions = rig.positions
    for number in np.flatnonzero(positions[:, 2] < 0.0) + 1:
        yield (f"camera {number} is {-positions[number - 1, 2]:.2f} m below the floor, expected z up")
    for first, second in zip(*np.nonzero(np.triu(_distances(positions) < _CLOSE, 1)), strict=True):
        apart = 100 * np.linalg.norm(positions[first] - positions[second])
        yield f"cameras {first + 1} and {second + 1} are {apart:.0f} cm apart and see nearly the same"
    if np.linalg.norm(point - ROOM_CENTER) > _AWAY:
        yield (
            f"the cameras look at {_place(point)}; simulated hands move around "
            f"{_place(np.array(ROOM_CENTER))}, so give rig score --center, or move the rig's origin"
        )
    near = np.clip(positions, point - HALF_SIDE, point + HALF_SIDE)
    gaps = np.linalg.norm(positions - near, axis=1)
    for number in np.flatnonzero(gaps < HAND_REACH) + 1:
        yield (
            f"camera {number} is {gaps[number - 1]:.2f} m from the cube that hands work in, expected at "
            f"least {HAND_REACH:g} m"
        )
    rays = (point - positions) / np.linalg.norm(point - positions, axis=1, keepdims=True)
    widest = np.rad2deg(np.arccos(np.clip(np.abs(rays @ rays.T), 0.0, 1.0))).max()
    if widest < _NARROW:
        yield (
            f"no two cameras see the middle at more than {widest:.0f} deg to each other: depth will be "
            f"noisy, expected at least {_NARROW:.0f} deg"
        )


def _coverage(rig: CameraRig, point: NDArray[np.float64]) -> Iterator[str]:
    sizes = pixels_of_a_marker(rig, point)
    for number in np.flatnonzero(sizes < _SMALL) + 1:
        yield (
            f"camera {number} sees a marker of {2e3 * MARKER_RADIUS:.1f} mm as {sizes[number - 1]:.1f} px, "
            f"expected at least {_SMALL:g} px"
        )
    sides = np.full(3, 2 * HALF_SIDE)
    covered = float((rig.in_view(cube_points(point, sides)).sum(axis=-1) >= 2).mean())
    if covered < _COVERED:
        yield (
            f"two cameras see only {100 * covered:.0f} % of the cube of {2 * HALF_SIDE:g} m around "
            f"{_place(point)}, expected all of it"
        )


def pixels_of_a_marker(rig: CameraRig, point: Float[np.ndarray, "3"]) -> NDArray[np.float64]:
    """Diameter (C,) of the paper's marker at a point [m] in each picture [px]."""
    distances = np.linalg.norm(point - rig.positions, axis=1)
    focals = np.array([one.focal_length for one in rig.cameras])
    return np.asarray(2 * MARKER_RADIUS * focals / np.maximum(distances, 1e-9))


def _distances(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(positions[:, None] - positions, axis=-1))


def _place(point: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{one:.2f}' for one in point + 0.0)}) m"
