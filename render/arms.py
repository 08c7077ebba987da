"""Arms in pictures: elbows and upper arms that leave hands free, and end in no picture where they can.

Arms of a motion are chosen a few times a second, so that they hide little and turn little, and turn evenly
from one choice to the next.

Elbows flex by 150 degrees at most (American Academy of Orthopaedic Surgeons 1965), and by 30 to 130 at daily
work (Morrey, Askew and Chao 1981, J. Bone Joint Surg. 63-A:872).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.optics.visibility import free_rays
from gloves.takes.take import Take
from handsim.hand.model import hand_keypoints
from handsim.kernels import kernel, segment_distance_squared
from handsim.space.camera import Camera
from render.frames import Doubles, Integers
from render.skin.look import REACH

_BARE: Final = 0.15  # share of a forearm, from the wrist on, that may be before its own hand
_INNER: Final = 0.035  # distance of an arm's axis from a line of sight that it hides whole [m]
_OUTER: Final = 0.075  # least distance of one that it leaves free [m]
HIDING: Final = 15.0
"""Cost of an arm that hides all keypoints from a camera."""
MOST_HIDDEN: Final = 0.4
"""A picture shows a hand if less than this share of its keypoints is hidden."""
_COMPARED: Final = 10  # forearms whose upper arms are tried
_STEADY: Final = 2.0  # cost of an arm that turns by 60 degrees between two choices
_TURNS: Final = np.deg2rad([0, 20, -20, 40, -40, 60, -60, 90, -90, 120, -120, 150, -150, 180])
_TILTS: Final = (0.0, 0.4)  # slopes of an upper arm towards the cameras that are tried
_DOWN: Final = np.array([0.0, 0.0, -0.5])  # downward part of the direction from the elbows to the body
_BENT: Final = np.deg2rad([95.0, 130.0])  # angles of an elbow that cost nothing, and 3
_CLEAR: Final = 0.15  # least distance between an arm and a camera [m]
_MARGIN: Final = 0.1  # border around a picture where no arm may end, as a share of its size


class Arms(NamedTuple):
    """Where the arms of H hands can be in K frames: S elbows each, and what each of these costs."""

    wrists: Float[np.ndarray, "K H 3"]
    """Positions [m]."""
    forearms: Float[np.ndarray, "K H S 3"]
    """Unit vectors from each wrist to its S possible elbows."""
    elbows: Float[np.ndarray, "K H S 3"]
    """Positions [m]."""
    costs: Float[np.ndarray, "K H S"]
    """Costs of their bends."""
    shoulders: Float[np.ndarray, "H 3"] | None = None
    """Positions [m]; None for people whose place is not known."""
    whole: bool = False
    """Whether upper arms end at the shoulders; otherwise they reach on and may turn aside."""


def bend_arms(
    arms: Arms, points: Float[np.ndarray, "K N 3"], cameras: Sequence[Sequence[Camera]]
) -> tuple[Doubles, Doubles]:
    """Unit directions (K, H, 3) of forearms from wrists, and upper arms from elbows (K, H, 3) [m].

    Arms hide as few of the hands' points [m] from each frame's cameras as they can, and turn little from one
    of the frames to the next. Those that do not end at shoulders end in no picture.
    """
    eyes = np.array([[one.T_world_camera[:3, 3] for one in viewing] for viewing in cameras])
    axes = np.array([_common_axis(viewing) for viewing in cameras])
    forearms, upper_arms = np.empty((2, *arms.wrists.shape))
    behind = [_towards_body(*one) for one in zip(arms.forearms[:, :, 0], axes, cameras, strict=True)]
    for hand in range(arms.wrists.shape[1]):
        fore, elbows, bad = arms.forearms[:, hand], arms.elbows[:, hand], arms.costs[:, hand]
        bad = bad + hiding_costs(forearm_axes(arms.wrists[:, hand, None], elbows), eyes, points)
        best = bad.argsort(axis=1, kind="stable")[:, :_COMPARED, None]
        fore, elbows = (np.take_along_axis(one, best, axis=1) for one in (fore, elbows))
        ways = np.array(behind)[:, hand, None] if arms.shoulders is None else arms.shoulders[hand] - elbows
        if arms.whole:
            upper, worse = ways[:, :, None], np.zeros((*ways.shape[:2], 1))
        else:
            upper, worse = _upper_arms(elbows, fore, ways, axes, cameras)
        worse += hiding_costs(_upper_axes(elbows, upper), eyes, points).reshape(worse.shape)
        bad = np.take_along_axis(bad, best[..., 0], axis=1) + worse.min(axis=2)
        rows, chosen = np.arange(len(fore)), _steadiest(bad, fore)
        forearms[:, hand], upper, worse = fore[rows, chosen], upper[rows, chosen], worse[rows, chosen]
        upper_arms[:, hand] = upper[rows, _steadiest(worse, upper)]
    return forearms, upper_arms


def _steadiest(costs: Doubles, ways: Doubles) -> Integers:
    """The choice (K,) among S directions (K, S, 3) of each frame whose costs (K, S) and turns are least."""
    total, origins = costs[0], list[Integers]()
    for before, after, cost in zip(ways[:-1], ways[1:], costs[1:], strict=True):
        moved = total + _STEADY * np.square(after[:, None] - before).sum(axis=2)
        origins.append(moved.argmin(axis=1))
        total = cost + moved.min(axis=1)
    chosen = [total.argmin()]
    for origin in reversed(origins):
        chosen.append(origin[chosen[-1]])
    return np.array(chosen[::-1])


def turning(ways: Float[np.ndarray, "K H 3"], step: int, num_frames: int) -> Float[np.ndarray, "T H 3"]:
    """Unit directions of all frames from those of every `step`-th: they turn evenly, and slowly at first."""
    from scipy.ndimage import uniform_filter1d

    share = np.arange(num_frames) / step
    first = np.minimum(share.astype(int), len(ways) - 1)
    after, part = ways[np.minimum(first + 1, len(ways) - 1)], (share - first)[:, None, None]
    mean = uniform_filter1d(ways[first] + part * (after - ways[first]), step, axis=0, mode="nearest")
    return np.asarray(mean / np.linalg.norm(mean, axis=-1, keepdims=True))


def bending_costs(forearms: Doubles, upper_arms: Doubles) -> Doubles:
    """Costs (...) of elbows between unit directions (..., 3) of forearms and upper arms."""
    angles = np.arccos(np.clip((forearms * upper_arms).sum(axis=-1), -1.0, 1.0))
    return np.asarray(3.0 * np.square(np.maximum(angles - _BENT[0], 0.0) / (_BENT[1] - _BENT[0])))


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
            hidden, start, end = 0.0, axes[one, arm, 0], axes[one, arm, 1]
            for camera in range(eyes.shape[1]):
                eye = eyes[one, camera]
                covers = _is_close(eye, start, end)
                for point in points[one]:
                    hidden += 1.0 if covers else _hidden(eye, point, start, end)
            costs[one, arm] = HIDING * hidden / points.shape[1]
    return costs


class SeenHands:
    """Keypoints of the hands of some frames, and what is before them."""

    def __init__(self, take: Take, frames: Integers) -> None:
        there = np.isfinite(take.qpos[frames]).all(axis=2)
        qpos = np.where(there[..., None], take.qpos[frames], np.eye(take.qpos.shape[2])[3])
        self.points: Doubles = np.empty((*there.shape, 21, 3))
        """Positions (F, H, 21, 3) [m]; NaN where a hand is absent."""
        self._flesh = []
        for number, hand in enumerate(take.hands):
            poses, capsules = np.ascontiguousarray(qpos[:, number]), hand.model.capsules
            self.points[:, number] = hand_keypoints(hand.model, poses)
            self._flesh.append((capsules.posed(hand.model.forward_kinematics(poses)), capsules.radii))
            self._flesh[number][0][~there[:, number]] = np.nan
        self.points[~there] = np.nan

    def most_hidden(self, axes: Float[np.ndarray, "F A 2 3"], eyes: Float[np.ndarray, "F C 3"]) -> Doubles:
        """Share (F, C) of a hand's keypoints that arms and the other hand hide, of the more hidden hand."""
        behind = np.zeros((*eyes.shape[:2], *self.points.shape[1:3]))
        for camera, eye in enumerate(np.swapaxes(eyes, 0, 1)[..., None, :]):
            for one, other in ((0, 1), (1, 0)) if len(self._flesh) == 2 else ():
                (axis, radii), lines = self._flesh[other], self.points[:, one] - eye
                free = free_rays(lines, np.zeros((1, 3)), axis - eye[:, None], radii)
                behind[:, camera, one] = ~free[..., 0]
        rows = np.repeat(np.arange(len(eyes)), eyes.shape[1])
        places = (
            axes[rows],
            eyes.reshape(-1, 3),
            self.points[rows],
            behind.reshape(len(rows), *behind.shape[2:]),
        )
        return np.asarray(most_hidden(*map(np.ascontiguousarray, places)).reshape(eyes.shape[:2]))


@kernel
def most_hidden(
    axes: Float[np.ndarray, "F A 2 3"],
    eyes: Float[np.ndarray, "F 3"],
    points: Float[np.ndarray, "F H P 3"],
    behind: Float[np.ndarray, "F H P"],
) -> Any:
    """Share (F,) of the points of a hand that arms hide, of the hand with the largest; NaN is no hand.

    Points `behind` something else (1) are hidden whatever the arms do.
    """
    most = np.zeros(len(eyes))
    for frame in range(len(eyes)):
        for hand in range(points.shape[1]):
            hidden = 0.0
            for number in range(points.shape[2]):
                point, covered = points[frame, hand, number], behind[frame, hand, number]
                for arm in range(axes.shape[1]):
                    start, end = axes[frame, arm, 0], axes[frame, arm, 1]
                    covers = 1.0 if _is_close(eyes[frame], start, end) else 0.0
                    covered = max(covered, covers, _hidden(eyes[frame], point, start, end))
                hidden += covered
            most[frame] = max(most[frame], hidden / points.shape[2])
    return most


@kernel
def _is_close(eye: Any, start: Any, end: Any) -> bool:
    """Whether an arm is so close to an eye that it hides all."""
    return bool(segment_distance_squared(eye, eye, start, end) < _CLEAR**2)


@kernel
def _hidden(eye: Any, point: Any, start: Any, end: Any) -> float:
    """How much, from 0 to 1, an arm hides a point from an eye that is not close to it."""
    away = np.sqrt(segment_distance_squared(eye, point, start, end))
    return min(1.0, (_OUTER - away) / (_OUTER - _INNER)) if away < _OUTER else 0.0


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
    elbows: Doubles, forearms: Doubles, ways: Doubles, axes: Doubles, cameras: Sequence[Sequence[Camera]]
) -> tuple[Doubles, Doubles]:
    """Upper arms (K, S, U, 3) [m] near these ways (K, S, 3), turned about `axes` (K, 3), and their costs."""
    ways, axis = ways / np.linalg.norm(ways, axis=-1, keepdims=True), axes[:, None]
    aside, tilt = np.cross(axis, ways)[:, :, None], np.array(_TILTS)[:, None, None] * axes[:, None, None]
    turns = np.cos(_TURNS)[:, None] * ways[:, :, None] + np.sin(_TURNS)[:, None] * aside
    tried = (turns[:, :, None] - tilt[:, None]).reshape(*turns.shape[:2], -1, 3)
    tried /= np.linalg.norm(tried, axis=-1, keepdims=True)
    bad = np.tile(np.abs(_TURNS), len(_TILTS)) / np.pi + np.repeat(_TILTS, len(_TURNS))
    bad = bad + bending_costs(forearms[:, :, None], tried)
    tried *= REACH
    for number, (ends, viewing) in enumerate(zip(elbows[:, :, None] + tried, cameras, strict=True)):
        for camera in viewing:
            with np.errstate(invalid="ignore"):
                pixels = camera.project(ends) / np.array(camera.size, dtype=np.float64)
            inside = (np.abs(pixels - 0.5) < 0.5 + _MARGIN).all(axis=-1)
            bad[number] += 10.0 * (inside & (camera.local(ends)[..., 2] > 0.0))
    return tried, bad


def _upper_axes(elbows: Doubles, upper_arms: Doubles) -> Doubles:
    """Axes (K, S U, 2, 3) of upper arms (K, S, U, 3) from elbows (K, S, 3) [m]."""
    starts, ends = np.broadcast_arrays(elbows[:, :, None], elbows[:, :, None] + upper_arms)
    return np.stack([starts, ends], axis=3).reshape(len(elbows), -1, 2, 3)
