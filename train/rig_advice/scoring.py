"""What a rig will miss of hands at work, before anything is recorded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import check_count, check_type
from handsim.callbacks import OnStep, no_step
from handsim.space.rig import ROOM_CENTER, CameraRig, as_rig
from train.rig_advice.rig_score import RigScore, score_work
from train.rig_advice.work import GLOVE, VOLUME, checked_center, checked_sides, sample_work, work_of_take
from train.simulation.scenes import SceneMotion

_PEOPLE: Final = 2  # of each kind of work
_FEWEST_FRAMES: Final = 60


def score_rig(
    rig: CameraRig | str | Path,
    *,
    volume: Sequence[float] = VOLUME,
    center: Sequence[float] | None = None,
    take: Take | str | Path | None = None,
    glove: MarkerLayout | str | Path | None = None,
    num_frames: int = 900,
    seed: int = 0,
    on_step: OnStep = no_step,
) -> RigScore:
    """Score a rig as `handsim rig score` does; nothing is recorded.

    Args:
        rig: The cameras, or the name or path of a rig.
        volume: Sides of the space that hands work in (3,) [m].
        center: Its middle (3,) [m]; (0, 0, 1.1) when not given, or where the hands of the take are.
        take: A take, or the path of one (.npz), whose hands work where they are; simulated people when not
            given.
        glove: Marker layout, or its shipped name or the path of its .toml file; dense19 or that of the take
            when not given.
        num_frames: Frames of every person and kind of work, or of the take.
        seed: Seed of people, motion and cameras' losses.
        on_step: Called with the name of each step.

    Returns:
        Forecasts of all work, of each kind and without each camera, a map of the volume, and advice in
        sentences.

    Raises:
        ArgumentError: A number is out of range, or a camera stands in the hands.
        CaptureError: The take cannot be read, or its hands are never there together.
        LayoutError, RigError: The glove or the rig is unknown.
    """
    cameras = as_rig(rig)
    check_count("num_frames", num_frames, _FEWEST_FRAMES)
    check_count("seed", seed, 0)
    sides = checked_sides("volume", volume)
    middle = None if center is None else checked_center(center)
    on_step("simulating hands")
    if take is None:
        middle = np.array(ROOM_CENTER) if middle is None else middle
        layout = load_layout(GLOVE if glove is None else glove)
        work = sample_work(layout, middle, sides, num_frames, _PEOPLE, rng=np.random.default_rng(seed))
        told = f"simulated people in the glove {layout.name}"
    else:
        check_type("take", take, (Take, str, Path), "a Take, or the path of one")
        told = "a take" if isinstance(take, Take) else f"the take {Path(take).name}"
        given = take if isinstance(take, Take) else load_take(take)
        work = work_of_take(given, None if glove is None else load_layout(glove), num_frames)
        middle = _middle(work.values()) if middle is None else middle
    on_step("forecasting")
    return score_work(cameras, work, middle, sides, told=told, seed=seed)


def _middle(work: Iterable[Sequence[SceneMotion]]) -> NDArray[np.float64]:
    """The middle of where hands are (3,) [m]."""
    wrists = [hand.qpos[:, :3] for scenes in work for one in scenes for hand in one.hands]
    middle: NDArray[np.float64] = np.concatenate(wrists).mean(axis=0)
    return middle
