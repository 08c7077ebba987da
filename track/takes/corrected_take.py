"""Corrected labels of a tracked take, and poses fitted to them again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Int

from gloves.fit import GloveFit
from gloves.takes.corrections import FREE, Correction, applied_corrections, find_pins, pin_labels
from gloves.takes.points import PointList
from gloves.takes.take import LOST, Take
from handsim.arrays import Doubles, Integers
from handsim.hand.shape import NUM_JOINTS, NUM_KEYPOINTS
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver
from track.takes.smoothed_take import smooth_take, spread_model

_ANGLE_SPREAD: Final = 0.3  # [rad] prior standard deviation of joint angles around the tracked ones
BAD_RMS: Final = 0.006
"""RMS distance of markers [m] above which a fit is repeated from general poses."""


class CorrectedTake(NamedTuple):
    """A take after corrections."""

    take: Take
    unfitting: tuple[Correction, ...]
    """Corrections that match no point."""


def correct_take(take: Take, corrections: Sequence[Correction]) -> CorrectedTake:
    """Correct the labels of points, and fit the poses of those frames to them.

    A corrected label has a confidence of 1. A hand is fitted again where it has at least four labeled markers
    and is not lost; other poses, and those of rigid bodies, stay.
    """
    before = take.point_list
    pins = find_pins(corrections, before, take.label_names)
    about = pins.labels != FREE
    points = dataclasses.replace(
        before, labels=pin_labels(before, pins.labels), confidence=np.where(about, 1.0, before.confidence)
    )
    qpos, rms = take.qpos.copy(), take.rms.copy()
    for number, span in enumerate(take.hand_labels):
        changed = before.frames[_hand_labels(points.labels, span) != _hand_labels(before.labels, span)]
        frames = np.unique(changed)
        frames = frames[take.status[frames, number] != LOST]
        if len(frames):
            targets = points.labeled(span, frames)
            qpos[frames, number], rms[frames, number] = _fit_again(take, number, frames, targets)
    corrected = dataclasses.replace(
        take, point_list=points, qpos=qpos, rms=rms,
        settings={**take.settings, "corrections": _records(take, corrections, pins.unfitting)},
    )  # fmt: skip
    if take.settings.get("smooth"):
        corrected = smooth_take(corrected)
    else:
        corrected = dataclasses.replace(corrected, **_spreads(take, points, qpos))
    return CorrectedTake(corrected, pins.unfitting)


def _spreads(take: Take, points: PointList, qpos: Doubles) -> dict[str, Any]:
    """Standard deviations of all poses given these labels, by the names of a take's fields."""
    angles = np.full((*qpos.shape[:2], NUM_JOINTS), np.nan)
    keypoints = np.full((*qpos.shape[:2], NUM_KEYPOINTS), np.nan)
    for number, (hand, span) in enumerate(zip(take.hands, take.hand_labels, strict=True)):
        there = np.flatnonzero(take.status[:, number] != LOST)
        if not len(there):
            continue
        seen = np.isfinite(points.labeled(span)[..., 0])
        last = np.maximum.accumulate(np.where(seen, take.times[:, None], -np.inf), axis=0)
        unseen = (take.times[:, None] - last)[there]
        rms = take.rms[there, number]
        usual = float(np.sqrt(np.nanmean(rms**2))) if np.isfinite(rms).any() else np.nan
        model = spread_model(take, hand)
        angles[there, number], keypoints[there, number] = model.spreads(qpos[there, number], unseen, usual)
    return {"angle_spread": angles, "keypoint_spread": keypoints}


def _fit_again(take: Take, hand: int, frames: Integers, targets: Doubles) -> tuple[Doubles, Doubles]:
    """Fit a hand that is not lost to labeled markers in some frames; poses and RMS [m]."""
    worn, qpos = take.hands_at(int(frames[0]))[hand], take.qpos[frames, hand]
    enough = np.isfinite(targets[..., 0]).sum(axis=1) >= FEWEST_MARKERS
    rms = np.full(len(frames), np.nan)
    if enough.any():
        bias = take.marker_bias(worn.side)
        qpos[enough] = _fit_poses(worn, bias, targets[enough], qpos[enough])
        squares = ((worn.markers(qpos[enough])[0] - targets[enough]) ** 2).sum(axis=-1)
        rms[enough] = np.sqrt(np.nanmean(squares, axis=1))
    return qpos, rms


def _fit_poses(worn: GloveFit, bias: Doubles, targets: Doubles, near: Doubles) -> Doubles:
    """Fit poses (T, 27) of a hand with biased markers, each starting from a given pose."""
    solver = PoseSolver(worn)
    solver.hand.positions[:, 0] -= bias
    fit = solver.solve(targets, near, prior=(near[:, 7:], _ANGLE_SPREAD))
    qpos, bad = fit.qpos.copy(), np.flatnonzero(fit.rms > BAD_RMS)
    if len(bad):
        other = solver.solve(targets[bad])  # A wrong label may have bent the starting pose too far.
        better = other.rms < 0.5 * fit.rms[bad]
        qpos[bad[better]] = other.qpos[better]
    return qpos


def _hand_labels(labels: Int[np.ndarray, "P"], span: range) -> Integers:
    """Labels of one hand, -1 for all others."""
    return np.where((labels >= span.start) & (labels < span.stop), labels, -1)


def _records(
    take: Take, corrections: Sequence[Correction], unfitting: Sequence[Correction]
) -> list[dict[str, object]]:
    """Records of all corrections of a take, earlier ones included."""
    before = applied_corrections(take)
    now = [correction.record() for correction in corrections if correction not in unfitting]
    return [*(record for record in before if record not in now), *now]
