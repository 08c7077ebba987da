"""Labels of a whole capture, and labeled points as a capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gloves.captures.capture import Capture
from gloves.captures.markers import labeled_capture, unlabeled_frames
from gloves.layout import load_layout
from gloves.optics.identities import number_runs
from gloves.takes.take import Take
from handsim.hand.topology import NUM_QPOS
from track.config import BOTH
from track.finder.frame_hands import HandFinder
from track.finder.labeling import label_hands
from track.given import AnyCapture, AnyGlove, AnyLabeler, capture_of
from track.setup import USUAL_SIZE
from track.user import nominal_user
from train.glove_labeler import load_labeler


def label_capture(
    capture: AnyCapture,
    glove: AnyGlove = "dense19",
    *,
    labeler: AnyLabeler = None,
    progress: Callable[[int, int], None] | None = None,
) -> Take:
    """Label the hands in every frame of a capture: none, one or two, as `handsim label` does.

    Labels alone: no pose is fitted, so that hands are lost in every frame. `track_capture` finds both.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        progress: Called with the number of frames that are done, and of all frames.

    Returns:
        A take whose `labels` (T, N) are indices into its `label_names`, -1 for none, and whose `confidence`
        (T, N) is from 0 to 1. The names are those of both hands: `right:ThumbTip`, `left:ThumbTip`.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
        CaptureError: The capture cannot be read.
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, or knows other markers.
    """
    layout = load_layout(glove)
    network = load_labeler(layout, labeler)
    source = capture_of(capture)
    finder, done = HandFinder(network, layout, rng=np.random.default_rng(0)), 0

    def told(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, source.num_frames)

    frames = label_hands(unlabeled_frames(source), finder, source.rate, told=told)
    user = nominal_user(layout, USUAL_SIZE, [side for side in BOTH if side in layout.sides])
    firsts = {side: number * layout.num_markers for number, side in enumerate(user.sides)}
    present = np.isfinite(source.positions[..., 0])
    labels = np.full(present.shape, -1, dtype=np.int16)
    confidence = np.full(present.shape, np.nan)
    for row, sure, there, one in zip(labels, confidence, present, frames, strict=True):
        first = np.where(one.sides > 0, firsts.get("right", -1), firsts.get("left", -1))
        row[there] = np.where((one.labels >= 0) & (first >= 0), first + one.labels, -1)
        sure[there] = one.confidence
    settings = {"capture": Path(capture).name} if isinstance(capture, str | Path) else {}
    settings["glove"] = str(glove) if isinstance(glove, str | Path) else layout.name
    no_poses, ids = np.full((source.num_frames, len(user), NUM_QPOS), np.nan), number_runs(present)
    take = Take.of_truth(
        user.hands, no_poses, source.positions, ids, labels, rate=source.rate, settings=settings
    )
    return dataclasses.replace(take, confidence=confidence)


def labeled_points(take: Take, *, sides: bool = True) -> Capture:
    """The labeled points of a take as a capture: one column per marker, then columns for the other points.

    Args:
        take: The take.
        sides: Whether hands have columns of their own, `right:ThumbTip`; without them there are those of one
            hand, `ThumbTip`, and no frame may hold two.
    """
    names, labels = take.label_names, take.labels.astype(np.int64)
    if not sides:
        names = take.hands[0].layout.names
        labels = np.where(labels >= 0, labels % len(names), -1)
    there = np.isfinite(take.points[..., 0])
    frames = [points[seen] for points, seen in zip(take.points, there, strict=True)]
    rows = [row[seen] for row, seen in zip(labels, there, strict=True)]
    return labeled_capture(frames, rows, names, take.rate)
