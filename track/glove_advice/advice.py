"""What to do with a layout, in sentences: move this, add that, drop this; the most useful first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from handsim.hand.shape import BONE_NAMES, BONES, DIGITS, JOINTS
from track.glove_advice.joint_spread import untold_spreads
from track.glove_advice.layout_score import LayoutScore
from track.glove_advice.trials import METHODS
from train.reports.hand_plot import mistakes

UNTOLD: Final = 0.6
"""Share of a joint's usual spread from which on the markers are said to tell nothing of it."""
_UNCERTAIN: Final = np.deg2rad(5.0)  # a joint that is known better needs no marker
_CONFUSED: Final = 0.02  # share of a marker's points that are taken for another's
_HIDDEN: Final = 0.85  # share of frames in which a marker should be seen
_TOUCHING: Final = 0.02  # share of frames
_WRONG: Final = 0.97  # share of frames in which a marker of a capture should be right
_SIDES: Final = 0.99  # share of frames whose side should be right
_DISPENSABLE: Final = np.deg2rad(0.3)  # by which no joint's spread grows without a marker
_MOST_OF_A_KIND: Final = 4


class Advice(NamedTuple):
    """A sentence, and how much it matters."""

    weight: float
    """Share of points, frames or joints that it is about."""
    sentence: str


def advice(score: LayoutScore) -> list[str]:
    """Sentences about a layout, the most important first."""
    kinds = (_captures, _confusions, _untold_joints, _hidden, _touching, _sides, _dispensable)
    found = [
        one for kind in kinds for one in sorted(kind(score), key=lambda item: -item.weight)[:_MOST_OF_A_KIND]
    ]
    return [one.sentence for one in sorted(found, key=lambda item: -item.weight)]


def _captures(score: LayoutScore) -> Iterator[Advice]:
    """The worst marker of the captures that were tried."""
    for work, trial in score.trials.items():
        shares = {method: float(trial.slots[method][trial.worst]) for method in METHODS}
        if min(shares.values()) < _WRONG:
            told = ", ".join(f"{100 * share:.0f} % with {method}" for method, share in shares.items())
            yield Advice(
                1.0 - min(shares.values()),
                f"With {work} {score.layout.names[trial.worst]} is labeled worst: right in {told}. Give it "
                "a marker next to it on the same digit, or other distances to the markers of the palm.",
            )


def _digit(bone: str) -> int:
    return BONES[BONE_NAMES.index(bone)].digit


def _confusions(score: LayoutScore) -> Iterator[Advice]:
    names, told = score.layout.names, set()
    for mistake in mistakes(score.observed.confusion, most=2 * _MOST_OF_A_KIND):
        pair = frozenset((mistake.truth, mistake.called))
        if mistake.share < _CONFUSED or pair in told:
            continue
        told.add(pair)
        first, second = names[mistake.truth], names[mistake.called]
        yield Advice(
            mistake.share,
            f"Move {first} or {second}, so that their distances to the others differ: "
            f"{100 * mistake.share:.0f} % of the points of {first} are taken for {second}.",
        )


def _untold_joints(score: LayoutScore) -> Iterator[Advice]:
    """A digit of whose joints some are hardly told of, and the bone that lacks a marker."""
    share = score.joints / untold_spreads()
    carried = {marker.bone for marker in score.layout.markers}
    for digit, name in enumerate(DIGITS):
        joints = [number for number, joint in enumerate(JOINTS) if BONES[joint.bone].digit == digit]
        untold = [number for number in joints if share[number] > UNTOLD and score.joints[number] > _UNCERTAIN]
        if not untold:
            continue
        bones = [BONES[JOINTS[number].bone].name for number in untold]
        whole = [BONES[JOINTS[number].bone].name for number in joints]
        bone = next((one for one in (*reversed(bones), *reversed(whole)) if one not in carried), None)
        if bone is None:  # every bone has a marker already
            continue
        listed = ", ".join(
            f"{JOINTS[number].name.removeprefix(name + '_').replace('_', ' ')} "
            f"({np.rad2deg(score.joints[number]):.0f} deg)"
            for number in untold
        )
        yield Advice(
            float(share[untold].max()) * 0.1,
            f"Add a marker on {bone}: the markers tell little of the {name}'s {listed}.",
        )


def _hidden(score: LayoutScore) -> Iterator[Advice]:
    for name, seen in zip(score.layout.names, score.seen, strict=True):
        if seen < _HIDDEN:
            yield Advice(
                1.0 - float(seen),
                f"Move {name} towards the back of the hand: it is a point in {100 * seen:.0f} % of the "
                "frames only.",
            )


def _touching(score: LayoutScore) -> Iterator[Advice]:
    """Pairs that moving helps: not of tips that meet because fingers do."""
    names, digits = score.layout.names, [_digit(marker.bone) for marker in score.layout.markers]
    for first, second in zip(*np.nonzero(np.triu(score.near) > _TOUCHING), strict=True):
        share = float(score.near[first, second])
        if digits[first] != digits[second]:
            continue
        yield Advice(
            share,
            f"Move {names[first]} and {names[second]} apart: they touch, or nearly, in "
            f"{100 * share:.0f} % of the frames, and their blobs merge.",
        )


def _sides(score: LayoutScore) -> Iterator[Advice]:
    if score.sides_right < _SIDES:
        yield Advice(
            1.0 - score.sides_right,
            f"Make the back of the hand less symmetric: left and right are mistaken in "
            f"{100 * (1.0 - score.sides_right):.0f} % of the frames.",
        )


def _dispensable(score: LayoutScore) -> Iterator[Advice]:
    grown: Float[np.ndarray, "M"] = (score.joints_without - score.joints).max(axis=1)
    for marker in np.argsort(grown):
        if grown[marker] < _DISPENSABLE:
            yield Advice(
                0.0,
                f"{score.layout.names[marker]} can be dropped as far as joints go: without it none is known "
                f"worse by more than {np.rad2deg(grown[marker]):.1f} deg. It may still help to tell the "
                "others apart.",
            )
