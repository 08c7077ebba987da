"""A layout tried: short simulated captures of people in the glove, labeled and tracked as users' are.

Nothing is calibrated: the size of the hands is measured in each capture, as `handsim label` and `handsim
track` do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim.errors import HandSimWarning
from handsim.hand.topology import Side
from handsim.space.cameras import CameraRig
from track.capture_labeling import label_capture
from track.capture_tracking import track_capture
from train.evaluation.metrics import LabelCounts
from train.labelers.protocol import Labeler
from train.simulation.room_settings import SimulatedKind
from train.simulation.takes import simulate_take

FRAMES: Final = 360
"""Frames of a capture: three seconds."""
SEEDS: Final = (1, 2)
"""Other people and motions, the same for every layout."""


@dataclass(frozen=True, slots=True)
class Work:
    """What hands do in a capture."""

    kind: SimulatedKind
    sides: tuple[Side, ...]


WORK: Final[Mapping[str, Work]] = {
    "one hand": Work("single-hand", ("right",)),
    "two apart": Work("single-hand", ("right", "left")),
    "two touching": Work("hand-hand", ("right", "left")),
}


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What became of one capture."""

    slots: dict[str, Float[np.ndarray, "M"]]
    """Share of the frames in which each marker's slot is right, by `label` and `track`."""
    frames: dict[str, float]
    """Share of the frames without any error, by both."""
    joints: Float[np.ndarray, "20"]
    """Root mean square error of each joint that `track` gives [rad]; NaN if no hand was found."""
    length: float
    """True length of the hands [m]."""
    measured: float
    """As `track` measured it [m]."""
    notes: str
    """The size as `track` tells it."""


def try_layout(
    layout: MarkerLayout,
    rig: CameraRig | str,
    labeler: Labeler,
    *,
    work: Sequence[str] = tuple(WORK),
    seeds: Sequence[int] = SEEDS,
    frames: int = FRAMES,
    told: Callable[[str], None] = lambda words: None,
) -> dict[str, list[Trial]]:
    """Label and track simulated captures of each kind of work that the glove is for.

    Args:
        layout: The glove.
        rig: The cameras.
        labeler: A labeler of the glove.
        work: Kinds of work, of `WORK`.
        seeds: A capture each.
        frames: Of each capture.
        told: Called before each capture with what it is.
    """
    found: dict[str, list[Trial]] = {}
    for name in work:
        sides = tuple(side for side in WORK[name].sides if side in layout.sides)
        if len(sides) < len(WORK[name].sides) and name != "one hand":
            continue
        for number, seed in enumerate(seeds, 1):
            told(f"{name}, capture {number} of {len(seeds)}")
            take = simulate_take(
                WORK[name].kind, glove=layout, num_frames=frames, rig=rig, seed=seed,
                hands=sides or layout.sides,
            )  # fmt: skip
            found.setdefault(name, []).append(try_take(take, labeler))
    return found


def try_take(truth: Take, labeler: Labeler) -> Trial:
    """Label and track the points of a simulated capture whose hands are not known."""
    layout = truth.hands[0].layout
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)
        tracked = track_capture(truth.capture(), layout, labeler=labeler, hands=layout.sides)
        labeled = label_capture(truth.capture(), layout, labeler=labeler)
    slots, frames = {}, {}
    for name, take in (("label", labeled), ("track", tracked)):
        slots[name], frames[name] = _rights(truth, take)
    errors = [
        (tracked.qpos[:, tracked.hand(hand.side), 7:] - truth.qpos[:, number, 7:]) ** 2
        for number, hand in enumerate(truth.hands)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of joints without any pose
        joints = np.sqrt(np.nanmean(np.concatenate(errors), axis=0))
    lengths = [take.hands[0].shape.length for take in (truth, tracked)]
    return Trial(slots, frames, joints, *lengths, str(tracked.settings["user"]))


def _rights(truth: Take, take: Take) -> tuple[Float[np.ndarray, "M"], float]:
    """Share of the frames in which each marker's slots are right, of hands that are there; and of frames."""
    markers = truth.hands[0].layout.num_markers
    of_hands = [truth.label_names.index(name) if name in truth.label_names else -1
                for name in take.label_names]  # fmt: skip
    others = len(truth.hands) * markers  # labels of hands that are not there
    known = np.array([number if 0 <= number < others else others for number in of_hands] + [-1])
    counts, right = LabelCounts(), np.zeros(others)
    for points, true, given in zip(truth.points, truth.labels, take.labels, strict=True):
        here = np.isfinite(points[:, 0])
        worn = np.where(true[here] < others, true[here], -1)
        right += counts.add(known[given[here]], worn, others + 1)[:others]
    share: Float[np.ndarray, "M"] = (right / counts.frames).reshape(len(truth.hands), markers).mean(axis=0)
    return share, counts.frames_right / counts.frames
