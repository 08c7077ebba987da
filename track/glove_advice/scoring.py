"""How well a layout can be labeled and what it tells of each joint, before anybody wears it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import numpy as np

from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import check_count, check_type
from handsim.callbacks import OnStep, no_step
from handsim.errors import ArgumentError
from handsim.space.rig import CameraRig, as_rig
from track.glove_advice.advice import advice
from track.glove_advice.layout_score import LayoutScore, score_layout
from track.glove_advice.observed_hands import ObservedHand, observe_motion, observe_poses
from track.glove_advice.trials import CAPTURES, try_layout
from track.user import AnyGlove, AnyLabeler
from train.labelers.layout_labeler import learned_labeler
from train.labelers.storage import load_labeler
from train.simulation.takes import simulate_take

_POSES: Final = "poses"
_TWINS: Final = "twins"
_FEWEST_FRAMES: Final = 100
_TWIN_FRAMES: Final = 600  # of each kind of capture that is simulated


def score_glove(
    glove: AnyGlove,
    rig: CameraRig | str | Path = "figure5",
    *,
    motion: Take | str | Path = _POSES,
    labeler: AnyLabeler = None,
    num_frames: int = 1500,
    captures: int = CAPTURES,
    seed: int = 0,
    on_step: OnStep = no_step,
) -> LayoutScore:
    """Score a layout as `handsim glove score` does; nothing is trained.

    Args:
        glove: Marker layout, or its shipped name or the path of its .toml file.
        rig: The cameras, or the name or path of a rig.
        motion: What hands do: `poses` (random people and poses), `twins` (simulated motion of one hand and of
            two), or a take or the path of one (.npz).
        labeler: A labeler trained on the layout, or what `load_labeler` reads; the network for any layout
            when not given.
        num_frames: Frames of hands, of a take those of each hand.
        captures: Simulated captures of each kind of work that are labeled and tracked with nothing
            calibrated, of different people; 0 for none.
        seed: Seed of people, poses and cameras' losses; captures have their own.
        on_step: Called with the name of each step.

    Returns:
        Shares of labels that are right, standard deviations of joints [rad], what became of the captures, and
        advice in sentences.

    Raises:
        ArgumentError: A number is out of range, or `motion` is something else.
        CaptureError: The take cannot be read, or its hands are never there together.
        LayoutError, RigError, WeightsError: The glove, the rig or the labeler is unknown.
    """
    layout, cameras = load_layout(glove), as_rig(rig)
    check_count("num_frames", num_frames, _FEWEST_FRAMES)
    check_count("captures", captures, 0)
    check_count("seed", seed, 0)
    rng = np.random.default_rng(seed)
    on_step("simulating hands")
    hands, seen = _hands(motion, layout, cameras, num_frames, seed, rng)
    on_step("learning the layout, about a minute the first time")
    known = learned_labeler(layout, cameras) if labeler is None else load_labeler(layout, labeler)
    on_step("labeling")
    score = score_layout(layout, hands, known, rng=rng)
    trials = try_layout(
        layout, cameras, known, count=captures, told=lambda words: on_step(f"trying captures: {words}")
    )
    score = dataclasses.replace(
        score, trials=trials, is_trained=labeler is not None, seen_by=f"{seen}, seen by rig {cameras.name}"
    )
    return dataclasses.replace(score, advice=tuple(advice(score)))


def _hands(
    motion: Take | str | Path,
    layout: MarkerLayout,
    rig: CameraRig,
    frames: int,
    seed: int,
    rng: np.random.Generator,
) -> tuple[list[ObservedHand], str]:
    """Hands in the motion that was asked for, and its name."""
    check_type("motion", motion, (Take, str, Path), "a Take, or the path of one", (_POSES, _TWINS))
    if motion == _POSES:
        return observe_poses(layout, rig, frames, rng=rng), "random people and poses"
    if motion == _TWINS:
        hands = []
        for kind in ("single-hand", "hand-hand", "hand-pen"):
            take = simulate_take(kind, num_frames=_TWIN_FRAMES, seed=seed)
            hands += observe_motion(take, layout, rig, frames // 6, rng=rng)
        return hands, "simulated motion of one hand and of two"
    if isinstance(motion, Take):
        return observe_motion(motion, layout, rig, frames, rng=rng), "a take"
    if not str(motion).endswith(".npz"):
        raise ArgumentError(f"motion is '{motion}', expected {_POSES}, {_TWINS} or a take (.npz)")
    return observe_motion(load_take(motion), layout, rig, frames, rng=rng), f"the take {Path(motion).name}"
