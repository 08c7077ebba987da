"""A tracked take with corrected labels, and poses that are fitted to them again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.takes.corrections import FREE, Correction, applied_corrections, find_pins, pin_labels
from gloves.takes.tracked_take import LOST, TRACKED, TrackedTake
from track.kinematics.frame_fits import FEWEST_MARKERS
from track.kinematics.pose_solver import AnglePrior, PoseSolver

_ANGLE_SPREAD: Final = 0.3  # [rad] of hinges that markers leave open, around the tracked ones
_BAD_RMS: Final = 0.006  # [m] after which a fit from general poses is tried too
_MOST_LEARNED: Final = 2000  # frames that biases are learned from
_FEWEST_LEARNED: Final = 30  # frames with a marker from which its bias is learned


class CorrectedTake(NamedTuple):
    """What corrections make of a take."""

    take: TrackedTake
    labels: int
    """Points, over all frames, whose label a correction gives."""
    frames: int
    """Frames in which there are such points."""
    unfitting: tuple[Correction, ...]
    """Corrections that fit no point."""


def correct_take(take: TrackedTake, corrections: Sequence[Correction]) -> CorrectedTake:
    """Give points their right labels, and fit the poses of those frames to them.

    A corrected label has a confidence of 1. Where a hand has at least four labeled markers its pose is fitted
    again; with fewer, and where the hand is lost, its pose stays. Poses of rigid bodies stay.

    Args:
        take: The tracked take.
        corrections: In the order in which they were made.

    Raises:
        CaptureError: A span is not within the frames, a label is unknown, or two points of a frame have one
            label.
    """
    pins = find_pins(corrections, take.points, take.ids, take.label_names)
    about = pins.labels != FREE
    labels = pin_labels(take.labels, pins.labels)
    parts = {name: getattr(take, name).copy() for name in ("qpos", "rms", "markers", "filled")}
    first = 0
    for number, hand in enumerate(take.hands):
        count = hand.layout.num_markers
        own, before = (_of_hand(values, first, count) for values in (labels, take.labels))
        frames = np.flatnonzero((own != before).any(axis=1) & (take.status[:, number] != LOST))
        if len(frames):
            fitted = _fit_again(take, number, frames, targets_in(take.points[frames], own[frames], count))
            for name, values in fitted.items():
                parts[name][frames, number] = values
        first += count
    corrected = dataclasses.replace(
        take, labels=labels, confidence=np.where(about, 1.0, take.confidence), **parts,
        settings={**take.settings, "corrections": _records(take, corrections, pins.unfitting)},
    )  # fmt: skip
    return CorrectedTake(corrected, int(about.sum()), int(about.any(axis=1).sum()), pins.unfitting)


def targets_in(
    points: Float[np.ndarray, "T N 3"], labels: Int[np.ndarray, "T N"], count: int
) -> Float[np.ndarray, "T M 3"]:
    """The labeled markers of a hand [m], NaN where they are missing.

    Args:
        points: Observed points [m].
        labels: Marker of each point, -1 for none.
        count: Number of markers, M.
    """
    targets = np.full((len(points), count, 3), np.nan)
    frames, columns = np.nonzero(labels >= 0)
    targets[frames, labels[frames, columns]] = points[frames, columns]
    return targets


def learned_bias(take: TrackedTake, hand: int) -> NDArray[np.float64]:
    """How far each marker of a hand (M, 3) is from the glove's, in the frame of its bone [m].

    The tracker fits poses to markers that are shifted by this; so must be what stands between its poses.
    """
    worn, qpos = take.hands[hand], take.qpos[:, hand]
    tracked = np.flatnonzero(take.status[:, hand] == TRACKED)
    tracked = tracked[:: -(-len(tracked) // _MOST_LEARNED) or 1]
    bias = np.zeros((worn.layout.num_markers, 3))
    if len(tracked) < _FEWEST_LEARNED:
        return bias
    rotations = worn.model.forward_kinematics(qpos[tracked])[:, worn.attachment.main_bones, :3, :3]
    apart = worn.markers(qpos[tracked])[0] - take.markers[tracked, hand]
    local = np.einsum("tmji,tmj->tmi", rotations, apart)
    local[take.filled[tracked, hand]] = np.nan
    enough = np.isfinite(local[..., 0]).sum(axis=0) >= _FEWEST_LEARNED
    bias[enough] = np.nanmedian(local[:, enough], axis=0)
    return bias


def _fit_again(
    take: TrackedTake, hand: int, frames: NDArray[np.int64], targets: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Poses, RMS, markers and which are filled in, of some frames of a hand that has a pose there."""
    worn, qpos = take.hands[hand], take.qpos[frames, hand]
    seen = np.isfinite(targets[..., 0])
    enough = seen.sum(axis=1) >= FEWEST_MARKERS
    bias, rms = learned_bias(take, hand), np.full(len(frames), np.nan)
    if enough.any():
        qpos[enough] = _solved(worn, bias, targets[enough], qpos[enough])
    ours = worn.markers(qpos)[0]
    squares = ((ours - targets) ** 2).sum(axis=-1)
    rms[enough] = np.sqrt(np.nanmean(squares[enough], axis=1))
    rotations = worn.model.forward_kinematics(qpos)[:, worn.attachment.main_bones, :3, :3]
    shifted = ours - np.einsum("tmij,mj->tmi", rotations, bias)
    markers = np.where(seen[..., None], targets, shifted)
    return {"qpos": qpos, "rms": rms, "markers": markers, "filled": ~seen}


def _solved(
    worn: GloveFit, bias: NDArray[np.float64], targets: NDArray[np.float64], near: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (T, 27) of a hand whose markers are shifted by biases; each starts from the pose near it."""
    solver = PoseSolver(worn)
    solver.hand.positions[:, 0] -= bias
    prior = AnglePrior(near[:, 7:], _ANGLE_SPREAD)
    fit = solver.solve(targets, near, prior=prior)
    qpos, bad = fit.qpos.copy(), np.flatnonzero(fit.rms > _BAD_RMS)
    if len(bad):
        other = solver.solve(targets[bad])  # a wrong label may have bent the pose too far
        better = other.rms < 0.5 * fit.rms[bad]
        qpos[bad[better]] = other.qpos[better]
    return qpos


def _of_hand(labels: Int[np.ndarray, "T N"], first: int, count: int) -> NDArray[np.int64]:
    """Labels counted from a hand's first, -1 for those of others."""
    own = labels.astype(np.int64) - first
    own[(own < 0) | (own >= count)] = -1
    return own


def _records(
    take: TrackedTake, corrections: Sequence[Correction], unfitting: Sequence[Correction]
) -> list[dict[str, object]]:
    """The corrections that a take has now, those from before included."""
    before = applied_corrections(take)
    now = [correction.record() for correction in corrections if correction not in unfitting]
    return [*(record for record in before if record not in now), *now]
