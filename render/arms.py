"""Arms in pictures: elbows and upper arms that leave hands free, and end in no picture where they can.

Elbows flex by 150 degrees at most (American Academy of Orthopaedic Surgeons 1965), and by 30 to 130 at daily
work (Morrey, Askew and Chao 1981, J. Bone Joint Surg. 63-A:872).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float

from handsim.kernels import kernel, segment_distance_squared
from handsim.space.camera import Camera
from render.frames import Doubles
from render.skin.look import REACH

_BARE: Final = 0.15  # share of a forearm, from the wrist on, that may be before its own hand
_INNER: Final = 0.035  # distance of an arm's axis from a line of sight that it hides whole [m]
_OUTER: Final = 0.075  # least distance of one that it leaves free [m]
_HIDING: Final = 15.0  # cost of an arm that hides all keypoints from a camera
_COMPARED: Final = 10  # forearms whose upper arms are tried
_SOFTNESS: Final = 0.3  # difference of costs within which forearms are averaged, so that they do not jump
_TURNS: Final = np.deg2rad([0, 20, -20, 40, -40, 60, -60, 90, -90, 120, -120, 150, -150, 180])
_TILTS: Final = (0.0, 0.4)  # slopes of an upper arm towards the cameras that are tried
_DOWN: Final = np.array([0.0, 0.0, -0.5])  # downward part of the direction from the elbows to the body
_BENT: Final = np.deg2rad([95.0, 130.0])  # angles of an elbow that cost nothing, and 3
_CLEAR: Final = 0.15  # least distance between an arm and a camera [m]
_MARGIN: Final = 0.1  # border around a picture where no arm may end, as a share of its size


class Arms(NamedTuple):
    """Where the arms of H hands can be: S elbows each, and what each of these costs."""

    wrists: Float[np.ndarray, "H 3"]
    """Positions [m]."""
    forearms: Float[np.ndarray, "H S 3"]
    """Unit vectors from each wrist to its S possible elbows."""
    elbows: Float[np.ndarray, "H S 3"]
    """Positions [m]."""
    costs: Float[np.ndarray, "H S"]
    """Costs of their bends."""
    shoulders: Float[np.ndarray, "H 3"] | None = None
    """Positions [m]; None for people whose place is not known."""


def bend_arms(
    arms: Arms, points: Float[np.ndarray, "N 3"], cameras: Sequence[Camera]
) -> tuple[Doubles, Doubles]:
    """Unit directions (H, 3) of forearms from wrists, and of upper arms from elbows.

    Arms hide as few of the hands' points [m] from the cameras as they can, and end in no picture.
    """
    eyes, points = _eyes(cameras), points[None]
    axis = _common_axis(cameras)
    behind = _towards_body(arms.forearms[:, 0], axis, cameras)
    forearms, upper_arms = np.empty((2, len(arms.wrists), 3))

    def upper(hand: int, elbows: Doubles, fore: Doubles) -> tuple[Doubles, Doubles]:
        ways = behind[hand, None] if arms.shoulders is None else arms.shoulders[hand] - elbows
        return _upper_arms(elbows, fore, ways, axis, cameras, points)

    for hand, (wrist, fore, elbows, costs) in enumerate(zip(*arms[:4], strict=True)):
        way, elbow = fore, elbows
        if len(elbows) > 1:
            bad = costs + hiding_costs(forearm_axes(wrist, elbows)[None], eyes, points)[0]
            best = bad.argsort(kind="stable")[:_COMPARED]
            bad = bad[best] + upper(hand, elbows[best], fore[best])[1].min(axis=1)
            mean = np.exp((bad.min() - bad) / _SOFTNESS) @ fore[best]
            way = mean[None] / np.linalg.norm(mean)
            elbow = wrist + np.linalg.norm(elbows[0] - wrist) * way
        tried, bad = upper(hand, elbow, way)
        forearms[hand], upper_arms[hand] = way[0], tried[0, bad[0].argmin()]
    return forearms, upper_arms


def forearm_axes(wrists: Doubles, elbows: Doubles) -> Doubles:
    """Axes (..., 2, 3) of forearms that may hide hands [m], without what is close behind the wrist."""
    return np.stack(np.broadcast_arrays(wrists + _BARE * (elbows - wrists), elbows), axis=-2)


@kernel
def hiding_costs(
    axes: Float[np.ndarray, "B A 2 3"], eyes: Float[np.ndarray, "B C 3"], points: Float[np.ndarray, "B N 3"]
) -> Any:
    """Costs (B, A) of arms with these axes that hide points from eyes [m]; points of NaN are not there."""
    costs = np.zeros(axes.shape[:2])
    for one in range(len(axes)):
        for arm in range(axes.shape[1]):
            hidden = 0.0
            for eye in eyes[one]:
                for point in points[one]:
                    hidden += _hidden(eye, point, axes[one, arm, 0], axes[one, arm, 1])
            costs[one, arm] = _HIDING * hidden / points.shape[1]
    return costs


@kernel
def most_hidden(
    axes: Float[np.ndarray, "F A 2 3"], eyes: Float[np.ndarray, "F 3"], points: Float[np.ndarray, "F H P 3"]
) -> Any:
    """Share (F,) of the points of a hand that arms hide, of the hand with the largest; NaN is no hand."""
    most = np.zeros(len(eyes))
    for frame in range(len(eyes)):
        for hand in points[frame]:
            hidden = 0.0
            for point in hand:
                covered = 0.0
                for axis in axes[frame]:
                    covered = max(covered, _hidden(eyes[frame], point, axis[0], axis[1]))
                hidden += covered
            most[frame] = max(most[frame], hidden / points.shape[2])
    return most


@kernel
def _hidden(eye: Any, point: Any, start: Any, end: Any) -> float:
    """How much, from 0 to 1, an arm hides a point from an eye: all where it is close to the eye."""
    if segment_distance_squared(eye, eye, start, end) < _CLEAR**2:
        return 1.0
    away = np.sqrt(segment_distance_squared(eye, point, start, end))
    return min(1.0, (_OUTER - away) / (_OUTER - _INNER)) if away < _OUTER else 0.0


def _eyes(cameras: Sequence[Camera]) -> Doubles:
    """Positions (1, C, 3) of cameras [m]."""
    return np.array([[camera.T_world_camera[:3, 3] for camera in cameras]])


def _common_axis(cameras: Sequence[Camera]) -> Doubles:
    """Unit direction (3,) in which the cameras look on average."""
    axis = np.mean([camera.T_world_camera[:3, 2] for camera in cameras], axis=0)
    if np.linalg.norm(axis) < 0.2:  # the cameras stand all around the arms
        axis = cameras[0].T_world_camera[:3, 2]
    return np.asarray(axis / np.linalg.norm(axis))


def _towards_body(forearms: Doubles, axis: Doubles, cameras: Sequence[Camera]) -> Doubles:
    """Directions (H, 3) of upper arms of people whose place is not known, behind their forearms (H, 3)."""
    body = forearms.mean(axis=0) * [1.0, 1.0, 0.0] + _DOWN
    body -= (body @ axis) * axis
    body /= max(float(np.linalg.norm(body)), 1e-6)
    flat = forearms - (forearms @ axis)[:, None] * axis
    level = np.linalg.norm(flat, axis=1, keepdims=True)
    back = np.minimum(flat @ body, 0.0)[:, None] / np.maximum(level, 1e-6) ** 2
    ways = flat + (1.0 - level) * (body - back * np.minimum(5.0 * level, 1.0) * flat)
    ways[np.linalg.norm(ways, axis=1) < 1e-3] = cameras[0].T_world_camera[:3, 1]
    return np.asarray(ways)


def _upper_arms(
    elbows: Doubles,
    forearms: Doubles,
    ways: Doubles,
    axis: Doubles,
    cameras: Sequence[Camera],
    points: Doubles,
) -> tuple[Doubles, Doubles]:
    """Upper arms (S, K, 3) near these ways (S, 3), turned about `axis`, and their costs (S, K)."""
    ways = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    turns = np.cos(_TURNS)[:, None] * ways[:, None] + np.sin(_TURNS)[:, None] * np.cross(axis, ways)[:, None]
    tried = np.concatenate([turns - tilt * axis for tilt in _TILTS], axis=1)
    tried /= np.linalg.norm(tried, axis=-1, keepdims=True)
    bad = np.tile(np.abs(_TURNS), len(_TILTS)) / np.pi + np.repeat(_TILTS, len(_TURNS))
    angles = np.arccos(np.clip(np.einsum("ski,si->sk", tried, forearms), -1.0, 1.0))
    bad = bad + 3.0 * np.square(np.maximum(angles - _BENT[0], 0.0) / (_BENT[1] - _BENT[0]))
    ends = elbows[:, None] + REACH * tried
    for camera in cameras:
        with np.errstate(invalid="ignore"):
            pixels = camera.project(ends) / np.array(camera.size, dtype=np.float64)
        inside = (np.abs(pixels - 0.5) < 0.5 + _MARGIN).all(axis=-1)
        bad += 10.0 * (inside & (camera.local(ends)[..., 2] > 0.0))
    axes = np.stack([np.broadcast_to(elbows[:, None], ends.shape), ends], axis=2)
    return tried, bad + hiding_costs(axes.reshape(1, -1, 2, 3), _eyes(cameras), points).reshape(bad.shape)
