"""Where cameras stand while a take goes by: still, in a ring, on a head, going round, or anywhere.

Paths are made once for a whole take, from the hands' own motion, so that any frame can be drawn alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from scipy.ndimage import uniform_filter1d

from handsim.errors import ArgumentError, choices
from handsim.space.cameras import load_rig, look_at
from handsim.space.transforms import quaternion_matrix
from render.cameras.camera import Camera, preset
from render.shown_take import ShownTake

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

Placement = Literal["still", "orbit", "head", "anywhere", "rig"]
PLACEMENTS: Final[tuple[Placement, ...]] = ("still", "orbit", "head", "anywhere", "rig")
_REACH: Final = 0.08  # [m] from the wrist to the middle of the hand
_EYES: Final = (0.32, 0.38)  # [m] of the head's camera behind and above the hands
_PAST: Final = np.deg2rad(50.0)  # between a head's line of sight and a forearm, at least
_SWAY: Final = 1.0  # [s] over which a head follows the hands
_TURN: Final = 12.0  # [s] of a camera that goes round once
_LOWEST, _HIGHEST = np.deg2rad(-20.0), np.deg2rad(75.0)  # elevation of cameras that stand anywhere
_TRIES: Final = 20
_ASIDE: Final = np.deg2rad(35.0)  # between their view and a forearm, at least


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """Cameras of a take.

    Raises:
        ArgumentError: There is no such placement, no camera, or the distances are none.
    """

    placement: Placement = "still"
    """`still`: in front of the hands. `orbit`: around them. `head`: where the user's eyes are. `anywhere`:
    another place in every frame. `rig`: where the cameras of a rig stand."""
    camera: str = "vga"
    """One of `render.cameras.camera.PRESETS`."""
    views: int = 1
    """How many cameras look at the hands at once; a rig has its own number."""
    distance: tuple[float, float] = (0.55, 0.9)
    """From the middle of the hands [m], drawn evenly."""
    rig: str = "six"
    """A shipped rig or a .toml file, for the placement `rig`."""

    def __post_init__(self) -> None:
        if self.placement not in PLACEMENTS:
            raise ArgumentError(choices(self.placement, PLACEMENTS, noun="placement"))
        if self.views < 1:
            raise ArgumentError(f"{self.views} views, expected at least 1")
        if not 0.05 <= self.distance[0] <= self.distance[1] <= 20.0:
            raise ArgumentError(
                f"distances are {self.distance}, expected two of 0.05 to 20 m, the shorter first"
            )


class Viewpoints:
    """Cameras of every frame.

    Args:
        config: Where they stand.
        take: What they look at.
        rng: Decides what is left open, once.
    """

    def __init__(self, config: ViewConfig, take: ShownTake, *, rng: np.random.Generator) -> None:
        self._camera = preset(config.camera)
        self._poses = _PATHS[config.placement](config, take, rng)

    def cameras(self, frame: int) -> list[Camera]:
        """The cameras of one frame: `view0`, `view1`, ..."""
        return [
            dataclasses.replace(self._camera, name=f"view{number}", T_world_camera=path[frame])
            for number, path in enumerate(self._poses)
        ]


def hand_centers(take: ShownTake) -> Float[np.ndarray, "T 3"]:
    """Middle of the hands that are there [m]; where there are none, straight from before to after."""
    middles = take.wrists()[..., :3] + _REACH * _along(take)
    there = np.isfinite(middles[..., :1])
    counts = there.sum(axis=1)
    centers = np.where(there, middles, 0.0).sum(axis=1) / np.maximum(counts, 1)
    known = np.flatnonzero(counts[:, 0])
    frames = np.arange(len(centers))
    return np.stack([np.interp(frames, known, centers[known, axis]) for axis in range(3)], axis=1)


def _along(take: ShownTake) -> NDArray[np.float64]:
    """Direction (T, H, 3) from each wrist to its fingers; NaN where there is no hand."""
    return quaternion_matrix(take.wrists()[..., 3:7])[..., 0]


def _towards_user(take: ShownTake) -> NDArray[np.float64]:
    """Level direction from the hands to the body that they belong to: where their forearms point."""
    level = np.append(np.nanmean(-_along(take)[..., :2].reshape(-1, 2), axis=0), 0.0)
    length = float(np.linalg.norm(level))
    return level / length if length > 1e-3 else np.array([0.0, -1.0, 0.0])


def _spherical(azimuth: float, elevation: float) -> NDArray[np.float64]:
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def _middle(take: ShownTake) -> NDArray[np.float64]:
    middle: NDArray[np.float64] = np.median(hand_centers(take), axis=0)
    return middle


def _still(config: ViewConfig, take: ShownTake, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """In front of the user, spread over a fan where there are several."""
    middle, user = _middle(take), _towards_user(take)
    front = np.arctan2(-user[1], -user[0])
    spread = np.deg2rad(40.0) * (np.arange(config.views) - 0.5 * (config.views - 1))
    paths = []
    for turn in spread:
        direction = _spherical(front + turn + rng.uniform(-0.15, 0.15), rng.uniform(0.1, 0.6))
        pose = look_at(middle + rng.uniform(*config.distance) * direction, middle)
        paths.append(np.broadcast_to(pose, (take.num_frames, 4, 4)))
    return paths


def _orbit(config: ViewConfig, take: ShownTake, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    middle, paths = _middle(take), []
    for number in range(config.views):
        start = rng.uniform(-np.pi, np.pi) + 2.0 * np.pi * number / config.views
        elevation, distance = rng.uniform(0.0, 0.8), rng.uniform(*config.distance)
        turns = start + 2.0 * np.pi * (take.times - take.times[0]) / _TURN
        places = [middle + distance * _spherical(turn, elevation) for turn in turns]
        paths.append(np.array([look_at(place, middle) for place in places]))
    return paths


def _head(config: ViewConfig, take: ShownTake, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Where the eyes are, following the hands a little late; several look from side by side, as two eyes."""
    centers = uniform_filter1d(hand_centers(take), max(1, round(_SWAY * take.rate)), axis=0, mode="nearest")
    user = _towards_user(take)
    back, up = _EYES[0] + rng.uniform(-0.05, 0.05), _EYES[1] + rng.uniform(-0.05, 0.05)
    direction = _past_forearms(take, back * user + [0.0, 0.0, up])
    aside = np.cross(user, [0.0, 0.0, 1.0])
    paths = []
    for number in range(config.views):
        eyes = centers + direction
        eyes += 0.064 * (number - 0.5 * (config.views - 1)) * aside
        paths.append(np.array([look_at(eye, center) for eye, center in zip(eyes, centers, strict=True)]))
    return paths


def _past_forearms(take: ShownTake, offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same way from the hands, turned aside until no forearm usually lies in the line of sight."""
    length = float(np.linalg.norm(offset))
    direction = offset / length
    medians = np.nanmedian(-_along(take), axis=0)
    medians /= np.linalg.norm(medians, axis=1, keepdims=True)
    for arm in [*medians] * 2:  # past one may be into the other
        if direction @ arm > np.cos(_PAST):
            across = direction - (direction @ arm) * arm
            if np.linalg.norm(across) < 1e-3:
                across = np.cross(arm, [1.0, 0.0, 0.0])
            direction = np.cos(_PAST) * arm + np.sin(_PAST) * across / np.linalg.norm(across)
    return length * direction


def _anywhere(config: ViewConfig, take: ShownTake, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    centers, paths = hand_centers(take), []
    for _ in range(config.views):
        places = np.empty_like(centers)
        left = np.arange(take.num_frames)
        for _ in range(_TRIES):
            turns = rng.uniform(-np.pi, np.pi, len(left))
            rise = np.arcsin(rng.uniform(np.sin(_LOWEST), np.sin(_HIGHEST), len(left)))
            distance = rng.uniform(*config.distance, len(left))
            directions = [_spherical(*one) for one in zip(turns, rise, strict=True)]
            places[left] = centers[left] + distance[:, None] * np.array(directions)
            left = left[_behind_arms(take, places)[left]]
            if not len(left):
                break
        paths.append(np.array([look_at(*pair) for pair in zip(places, centers, strict=True)]))
    return paths


def _behind_arms(take: ShownTake, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each frame's place is where a forearm points, so that little but the arm would be seen."""
    away = places[:, None] - take.wrists()[..., :3]
    cosines = -(away * _along(take)).sum(axis=-1) / np.linalg.norm(away, axis=-1)
    behind: NDArray[np.bool_] = (cosines > np.cos(_ASIDE)).any(axis=1)
    return behind  # NaN, where there is no hand, never is


def _rig(config: ViewConfig, take: ShownTake, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    poses = load_rig(config.rig).T_world_camera
    return [np.broadcast_to(pose, (take.num_frames, 4, 4)) for pose in poses]


_PATHS: Final = {"still": _still, "orbit": _orbit, "head": _head, "anywhere": _anywhere, "rig": _rig}
