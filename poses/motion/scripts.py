"""Motions that follow a script of `data/scripts.json`: spelling, counting, touching, typing."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import ArgumentError, PoseError, choices
from handsim.files.json_files import package_data
from handsim.hand.model import HandModel, load_model
from handsim.hand.motion import HandMotion
from handsim.hand.shape import NUM_JOINTS, HandShape
from poses.motion.motions import angles_through, count_frames, sample_motion, with_wrist
from poses.motion.paths import MotionConfig, can_be_left
from poses.shapes.library import gesture, gestures_of
from poses.shapes.touch import touching_angles
from poses.shapes.validity import make_valid

FREE: Final = "free"
"""The name of a motion without a script: what `sample_motion` makes."""
_POSES_AT_ONCE: Final = 16


def _scripts() -> dict[str, dict[str, Any]]:
    scripts: dict[str, dict[str, Any]] = package_data("poses", "scripts")["scripts"]
    return scripts


def script_names() -> tuple[str, ...]:
    """Names of all scripts."""
    return tuple(_scripts())


def scripted_motion(
    model: HandModel | HandShape | str,
    script: str,
    duration: float,
    config: MotionConfig | None = None,
    *,
    rng: np.random.Generator,
) -> HandMotion:
    """Smooth motion of one hand that follows a named script, valid at every frame.

    Args:
        model: The hand; a shape or the name of a size is a right one.
        script: One of `script_names`.
        duration: How long [s]; the motion has `round(duration * rate) + 1` frames.
        config: Speeds and positions; human ones by default. Except for "free",
            `durations` and `hold` are those of the script.

    Raises:
        ArgumentError: There is no such script, or the duration is not positive or less than a step.
        PoseError: This hand cannot do what the script asks for.
    """
    model = load_model(model)
    check_choice(script, _scripts(), noun="script")
    if script == FREE:
        return sample_motion(model, duration, config, rng=rng)
    entry = _scripts()[script]
    config = dataclasses.replace(
        config or MotionConfig(), durations=tuple(entry["durations"]), hold=entry["hold"]
    )
    frames = count_frames(duration, config)
    poses = script_poses(model, script)
    at = int(rng.integers(len(poses)))
    parts, count = [poses[at : at + 1]], 1
    while count < frames:
        indices = _next_indices(at, len(poses), entry["order"], rng)
        parts.append(angles_through(model, poses[indices], config, rng=rng))
        count, at = count + len(parts[-1]), int(indices[-1])
    return with_wrist(np.concatenate(parts)[:frames], config, rng=rng)


def script_poses(model: HandModel, script: str) -> Float[np.ndarray, "K 20"]:
    """The poses [rad] a script goes through, as this hand can strike them.

    Touches that this hand's thumb cannot reach and poses without a valid path to rest are left out.
    """
    if script not in _scripts() or script == FREE:
        raise ArgumentError(choices(script, [name for name in _scripts() if name != FREE], noun="script"))
    entry = _scripts()[script]
    if "touches" in entry:
        poses = _touches(model, entry["touches"])
    elif "library" in entry:
        poses = make_valid(model, gestures_of(entry["library"]))
    else:
        poses = make_valid(model, np.stack([gesture(name) for name in entry["gestures"]]))
    poses = poses[np.flatnonzero(can_be_left(model, poses))]
    if len(poses) < 2:
        raise PoseError(f"this hand can strike {len(poses)} poses of '{script}', expected at least 2")
    return poses


def _touches(model: HandModel, fingers: list[str]) -> NDArray[np.float64]:
    poses: list[NDArray[np.float64]] = []
    for finger in fingers:
        with contextlib.suppress(PoseError):  # other fingers remain
            poses.append(touching_angles(model, finger))
    return np.array(poses).reshape(-1, NUM_JOINTS)


def _next_indices(at: int, count: int, order: str, rng: np.random.Generator) -> Int[np.ndarray, "N"]:
    """Indices of the next poses, the present one first."""
    if order == "in turn":
        steps = np.ones(_POSES_AT_ONCE, dtype=np.int64)
    else:
        steps = rng.integers(1, count, size=_POSES_AT_ONCE)
    return (at + np.concatenate([[0], np.cumsum(steps)])) % count
