"""The motion in a take, simulated or tracked, as all motion files are written from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gloves.takes.archives import archive_kind
from gloves.takes.take import KIND, Take, load_take
from gloves.takes.tracked_take import TrackedTake, load_tracked_take
from handsim.errors import CaptureError
from handsim.motion_files.hands_in_motion import HandsInMotion, MovingHand, MovingThing, UpAxis
from handsim.space.objects import named_object, object_names
from handsim.space.transforms import pose_matrices


def load_motion(path: Path, *, up: UpAxis = "z") -> HandsInMotion:
    """The motion of a take's file.

    Args:
        path: A tracked take, or the truth of a simulated one.
        up: The axis of its world that points up.

    Raises:
        CaptureError: The file is missing, of another kind or schema, damaged, or without any pose.
    """
    take = load_any_take(path)
    if isinstance(take, Take):
        models, qpos = (
            [hand.fit.model for hand in take.hands],
            np.stack([hand.qpos for hand in take.hands], 1),
        )
        times = np.arange(take.num_frames) / take.rate
        things = [] if take.body is None else [_thing(take.body.name, take.body.T_world_body)]
    else:
        models, qpos, times = [hand.model for hand in take.hands], take.qpos, take.times
        things = [
            _thing(body.name, pose_matrices(take.body_poses[:, index]))
            for index, body in enumerate(take.bodies)
        ]
    hands = tuple(MovingHand(model, qpos[:, index]) for index, model in enumerate(models))
    hands = tuple(hand for hand in hands if hand.present.any())
    if not hands:
        raise CaptureError(f"{path}: there is no hand in any frame, expected one to export")
    seen = tuple(thing for thing in things if thing.present.any())
    return HandsInMotion(take.rate, times, hands, seen, up)


def load_any_take(path: Path) -> Take | TrackedTake:
    """A tracked take, or the truth of a simulated one.

    Raises:
        CaptureError: The file is missing, of another kind or schema, or damaged.
    """
    return load_take(path) if archive_kind(path) == KIND else load_tracked_take(path)


def _thing(name: str, poses: NDArray[np.float64]) -> MovingThing:
    return MovingThing(name, named_object(name) if name in object_names() else None, poses)
