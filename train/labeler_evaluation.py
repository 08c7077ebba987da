"""Evaluation of labelers: known markers are corrupted as in the paper, labeled, and counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gloves.optics.ghosts import GHOST_REACH
from gloves.takes.take import Take
from train.data.batches import Cloud, Corruption, OwnCorruption, draw_cloud, paper_corruption
from train.labelers.protocol import Labeler
from train.metrics import LabelCounts, error_without, expected_calibration_error

_CHUNK: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The result of an evaluation."""

    figures: dict[str, float]
    """Shares in [0, 1], see `train.metrics`; and from `train.metrics` the expected
    calibration error and the share of points labeled wrongly without the 2 % of least confidence."""
    slot_accuracy_by_marker: Float[np.ndarray, "M"]
    num_frames: int
    confusion: Int[np.ndarray, "M+1 M+1"]
    """Points by true label (rows) and given label (columns): markers in label order, then ghost."""
    confidences: Float[np.ndarray, "N"]
    """Confidence of each point's label, the points of all frames in order."""
    right: Bool[np.ndarray, "N"]
    """Whether that label is right."""
    numbers: dict[str, int] = field(default_factory=dict)
    """Slots, points, occlusions and ghosts counted, see `train.metrics.LabelCounts.numbers`."""


def evaluate_markers(
    labeler: Labeler,
    markers: Float[np.ndarray, "T M 3"],
    corruption: Corruption | OwnCorruption | str,
    *,
    rng: np.random.Generator,
) -> Report:
    """Corrupt known markers [m], NaN where missing, label them and count errors."""
    count = LabelingCount(labeler)
    count.add_markers(markers, corruption, rng=rng)
    return count.report()


def evaluate_clouds(labeler: Labeler, cloud: Cloud) -> Report:
    """Label clouds whose truth is known, and count errors."""
    count = LabelingCount(labeler)
    count.add_cloud(cloud)
    return count.report()


def paper_report(labeler: Labeler, rows: NDArray[np.void]) -> Report:
    """Evaluation of a labeler on these rows with the paper's corruption, the same each time."""
    markers = rows["markers"].astype(np.float64)
    corruption = paper_corruption(markers.shape[1])
    return evaluate_markers(labeler, markers, corruption, rng=np.random.default_rng(0))


def hand_clouds(take: Take, hand: int) -> tuple[list[Float[np.ndarray, "N 3"]], list[Int[np.ndarray, "N"]]]:
    """One hand's points of every frame [m], with the marker of each; -1 for a ghost.

    A ghost belongs to the hand with the nearest marker, if that is within `GHOST_REACH`. Markers of a body
    with three or more are left out, since the system tracks it, as are those of the other hand.
    """
    nearest = np.stack([_nearest_marker(take, label) for label in take.hand_labels])
    mine, labels = take.hand_labels[hand], take.point_list.labels
    own = (labels >= mine.start) & (labels < mine.stop)
    ghost = (labels < 0) & (nearest.argmin(axis=0) == hand) & (nearest[hand] <= GHOST_REACH)
    here = take.point_list.without(~(own | ghost))
    truth = np.where(here.labels >= 0, here.labels - mine.start, -1)
    clouds, truths = (np.split(values, here.starts[1:-1]) for values in (here.points, truth))
    return clouds, truths


def _nearest_marker(take: Take, label: range) -> Float[np.ndarray, "P"]:
    """Distance of every point from the nearest marker seen of one hand [m]; inf where none is seen."""
    markers, points = take.observed(label), take.point_list
    distance = np.full(len(points.labels), np.inf)
    for frame, every in enumerate(markers):
        there, seen = points.of(frame), every[np.isfinite(every[:, 0])]
        if len(seen) and there.stop > there.start:
            distance[there] = cKDTree(seen).query(points.points[there])[0]
    return distance


class LabelingCount:
    """Labels clouds and counts errors."""

    def __init__(self, labeler: Labeler) -> None:
        self.labeler = labeler
        self.num_labels = len(labeler.marker_names)
        classes = self.num_labels + 1
        self.counts = LabelCounts(confusion=np.zeros((classes, classes), dtype=np.int64))
        self.right_by_marker = np.zeros(self.num_labels)
        self.confidences: list[NDArray[np.float64]] = [np.zeros(0)]
        self.right: list[NDArray[np.bool_]] = [np.zeros(0, dtype=np.bool_)]

    def add_cloud(self, cloud: Cloud) -> None:
        """Label clouds [m] and count."""
        self.add(
            [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)],
            [truth[here] for truth, here in zip(cloud.truth, cloud.present, strict=True)],
        )

    def add_markers(
        self,
        markers: Float[np.ndarray, "T M 3"],
        corruption: Corruption | OwnCorruption | str,
        *,
        rng: np.random.Generator,
    ) -> None:
        """Corrupt markers [m], label the clouds and count."""
        for first in range(0, len(markers), _CHUNK):
            self.add_cloud(draw_cloud(corruption, markers[first : first + _CHUNK], rng=rng))

    def add_take(self, take: Take) -> None:
        """Label every hand of every frame of a take, separated by the truth."""
        for hand in range(len(take.hands)):
            clouds, truths = hand_clouds(take, hand)
            for first in range(0, len(clouds), _CHUNK):
                self.add(clouds[first : first + _CHUNK], truths[first : first + _CHUNK])

    def add(self, clouds: Sequence[Float[np.ndarray, "N 3"]], truths: Sequence[Int[np.ndarray, "N"]]) -> None:
        """Label points [m] and count; a truth is the marker of each, -1 for a ghost."""
        for labeling, truth in zip(self.labeler.label_frames(clouds), truths, strict=True):
            self.right_by_marker += self.counts.add(labeling.labels, truth, self.num_labels)
            self.confidences.append(labeling.confidence)
            self.right.append(labeling.labels == truth)

    def report(self) -> Report:
        """Figures of all that was counted."""
        frames = self.counts.frames
        confidences, right = np.concatenate(self.confidences), np.concatenate(self.right)
        figures = {
            **self.counts.figures(),
            "calibration_error": expected_calibration_error(confidences, right),
            "error_without_least_sure": error_without(confidences, right),
        }
        by_marker = self.right_by_marker / max(1, frames)
        numbers = self.counts.numbers()
        return Report(figures, by_marker, frames, self.counts.confusion, confidences, right, numbers)
