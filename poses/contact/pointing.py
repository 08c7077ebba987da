"""Paths of a pen that points at one marker after another of the other hand (Han et al. 2018, hand-pen)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from poses.motion.paths import PEAK_SPEED, minimum_jerk

DISTANCE: Final = (0.006, 0.02)
"""Smallest and largest distance of the tip from its target [m]."""
SPEED: Final = 0.6
"""Highest speed of the tip between still targets, without the retreat [m/s]; slow paths take longer."""
TURNING: Final = 3.0
"""The same for the rotation of the pen [rad/s]."""
RETREAT: Final = 0.05
"""Distance that the tip draws back between two targets [m]."""
_STAY: Final = (0.15, 0.6)  # shortest and longest time at a target [s]
PATH: Final = (0.4, 0.9)
"""Shortest and longest time from target to target [s]."""
_TILT: Final = 0.6  # lean of the pen from the outward direction, standard deviation of the tangent
_UPRIGHT: Final = np.array([0.36, -0.26, 0.9]) / np.linalg.norm([0.36, -0.26, 0.9])
"""Direction of a pen in the right hand of a person at -y, over a palm that faces down."""
_ARM: Final = np.array([0.8, -0.6, 0.0])  # where the writing arm comes from
_CONE: Final = 1.2  # farthest that the pen leans from upright [rad]
_MOST_LEAN: Final = 1.0  # as a tangent
_BEHIND: Final = -0.2  # targets that face away from the pen by more, as a cosine, are not pointed at
_STEADY: Final = 0.15  # [s] over which outward directions are smoothed, standard deviation


def pointing_path(
    positions: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    *,
    speed: float = SPEED,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4 4"]:
    """Poses of a pen, its tip at the origin and its body along +z, that visits moving targets at random.

    Args:
        positions: Possible targets, moving in the world [m].
        outward: Unit directions from which each can be reached.
        speed: Highest speed of the tip [m/s], see `SPEED`.
    """
    outward = gaussian_filter1d(outward, _STEADY * rate, axis=0, mode="nearest")
    outward = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    visits = _plan(positions, outward, rate, speed, rng)
    share = np.concatenate([visit.share for visit in visits])
    number = np.repeat(np.arange(len(visits)), [len(visit.share) for visit in visits])
    now = np.arange(len(positions))
    share, number = share[now], number[now]

    def at(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        target = np.array([visit.target for visit in visits])[which]
        lean = np.stack([visit.lean for visit in visits])[which]
        distance = np.array([visit.distance for visit in visits])[which]
        axis = _axes(outward[now, target], lean)
        return positions[now, target] + distance[:, None] * axis, axis

    (here, axis_here), (there, axis_there) = at(number), at(number + 1)
    blend = share[:, None]
    axis = _between(axis_here, axis_there, blend)
    lift = RETREAT * np.sin(np.pi * blend) ** 2
    return _frames((1.0 - blend) * here + blend * there + lift * axis, axis)


@dataclass(frozen=True, slots=True)
class _Visit:
    """One target, and the path from it to the next."""

    target: int
    distance: float
    lean: Float[np.ndarray, "3"]
    share: Float[np.ndarray, "S"]
    """Share of the path after each frame."""


def _plan(
    positions: Float[np.ndarray, "T M 3"],
    outward: Float[np.ndarray, "T M 3"],
    rate: float,
    speed: float,
    rng: np.random.Generator,
) -> list[_Visit]:
    """Visits for all frames, and one more where the last path leads."""
    visits: list[_Visit] = []
    frame = 0
    target, lean = _draw(outward[0], rng)
    while frame < len(positions):
        here, axis = positions[frame], _axes(outward[frame, target], lean)
        following, next_lean = _draw(outward[frame], rng)
        next_axis = _axes(outward[frame, following], next_lean)
        turn = float(np.arccos(np.clip(axis @ next_axis, -1.0, 1.0)))
        seconds = max(
            rng.uniform(*PATH),
            PEAK_SPEED * float(np.linalg.norm(here[following] - here[target])) / speed,
            PEAK_SPEED * turn / TURNING,
        )
        stay = np.zeros(max(1, round(rng.uniform(*_STAY) * rate)))
        share = np.concatenate([stay, minimum_jerk(max(2, int(np.ceil(seconds * rate))))])
        visits.append(_Visit(target, rng.uniform(*DISTANCE), lean, share))
        frame, target, lean = frame + len(share), following, next_lean
    return [*visits, _Visit(target, rng.uniform(*DISTANCE), lean, np.zeros(0))]


def _draw(outward: Float[np.ndarray, "M 3"], rng: np.random.Generator) -> tuple[int, Float[np.ndarray, "3"]]:
    """A target that can be reached now, and the lean of the pen there."""
    open_to_pen = np.flatnonzero(outward @ _UPRIGHT > _BEHIND)
    target = int(rng.choice(open_to_pen if len(open_to_pen) else len(outward)))
    lean = _TILT * rng.standard_normal(3)
    lean -= (lean @ outward[target]) * outward[
        target
    ]  # sideways, or a rotation of the target would swing the pen
    return target, lean * min(1.0, _MOST_LEAN / max(float(np.linalg.norm(lean)), 1e-9))


def _axes(outward: Float[np.ndarray, "*T 3"], lean: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T 3"]:
    """Directions of the pen at targets: off the skin, and never far from upright, smoothly in both."""
    axis = outward + lean
    facing = np.einsum("...i,...i->...", axis, outward)[..., None]
    axis = axis + np.clip(0.5 - facing, 0.0, None) * outward
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    upright = np.broadcast_to(_UPRIGHT, axis.shape)
    angle = np.arccos(np.clip(axis @ _UPRIGHT, -1.0, 1.0))[..., None]
    return _between(upright, axis, _CONE * np.tanh(angle / _CONE) / np.maximum(angle, 1e-9))


def _between(
    start: Float[np.ndarray, "*T 3"], end: Float[np.ndarray, "*T 3"], share: Float[np.ndarray, "*T 1"]
) -> Float[np.ndarray, "*T 3"]:
    """Directions after a share of the shortest rotation from one to another."""
    angle = np.arccos(np.clip(np.einsum("...i,...i->...", start, end), -1.0, 1.0))[..., None]
    mixed = np.sin((1.0 - share) * angle) * start + np.sin(share * angle) * end
    mixed = np.where(angle > 1e-6, mixed, start)
    between: np.ndarray = mixed / np.maximum(np.linalg.norm(mixed, axis=-1, keepdims=True), 1e-12)
    return between


def _frames(origin: Float[np.ndarray, "T 3"], axis: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with +z along `axis`, by the shortest rotation from upright, where +x points to the arm."""
    x = _ARM - (_ARM @ _UPRIGHT) * _UPRIGHT
    x /= np.linalg.norm(x)
    # The shortest rotation from u to a moves v to v - (v . (u + a)) / (1 + u . a) (u + a) + 2 (v . u) a.
    middle = axis + _UPRIGHT
    x = x - (middle @ x / (1.0 + axis @ _UPRIGHT))[:, None] * middle
    pose = np.tile(np.eye(4), (len(origin), 1, 1))
    pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = x, np.cross(axis, x), axis
    pose[:, :3, 3] = origin
    return pose
