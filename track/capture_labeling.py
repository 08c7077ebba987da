"""Labels of a whole capture, and labeled points as a capture.

Frames that follow from each other are labeled by tracking them in both directions, other frames alone.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from gloves.layout import load_layout
from gloves.optics.identities import number_runs
from gloves.takes.take import Take
from handsim.callbacks import Progress, no_progress
from handsim.errors import HandSimWarning
from handsim.hand.shape import NUM_QPOS
from track.association.initialization import FEWEST_POINTS
from track.association.point_linking import change_of_distances
from track.association.single_frames import label_alone
from track.both_directions import label_both_ways
from track.config import BOTH
from track.given import AnyCapture, AnyGlove, AnyLabeler, capture_of
from track.hand_check import check_hands, check_scale
from track.hand_size import sample_frames
from track.settings import AnyHands
from track.setup import choose_user, found_user
from track.streams.frame_source import StreamedFrame, checked_frames
from track.take_summary import no_points
from train.glove_labeler import load_labeler

_COMPARED: Final = 200  # pairs of frames that tell whether a capture's frames follow from each other
_CONTINUOUS: Final = 0.005  # [m] change of the distances in a hand from a frame to the next, at most
_MOST: Final = 0.5  # share of these pairs that change no more


def label_capture(
    capture: AnyCapture,
    glove: AnyGlove = "dense19",
    *,
    hands: AnyHands | None = None,
    labeler: AnyLabeler = None,
    progress: Progress = no_progress,
) -> Take:
    """Label the hands in every frame of a capture: none, one or two, as `handsim label` does.

    Their size is measured in the capture unless they are given. The take holds labels alone; `track_capture`
    gives poses.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file.
        hands: A user, hands in their gloves or the path of a user's file; or sides, those of the glove when
            not given.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        progress: Called with the number of frames that are done, and of all frames.

    Returns:
        A take whose `labels` (T, N) are indices into its `label_names`, -1 for none, and whose `confidence`
        (T, N) is from 0 to 1. The names are those of both hands: `right:ThumbTip`, `left:ThumbTip`.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, or knows other markers.

    Warns:
        HandSimWarning: There is no hand in any frame, or another hand or glove fits clearly better.
    """
    layout = load_layout(glove)
    network = load_labeler(layout, labeler)
    source = capture_of(capture)
    frames = checked_frames(source)
    worn = [side for side in BOTH if side in layout.sides]
    user, is_measured = choose_user(layout, worn if hands is None else hands, "auto")
    sample = sample_frames(frames)
    check_scale(sample, user, network)
    if is_measured:
        user = found_user(sample, layout, user.sides, network) or user
    check_hands(sample, user, network, options=("--glove",))

    def told(count: int) -> None:
        progress(count, len(frames))

    present = np.isfinite(source.positions[..., 0])
    settings = {"capture": Path(capture).name} if isinstance(capture, str | Path) else {}
    settings["glove"] = str(glove) if isinstance(glove, str | Path) else layout.name
    take = Take.of_truth(
        user.hands,
        np.full((source.num_frames, len(user), NUM_QPOS), np.nan),
        source.positions,
        number_runs(present),
        np.full(present.shape, -1, dtype=np.int16),
        rate=source.rate,
        settings=settings,
    )
    if _is_continuous(frames):
        labeled = label_both_ways(take, frames, user, network, told)
    else:
        found = label_alone([frame.points for frame in frames], user.hands, network, told)
        labels, confidence = (np.concatenate(values) for values in zip(*found, strict=True))
        points = dataclasses.replace(take.point_list, labels=labels, confidence=confidence)
        labeled = dataclasses.replace(take, point_list=points)
    if (labeled.point_list.labels < 0).all():
        none = f"no hand found, expected hands in glove '{settings['glove']}' (--glove names another)"
        warnings.warn(none if present.any() else no_points(take), HandSimWarning, stacklevel=2)
    return labeled


def _is_continuous(frames: Sequence[StreamedFrame]) -> bool:
    """Whether the frames of a capture follow from each other."""
    pairs = [
        (one.points, other.points)
        for one, other in pairwise(frames)
        if len(one.points) >= FEWEST_POINTS and len(other.points) >= FEWEST_POINTS
    ]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(_COMPARED, len(pairs))).astype(int))
    changes = [change_of_distances(*pairs[number]) for number in chosen]
    return bool(changes and np.mean([change < _CONTINUOUS for change in changes]) >= _MOST)
