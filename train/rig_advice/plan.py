"""A planned rig, and what it makes of hands that the plan did not see."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from handsim.space.camera import Camera
from handsim.space.cameras import CameraRig
from train.rig_advice.forecast import Forecast, forecast, light_work
from train.rig_advice.mounts import Mount, places
from train.rig_advice.planning import Planning, view_candidates
from train.rig_advice.work import sample_work
from train.simulation.motion import SceneMotion

_PEOPLE: Final = 3  # of each kind of work
_FRAMES: Final = 900  # of each
_SKIPPED: Final = 12  # every so many frames count
_JUDGED: Final = 600  # frames of a person that the plan did not see


class Plan(NamedTuple):
    """A rig, and the forecast of it."""

    rig: CameraRig
    targets: Float[np.ndarray, "C 3"]
    """What each camera looks at [m]; of cameras that were kept a point one meter ahead."""
    before: Forecast | None
    """Of the cameras that were kept alone."""
    after: Forecast


def plan(
    num_cameras: int,
    room: Float[np.ndarray, "3"],
    mounts: Sequence[Mount],
    layout: MarkerLayout,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    camera: Camera,
    kept: CameraRig | None = None,
    *,
    name: str,
    told: Callable[[str], None] = lambda line: None,
    seed: int = 0,
) -> Plan:
    """Look for the best places of cameras.

    Args:
        num_cameras: Cameras of the rig, with those that are kept.
        room: Width, depth and height of the room or truss [m].
        mounts: What cameras can hang on.
        layout: The glove.
        center: Middle of the volume that hands work in [m].
        sides: Its sides [m].
        camera: What every new camera is, but for its pose.
        kept: Cameras that stay.
        name: Of the rig.
        told: Called with what is going on.
        seed: Of people and motion.

    Raises:
        ArgumentError: There is no room for so many cameras.
    """
    free = places(room, mounts, center, sides)
    old = () if kept is None else tuple(kept.cameras)
    candidates = [*old, *(camera.at(pose) for pose in free.T_world_camera)]
    ahead = [one.T_world_camera[:3, 3] + one.T_world_camera[:3, 2] for one in old]
    targets = np.array([*ahead, *free.targets])
    rng = np.random.default_rng(seed)
    work = sample_work(layout, center, sides, _FRAMES, _PEOPLE, rng=rng)
    scenes = [one.faster(_SKIPPED) for part in work.values() for one in part]
    told(f"what cameras at {len(free.targets)} places would see")
    views = view_candidates(scenes, candidates, rng=rng)
    positions = np.stack([one.T_world_camera[:3, 3] for one in candidates])
    search = Planning(views, positions, range(len(old)))
    search.grow(num_cameras)
    search.exchange(lambda value: told(f"moving cameras: {value:.4f}"))
    chosen = [candidates[number] for number in search.chosen]
    new = [
        dataclasses.replace(one, name=f"camera{number}")
        for number, one in enumerate(chosen[len(old) :], len(old) + 1)
    ]
    rig = CameraRig(name, [*old, *new])
    told("forecasting")
    fresh = sample_work(layout, center, sides, _JUDGED, 1, rng=np.random.default_rng(seed + 1))
    before = None if kept is None else _forecast(fresh, kept, seed)
    return Plan(rig, targets[search.chosen], before, _forecast(fresh, rig, seed))


def _forecast(work: Mapping[str, Sequence[SceneMotion]], rig: CameraRig, seed: int) -> Forecast:
    lit = light_work(work, rig, rng=np.random.default_rng(seed))
    return forecast([one for scenes in lit.values() for one in scenes], rig, seed=seed)
