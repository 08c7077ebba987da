"""Evaluation of labelers: known markers are corrupted as in the paper, labeled, and counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gloves.captures.capture import Capture
from gloves.captures.collection import find_captures, read_markers
from gloves.captures.markers import select_hands
from gloves.layout import MarkerLayout
from gloves.optics.ghosts import GHOST_REACH
from gloves.takes.take import Take, load_take
from handsim._checks import check_rng, check_type
from handsim.errors import ArgumentError, CaptureError
from train.data.augmentation import Cloud, Corruption
from train.data.batches import paper_corruption
from train.data.own_corruption import OwnCorruption, draw_cloud
from train.data.shards import MANIFEST, Dataset, load_dataset
from train.evaluation.metrics import LabelCounts, error_without, expected_calibration_error
from train.glove_labeler import load_labeler
from train.labelers.protocol import Labeler

_CHUNK: Final = 4096
CLEAN: Final = Corruption(occlude=0, ghosts=0)
"""No corruption but the order of points."""


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The result of an evaluation."""

    figures: dict[str, float]
    """Shares in [0, 1], see `train.evaluation.metrics`; and from `train.evaluation.metrics` the expected
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
    """Slots, points, occlusions and ghosts counted, see `train.evaluation.metrics.LabelCounts.numbers`."""


Truth = Float[np.ndarray, "T M 3"] | Dataset | Take | Capture | str | Path
"""Markers whose labels are known: [m] in the labeler's order, a training set, a take with its truth, a
labeled capture, the path of one of the three, or a folder of captures."""


def evaluate_labeler(
    labeler: MarkerLayout | Labeler | str | Path,
    truth: Truth | Sequence[Truth],
    corruption: Corruption | OwnCorruption | str = CLEAN,
    *,
    every: int = 1,
    rng: np.random.Generator | None = None,
) -> Report:
    """Corrupt known markers, label them and count errors; takes keep the gaps and ghosts that they have.

    Args:
        labeler: The labeler to evaluate, its name or path, or a glove whose labeler it is.
        truth: True markers (T, M, 3) [m] in the labeler's order, NaN where missing; a training set, a labeled
            capture or a take with its truth; the path of one of these or of a folder of captures; or several.
            Each hand is counted by itself.
        corruption: Occlusion, ghosts and jitter to draw; none when not given. Or a corruption of your own, as
            `CloudStream` takes it.
        every: Take one frame of this many; 1 takes all.
        rng: Source of all randomness; one of seed 0 when not given.

    Returns:
        Figures as shares in [0, 1], by their names, and the counts that they come from. The ghosts of a hand
        of a take are those within 0.1 [m] of its markers.

    Raises:
        ArgumentError: An argument is of another type, or markers are not in meters.
        CaptureError: A file cannot be read, its glove has other markers than the labeler knows, takes are
            given with others or to be corrupted, or there is nothing to count.
    """
    network = load_labeler(labeler)
    check_type("every", every, int, "a whole number")
    if every < 1:
        raise ArgumentError(f"every is {every}, expected at least 1")
    rng = np.random.default_rng(0) if rng is None else rng
    check_rng(rng)
    several = isinstance(truth, list | tuple) and not isinstance(truth, Capture | Take)
    given: list[Any] = list(truth) if several else [truth]  # type: ignore[arg-type]
    count, takes = _Count(network), [one for one in given if _is_take(one)]
    if takes and (len(takes) < len(given) or corruption != CLEAN or every > 1):
        raise CaptureError(
            "a simulated take is counted whole, with its own gaps and ghosts, expected takes alone and no "
            "corruption"
        )
    for take in takes:
        _count_take(count, take if isinstance(take, Take) else load_take(take))
    if not takes:
        markers = _markers(given, network.marker_names)[::every]
        for first in range(0, len(markers), _CHUNK):
            count.add_cloud(draw_cloud(corruption, markers[first : first + _CHUNK], rng=rng))
    report = count.report()
    if not report.confusion[:-1].any() and not all(isinstance(one, np.ndarray) for one in given):
        raise CaptureError(
            f"nothing to count: no frame holds any of {', '.join(network.marker_names)}, expected labeled "
            "captures"
        )
    return report


def _is_take(truth: Any) -> bool:
    return isinstance(truth, Take) or (isinstance(truth, str | Path) and Path(truth).suffix == ".npz")


def _markers(truth: Sequence[Any], names: tuple[str, ...]) -> Float[np.ndarray, "T M 3"]:
    """The markers of all that was given [m], in the labeler's order."""
    parts = []
    for one in truth:
        if isinstance(one, np.ndarray):
            parts.append(_checked_markers(one, len(names)))
        elif isinstance(one, Capture):
            parts += select_hands(one, names)
        elif isinstance(one, Dataset) or (isinstance(one, str | Path) and (Path(one) / MANIFEST).is_file()):
            parts.append(_markers_of_set(load_dataset(one), names))
        else:
            expected = "markers (T, M, 3) [m], a Dataset, Capture or Take, or the path of one"
            check_type("truth", one, (str, Path), expected)
            parts.append(read_markers(find_captures([Path(one)]), names))
    if not parts:
        raise CaptureError("no capture was given, expected labeled captures, folders, training sets or takes")
    return np.concatenate(parts)


def _checked_markers(markers: NDArray[Any], count: int) -> NDArray[np.float64]:
    if markers.ndim != 3 or markers.shape[1:] != (count, 3) or markers.dtype.kind not in "fiu":
        raise ArgumentError(
            f"markers are {markers.dtype} of shape {markers.shape}, expected (T, {count}, 3) numbers [m]"
        )
    return markers.astype(np.float64)


def _markers_of_set(dataset: Dataset, names: tuple[str, ...]) -> NDArray[np.float64]:
    if dataset.marker_names != names:
        raise _other_markers(f"the set {dataset.path}", dataset.marker_names, names)
    markers: NDArray[np.float64] = dataset.rows()["markers"].astype(np.float64)
    return markers


def _other_markers(owner: str, has: Sequence[str], knows: Sequence[str]) -> CaptureError:
    return CaptureError(f"{owner} has markers {', '.join(has)}, the labeler knows {', '.join(knows)}")


def evaluate_clouds(labeler: Labeler, cloud: Cloud) -> Report:
    """Label clouds whose truth is known, and count errors.

    Args:
        labeler: The labeler to evaluate.
        cloud: Clouds of hands [m].
    """
    count = _Count(labeler)
    count.add_cloud(cloud)
    return count.report()


def paper_report(labeler: Labeler, rows: NDArray[np.void]) -> Report:
    """Evaluation of a labeler on these rows with the paper's corruption, the same each time."""
    markers = rows["markers"].astype(np.float64)
    corruption = paper_corruption(markers.shape[1])
    return evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))


def _count_take(count: _Count, take: Take) -> None:
    """Label every hand of every frame of a take, separated by the truth."""
    for hand in range(len(take.hands)):
        names = take.hands[hand].layout.names
        if names != count.labeler.marker_names:
            raise _other_markers("the take's glove", names, count.labeler.marker_names)
        clouds, truths = hand_clouds(take, hand)
        for first in range(0, len(clouds), _CHUNK):
            count.add(clouds[first : first + _CHUNK], truths[first : first + _CHUNK])


def hand_clouds(take: Take, hand: int) -> tuple[list[Float[np.ndarray, "N 3"]], list[Int[np.ndarray, "N"]]]:
    """One hand's points of every frame [m], with the marker of each; -1 for a ghost.

    A ghost belongs to the hand with the nearest marker, if that is within `GHOST_REACH`. Markers of a body
    with three or more are left out, since the system tracks it, as are those of the other hand.
    """
    nearest = np.stack([_nearest_marker(take, label) for label in take.hand_labels])
    mine = take.hand_labels[hand]
    own = (take.labels >= mine.start) & (take.labels < mine.stop)
    ghost = (take.labels < 0) & (nearest.argmin(axis=0) == hand) & (nearest[hand] <= GHOST_REACH)
    truth = np.where(own, take.labels - mine.start, -1)
    here = own | ghost
    clouds = [points[chosen] for points, chosen in zip(take.points, here, strict=True)]
    return clouds, [label[chosen] for label, chosen in zip(truth, here, strict=True)]


def _nearest_marker(take: Take, label: range) -> Float[np.ndarray, "T N"]:
    """Distance of every point from the nearest marker seen of one hand [m]; inf where none is seen."""
    markers = take.observed(label)
    distance = np.full(take.labels.shape, np.inf)
    for frame, points in enumerate(take.points):
        there = np.isfinite(points[:, 0])
        seen = markers[frame][np.isfinite(markers[frame, :, 0])]
        if len(seen):
            distance[frame, there] = cKDTree(seen).query(points[there])[0]
    return distance


class _Count:
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
        self.add(
            [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)],
            [truth[here] for truth, here in zip(cloud.truth, cloud.present, strict=True)],
        )

    def add(self, clouds: Sequence[Float[np.ndarray, "N 3"]], truths: Sequence[Int[np.ndarray, "N"]]) -> None:
        for labeling, truth in zip(self.labeler.label_frames(clouds), truths, strict=True):
            self.right_by_marker += self.counts.add(labeling.labels, truth, self.num_labels)
            self.confidences.append(labeling.confidence)
            self.right.append(labeling.labels == truth)

    def report(self) -> Report:
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
