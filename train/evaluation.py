"""Evaluates labelers: corrupts known markers as in the paper, labels them, and counts errors.

docs/results.md defines the figures, which are those of Han et al. 2018. Macro F1 is the mean F1, over points,
of the markers and of "ghost", the null class, as in SOMA (Ghorbani and Black 2021).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gloves.captures.capture import Capture, select_hands
from gloves.captures.formats import find_captures, read_capture, read_hands
from gloves.layout import MarkerLayout
from gloves.optics.ghosts import GHOST_REACH
from gloves.takes.points import PointList
from gloves.takes.take import Take, load_take
from handsim._checks import as_numbers, check_rng, check_type
from handsim.app.messages import print_table
from handsim.errors import ArgumentError, CaptureError
from handsim.hand.shape import SIDES
from train.data.batches import Cloud, Corruption, OwnCorruption, corrupt, draw_cloud, paper_corruption
from train.data.shards import Dataset, is_dataset, load_dataset
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler
from train.settings import EvaluateSettings

BINS: Final = 15
"""Number of equally wide bins of confidence."""
LEAST_SURE: Final = 0.02
"""Share of the least confident points, which a person might check by hand."""
_FRAMES_A_CHUNK: Final = 4096
_BOOTSTRAPS: Final = 1000  # number of bootstrap samples for a confidence interval
ACCURACIES: Final = ("slot_accuracy", "point_accuracy", "frame_accuracy")
"""The figures that have intervals."""
CLEAN: Final = Corruption(occlude=0, ghosts=0)
"""Only the order of points is changed."""
SEEN: Final = "as the rig sees them"
"""Name of the figures for markers and ghosts as seen by a rig."""

_SAME_POINT_DISTANCE: Final = 1e-3  # [m] largest distance of one point between two files of a capture
_LEAST_SHARED_POINTS: Final = 0.5  # least share of a labeled capture's points that its truth has


def macro_f1(confusion: Int[np.ndarray, "K K"]) -> float:
    """Mean F1 of the classes that occur as true (rows) or given labels; NaN if none does."""
    counts = confusion.sum(axis=0) + confusion.sum(axis=1)
    occurs = counts > 0
    return float((2.0 * confusion.diagonal()[occurs] / counts[occurs]).mean()) if occurs.any() else np.nan


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Points in equally wide bins of confidence; NaN in empty bins."""

    confidence: Float[np.ndarray, "15"]
    """Mean confidence."""
    right: Float[np.ndarray, "15"]
    """Share of right labels."""
    count: Int[np.ndarray, "15"]


def reliability(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> Reliability:
    """Share of right labels by confidence; bins include their lower edges, the last one also 1."""
    index = np.floor(confidence * BINS).astype(np.int64).clip(0, BINS - 1)
    count = np.bincount(index, minlength=BINS)
    sums = [np.bincount(index, weights, minlength=BINS) for weights in (confidence, right)]
    with np.errstate(invalid="ignore"):
        return Reliability(sums[0] / count, sums[1] / count, count)


def expected_calibration_error(confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"]) -> float:
    """Mean difference between a bin's confidence and its share of right labels, weighted by points."""
    if not len(confidence):
        return np.nan
    bins = reliability(confidence, right)
    return float(np.nansum(np.abs(bins.confidence - bins.right) * bins.count) / len(confidence))


def error_without(
    confidence: Float[np.ndarray, "N"], right: Bool[np.ndarray, "N"], share: float = LEAST_SURE
) -> float:
    """Share of wrong labels after the least confident points are left out; NaN if no point is left.

    Where only some of several equally confident points are left out, the result is the mean over all choices.
    """
    kept = len(confidence) - round(share * len(confidence))
    if not kept:
        return np.nan
    least = np.partition(confidence, -kept)[-kept]  # least confidence that is kept
    above, tied = confidence > least, confidence == least
    from_tied = (kept - above.sum()) * (~right[tied]).mean()
    return float(((~right[above]).sum() + from_tied) / kept)


@dataclass(slots=True)
class History:
    """Loss, learning rate and held-out accuracy of a training run, as stored in checkpoints."""

    losses: list[tuple[int, float, float]] = field(default_factory=list)
    """Samples done, mean loss of the steps since the previous entry, their last learning rate."""
    accuracies: list[tuple[int, float, float]] = field(default_factory=list)
    """Samples done, minutes of training until then, slot accuracy on some held-out frames with the paper's
    corruption."""
    minutes: float = 0.0
    """Time of all steps [min]."""
    waiting: float = 0.0
    """Sum of losses since the last entry."""
    steps: int = 0
    """Number of steps since the last entry."""

    def add(self, loss: float) -> None:
        """Count a step."""
        self.waiting += loss
        self.steps += 1

    def close(self, done: int, rate: float) -> float:
        """Add an entry for the steps since the last one, and return their mean loss."""
        mean = self.waiting / self.steps
        self.losses.append((done, mean, rate))
        self.waiting, self.steps = 0.0, 0
        return mean


def percent(share: float) -> str:
    """A share in percent with two decimals, a dash for NaN."""
    return "-" if np.isnan(share) else f"{100 * share:.2f}"


def _point_of_label(labels: Int[np.ndarray, "N"], num_labels: int) -> Int[np.ndarray, "M"]:
    """Index (M,) of the point with each label, -1 for none."""
    slots = np.full(num_labels, -1)
    labeled = np.flatnonzero(labels >= 0)
    slots[labels[labeled]] = labeled
    return slots


def _ratio(part: int, whole: int) -> float:
    """A share; NaN of nothing."""
    return part / whole if whole else np.nan


def print_figures(
    columns: dict[str, dict[str, float]], intervals: Mapping[str, Sequence[float]] = {}, *, title: str
) -> None:
    """Print a table with a column for each set of figures, in percent with intervals."""
    rows = [["figure", *(f"{name} [%]" for name in columns)]]
    for name in next(iter(columns.values())):
        texts = (percent_between(one[name], intervals.get(name)) for one in columns.values())
        rows.append([name.replace("_", " "), *texts])
    print_table(rows, title=title)


@dataclass(frozen=True, slots=True, eq=False)
class LabelingReport:
    """Result of an evaluation."""

    figures: dict[str, float]
    """Shares in [0, 1]: accuracies, precision and recall of occlusions and ghosts, macro F1, the expected
    calibration error, and the share of points labeled wrongly without the 2 % of least confidence."""
    slot_accuracy_by_marker: Float[np.ndarray, "M"]
    num_frames: int
    confusion: Int[np.ndarray, "M+1 M+1"]
    """Points by true label (rows) and given label (columns): markers in label order, then ghost."""
    confidences: Float[np.ndarray, "N"]
    """Confidence of each point's label, the points of all frames in order."""
    right: Bool[np.ndarray, "N"]
    """Whether each of these labels is right."""
    numbers: dict[str, int] = field(default_factory=dict)
    """Slots, points, occlusions and ghosts counted."""
    right_slots: Bool[np.ndarray, "T M"] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.bool_))
    """Whether each slot of each frame is right."""
    marker_names: tuple[str, ...] = ()
    """Names of the M markers; label m is the marker of index m."""
    num_points: Int[np.ndarray, "T"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Number of points of each frame."""
    groups: Int[np.ndarray, "T"] | None = None
    """Number of the person of each frame; if people are unknown, of its capture or its second."""
    grouped_by: str = "people"
    """Kind of these groups: people, captures or seconds."""

    @property
    def num_groups(self) -> int:
        """Number of people, captures or seconds."""
        return 0 if self.groups is None else len(np.unique(self.groups))

    def interval(
        self, figure: str = "slot_accuracy", marker: int | None = None
    ) -> tuple[float, float] | None:
        """The 95 % interval of a share, by a bootstrap over groups of frames; None for fewer than two groups.

        Args:
            figure: One of `ACCURACIES`.
            marker: Index of the only marker whose slots count; all markers when not given.
        """
        if self.groups is None or self.num_groups < 2:
            return None
        _, group = np.unique(self.groups, return_inverse=True)
        right_points = np.bincount(np.repeat(np.arange(len(group)), self.num_points), self.right, len(group))
        slots = self.right_slots if marker is None else self.right_slots[:, [marker]]
        right, count = {
            "slot_accuracy": (slots.sum(axis=1), np.full(len(group), slots.shape[1])),
            "point_accuracy": (right_points, self.num_points),
            "frame_accuracy": (slots.all(axis=1) & (right_points == self.num_points), np.ones(len(group))),
        }[figure]
        sums = np.stack([np.bincount(group, one) for one in (right, count)])
        drawn = np.random.default_rng(0).integers(self.num_groups, size=(_BOOTSTRAPS, self.num_groups))
        shares = np.divide(*sums[:, drawn].sum(axis=2))
        low, high = np.quantile(shares, (0.025, 0.975))
        return float(low), float(high)

    def intervals(self) -> dict[str, tuple[float, float]]:
        """The intervals of all accuracies; empty with fewer than two people, captures or seconds."""
        return {name: one for name in ACCURACIES if (one := self.interval(name)) is not None}


def percent_between(share: float, interval: Sequence[float] | None) -> str:
    """A share in percent, and its interval in brackets if there is one."""
    return percent(share) + ("" if interval is None else f" ({' to '.join(map(percent, interval))})")


Frames = tuple[list[Float[np.ndarray, "N 3"]], list[Int[np.ndarray, "N"]]]
"""Points of some frames [m], and the marker of each, -1 for a ghost."""


def evaluate_frames(labeler: Labeler, parts: Iterable[Frames]) -> LabelingReport:
    """Label points with known truth, and count errors."""
    labeled = (
        (labeling.labels, labeling.confidence, truth)
        for clouds, truths in parts
        for labeling, truth in zip(labeler.label_frames(clouds), truths, strict=True)
    )
    return count_labels(labeler.marker_names, labeled)


def count_labels(
    names: tuple[str, ...], frames: Iterable[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]
) -> LabelingReport:
    """Count errors in frames of given labels, their confidence, and true labels, -1 for a ghost.

    Labels with NaN as confidence are left out of the figures on confidence. Precision is NaN if nothing was
    occluded, or no point was a ghost: it could only be zero.
    """
    num_labels = len(names)
    confusion = np.zeros((num_labels + 1, num_labels + 1), dtype=np.int64)
    slots: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    confidences: list[NDArray[np.float64]] = [np.zeros(0)]
    right: list[NDArray[np.bool_]] = [np.zeros(0, dtype=np.bool_)]
    for labels, confidence_of, truth in frames:
        slots.append((_point_of_label(labels, num_labels), _point_of_label(truth, num_labels)))
        np.add.at(confusion, (truth, labels), 1)  # -1, a ghost, is the last row and column
        confidences.append(confidence_of)
        right.append(labels == truth)
    given, true = np.array(slots, dtype=np.int64).reshape(-1, 2, num_labels).swapaxes(0, 1)
    right_slots = given == true
    confidence, is_right = np.concatenate(confidences), np.concatenate(right)
    known = np.isfinite(confidence)
    numbers = {
        "slots": true.size,
        "points": int(confusion.sum()),
        "occluded": int((true < 0).sum()),
        "occluded_given": int((given < 0).sum()),
        "occluded_right": int(((given < 0) & (true < 0)).sum()),
        "ghosts": int(confusion[-1].sum()),
        "ghosts_given": int(confusion[:, -1].sum()),
        "ghosts_right": int(confusion[-1, -1]),
    }
    occluded, ghosts = numbers["occluded"], numbers["ghosts"]
    given_occluded, given_ghosts = (
        numbers[f"{kind}_given"] if numbers[kind] else 0 for kind in ("occluded", "ghosts")
    )
    figures = {
        "slot_accuracy": _ratio(int(right_slots.sum()), true.size),
        "point_accuracy": _ratio(int(np.trace(confusion)), numbers["points"]),
        "frame_accuracy": _ratio(sum(bool(one.all()) for one in right[1:]), len(true)),
        "occlusion_ratio": _ratio(occluded, true.size),
        "occlusion_precision": _ratio(numbers["occluded_right"], given_occluded),
        "occlusion_recall": _ratio(numbers["occluded_right"], occluded),
        "ghost_ratio": _ratio(ghosts, true.size),
        "ghost_precision": _ratio(numbers["ghosts_right"], given_ghosts),
        "ghost_recall": _ratio(numbers["ghosts_right"], ghosts),
        "macro_f1": macro_f1(confusion),
        "calibration_error": expected_calibration_error(confidence[known], is_right[known]),
        "error_without_least_sure": error_without(confidence[known], is_right[known]),
    }
    num_points = np.array([len(one) for one in right[1:]], dtype=np.int64)
    by_marker = right_slots.sum(axis=0) / max(1, len(true))
    counted = figures, by_marker, len(true), confusion
    return LabelingReport(*counted, confidence, is_right, numbers, right_slots, names, num_points)


def evaluate_markers(
    labeler: Labeler,
    markers: Float[np.ndarray, "T M 3"],
    corruption: Corruption | OwnCorruption | str,
    *,
    rng: np.random.Generator,
) -> LabelingReport:
    """Corrupt known markers [m], NaN where missing, label them and count errors."""
    clouds = (draw_cloud(corruption, part, rng=rng) for part in _chunks(markers))
    return evaluate_frames(labeler, map(cloud_frames, clouds))


def _chunks(rows: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Parts of rows that are labeled together."""
    return (rows[first : first + _FRAMES_A_CHUNK] for first in range(0, len(rows), _FRAMES_A_CHUNK))


def paper_report(labeler: Labeler, rows: NDArray[np.void]) -> LabelingReport:
    """Evaluate a labeler on rows with the paper's corruption, which is the same in each call."""
    markers = rows["markers"].astype(np.float64)
    corruption = paper_corruption(markers.shape[1])
    return evaluate_markers(labeler, markers, corruption, rng=np.random.default_rng(0))


def rig_report(labeler: Labeler, rows: NDArray[np.void], *, rng: np.random.Generator) -> LabelingReport:
    """Evaluate a labeler on the points and ghosts that the rig observed in these rows."""
    clouds = (
        corrupt(part["observed"].astype(np.float64), CLEAN, ghosts=part["ghosts"].astype(np.float64), rng=rng)
        for part in _chunks(rows)
    )
    return evaluate_frames(labeler, map(cloud_frames, clouds))


def cloud_frames(cloud: Cloud) -> Frames:
    """Points and labels of clouds without padding."""
    return (
        [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)],
        [truth[here] for truth, here in zip(cloud.truth, cloud.present, strict=True)],
    )


def _take_frames(take: Take) -> Iterator[Frames]:
    """Points of each hand in each frame of a take, assigned to hands by the truth.

    A ghost belongs to the hand with the nearest marker, if that is within `GHOST_REACH`. Markers of tracked
    bodies belong to no hand.
    """
    labels = take.point_list.labels
    nearest = np.stack([_nearest_marker(take, label) for label in take.hand_labels])
    for hand, of_hand in enumerate(take.hand_labels):
        own = (labels >= of_hand.start) & (labels < of_hand.stop)
        ghost = (labels < 0) & (nearest.argmin(axis=0) == hand) & (nearest[hand] <= GHOST_REACH)
        here = take.point_list.without(~(own | ghost))
        truth = np.where(here.labels >= 0, here.labels - of_hand.start, -1)
        clouds, truths = (np.split(values, here.starts[1:-1]) for values in (here.points, truth))
        for first in range(0, len(clouds), _FRAMES_A_CHUNK):
            yield clouds[first : first + _FRAMES_A_CHUNK], truths[first : first + _FRAMES_A_CHUNK]


def _nearest_marker(take: Take, label: range) -> Float[np.ndarray, "P"]:
    """Distance from every point to the nearest visible marker of one hand [m]; inf if none is visible."""
    points = take.point_list
    distance = np.full(len(points.labels), np.inf)
    for frame, markers in enumerate(take.observed(label)):
        of_frame, visible = points.of(frame), markers[np.isfinite(markers[:, 0])]
        if len(visible) and of_frame.stop > of_frame.start:
            distance[of_frame] = cKDTree(visible).query(points.points[of_frame])[0]
    return distance


Truth = Float[np.ndarray, "T M 3"] | Dataset | Take | Capture | str | Path
"""True markers: an array [m] in the labeler's order, a training set, a take with its truth, a labeled
capture, the path of one of the last three, or a folder of captures."""


def evaluate_labeler(
    labeler: MarkerLayout | Labeler | str | Path,
    truth: Truth | Sequence[Truth],
    corruption: Corruption | OwnCorruption | str | None = None,
    *,
    settings: EvaluateSettings | None = None,
    rng: np.random.Generator | None = None,
    **options: Any,
) -> LabelingReport:
    """Corrupt known markers, label them and count errors; takes keep their own gaps and ghosts.

    Training sets without corruption are evaluated as their rig saw them, with its gaps and ghosts.

    Args:
        labeler: Labeler to evaluate, its name or path, or a glove whose labeler is used.
        truth: True markers (T, M, 3) [m] in the labeler's order, NaN where missing; a training set, a labeled
            capture or a take with its truth; the path of one of these or of a folder of captures; or several.
            Each hand is counted by itself.
        corruption: Corruption instead of that of the settings; also one of your own, as for `CloudStream`.
        settings: Settings of the evaluation; every frame without corruption if not given.
        rng: Source of all randomness; if not given, from the settings' seed.
        options: Settings of `EvaluateSettings` that differ from `settings`: `occlude=5, ghosts=2, every=10`.

    Returns:
        Figures as shares in [0, 1], by name, and the underlying counts. Ghosts of a hand in a take are those
        within 0.1 [m] of its markers.

    Raises:
        ArgumentError: An argument is of another type, or markers are not in meters.
        CaptureError: A file cannot be read, its glove has other markers than the labeler, takes are mixed
            with others or to be corrupted, or there is nothing to count.
    """
    network, settings = load_labeler(labeler), EvaluateSettings.of(settings, options)
    corruption = Corruption(settings.occlude, settings.ghosts) if corruption is None else corruption
    rng = np.random.default_rng(settings.seed) if rng is None else rng
    check_rng(rng)
    several = isinstance(truth, list | tuple) and not isinstance(truth, Capture | Take)
    given: list[Any] = list(truth) if several else [truth]  # type: ignore[arg-type]
    takes = [
        one for one in given
        if isinstance(one, Take) or (isinstance(one, str | Path) and Path(one).suffix == ".npz")
    ]  # fmt: skip
    if takes:
        if len(takes) < len(given):
            raise CaptureError(
                f"given {_name_of(takes[0])} and other kinds of truth, expected one kind; evaluate each alone"
            )
        if corruption != CLEAN or settings.every > 1:
            raise CaptureError(
                "a simulated take is counted whole, with its own gaps and ghosts: leave out the corruption "
                "(--occlude, --ghosts) and every (--every), which labeled captures take"
            )
        report = _report_of_takes(network, takes)
    elif given and all(map(is_dataset, given)):
        report = _report_of_sets(network, list(map(load_dataset, given)), corruption, settings.every, rng)
    else:
        parts = _true_markers(given, network.marker_names)
        markers = np.concatenate([one for one, _ in parts])[:: settings.every]
        report = evaluate_markers(network, markers, corruption, rng=rng)
        report = _with_groups(report, [seconds for _, seconds in parts], "seconds", settings.every)
    if not report.confusion[:-1].any() and not all(isinstance(one, np.ndarray) for one in given):
        names = ", ".join(network.marker_names)
        raise CaptureError(f"nothing to count: no frame holds any of {names}, expected labeled captures")
    return report


def _report_of_takes(network: Labeler, takes: Sequence[Take | str | Path]) -> LabelingReport:
    """Evaluate all frames of simulated takes, with the gaps and ghosts that their cameras recorded."""
    simulated = list(map(_simulated_take, takes))
    for hand in chain.from_iterable(take.hands for take in simulated):
        _check_markers("the take's glove", hand.layout.names, network.marker_names)
    report = evaluate_frames(network, chain.from_iterable(map(_take_frames, simulated)))
    seconds = [np.tile(take.times.astype(np.int64), len(take.hands)) for take in simulated]
    return _with_groups(report, seconds, "seconds")


def _report_of_sets(
    network: Labeler,
    sets: Sequence[Dataset],
    corruption: Corruption | OwnCorruption | str,
    every: int,
    rng: np.random.Generator,
) -> LabelingReport:
    """Evaluate every n-th row of training sets, as their rig saw it or corrupted."""
    rows = np.concatenate([_checked_rows(one, network.marker_names) for one in sets])[::every]
    if corruption == CLEAN:
        report = rig_report(network, rows, rng=rng)
    else:
        report = evaluate_markers(network, rows["markers"].astype(np.float64), corruption, rng=rng)
    return _with_groups(report, [one.people() for one in sets], "people", every)


def _name_of(given: Any) -> str:
    """Name of a take or capture in an error message: its path, if it is given by one."""
    return str(given) if isinstance(given, str | Path) else f"the {type(given).__name__.lower()}"


def _simulated_take(given: Take | str | Path) -> Take:
    """A take with its truth; a `CaptureError` if it is a tracked one."""
    take = given if isinstance(given, Take) else load_take(given)
    if take.made_by_tracker:
        raise CaptureError(f"{_name_of(given)}: a tracked take, expected the truth of a simulated capture")
    return take


def _true_markers(
    truth: Sequence[Any], names: tuple[str, ...]
) -> list[tuple[Float[np.ndarray, "T M 3"], Int[np.ndarray, "T"] | None]]:
    """True markers of captures, sets and arrays [m], in the labeler's order, and seconds of captures."""
    parts: list[tuple[NDArray[np.float64], NDArray[np.int64] | None]] = []
    for one in truth:
        if isinstance(one, np.ndarray):
            if one.ndim != 3 or one.shape[1:] != (len(names), 3):
                raise ArgumentError(f"markers have shape {one.shape}, expected (T, {len(names)}, 3) [m]")
            parts.append((as_numbers("truth", one), None))
        elif isinstance(one, Capture):
            parts.append(_joined_hands(select_hands(one, names), one.rate))
        elif is_dataset(one):
            parts.append((_checked_rows(load_dataset(one), names)["markers"].astype(np.float64), None))
        else:
            expected = "markers (T, M, 3) [m], a Dataset, Capture or Take, or the path of one"
            check_type("truth", one, (str, Path), expected)
            parts += [_joined_hands(*read_hands(file, names)) for file in find_captures([Path(one)])]
    if not parts:
        raise CaptureError("no capture was given, expected labeled captures, folders, training sets or takes")
    return parts


def _joined_hands(
    hands: Sequence[Float[np.ndarray, "T M 3"]], rate: float
) -> tuple[Float[np.ndarray, "T M 3"], Int[np.ndarray, "T"]]:
    """Markers of all hands of a capture [m], one hand after the other, and the second of each frame."""
    seconds = [(np.arange(len(hand)) / rate).astype(np.int64) for hand in hands]
    return np.concatenate(hands), np.concatenate(seconds)


def _with_groups(
    report: LabelingReport, parts: Sequence[Int[np.ndarray, "T"] | None], grouped_by: str, every: int = 1
) -> LabelingReport:
    """The report with the person, capture or second of each of its frames, if they are known of all parts."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return report
    if grouped_by == "seconds" and len(known) > 1:
        known, grouped_by = [np.zeros_like(part) for part in known], "captures"
    firsts = np.cumsum([0, *(part.max(initial=-1) + 1 for part in known)])
    numbers = np.concatenate([first + part for first, part in zip(firsts[:-1], known, strict=True)])
    return dataclasses.replace(report, groups=numbers[::every], grouped_by=grouped_by)


def _checked_rows(dataset: Dataset, names: tuple[str, ...]) -> NDArray[np.void]:
    """Read the rows of a set, and refuse one with other markers than the labeler's."""
    _check_markers(f"the set {dataset.path}", dataset.marker_names, names)
    return np.asarray(dataset.rows())


def _check_markers(owner: str, has: Sequence[str], knows: Sequence[str]) -> None:
    """Refuse markers that are not those of the labeler."""
    if tuple(has) != tuple(knows):
        raise CaptureError(f"{owner} has markers {', '.join(has)}, the labeler knows {', '.join(knows)}")


def evaluate_labels(labeled: Take | Capture | str | Path, truth: Take | str | Path) -> LabelingReport:
    """Count errors in the labels of a capture against the truth of the simulated take from which it comes.

    Points are matched by frame and position, within 0.001 [m]. Slots are those of all hands of the truth. A
    point missing in the capture counts as one without a label; a point missing in the truth, or of a rigid
    body, counts as a ghost.

    Args:
        labeled: A labeled capture with columns `ThumbTip` or `right:ThumbTip`, a tracked take, or the path of
            one. Columns without a side are assigned, in each frame, to the hand with more right labels.
        truth: The take with its truth, or its path.

    Returns:
        Figures as shares in [0, 1], by name, and the underlying counts, with the numbers of points that only
        one of the two has. Marker files have no confidence, so figures on it are NaN.

    Raises:
        ArgumentError: An argument is of another type.
        CaptureError: A file cannot be read, the two are not of one capture, or a marker has not one column.
    """
    check_type("labeled", labeled, (Take, Capture, str, Path), "a Take or Capture, or the path of one")
    check_type("truth", truth, (Take, str, Path), "a Take, or the path of one")
    actual, given = _simulated_take(truth), labeled
    if not isinstance(given, Take | Capture):
        given = load_take(given) if Path(given).suffix == ".npz" else read_capture(given)
    what, expected = _name_of(labeled), "expected the labels and the truth of one capture"
    if given.num_frames != actual.num_frames:
        raise CaptureError(
            f"{what} has {given.num_frames} frames and {_name_of(truth)} {actual.num_frames}, {expected}"
        )
    if isinstance(given, Take):
        points, columns = given.point_list, given.label_names
    else:
        shape, columns = given.positions.shape[:2], given.names
        numbers, nothing = np.broadcast_to(np.arange(shape[1]), shape), np.full(shape, np.nan)
        points = PointList.of_tables(given.positions, np.full(shape, -1), numbers, nothing)
    true_points, names = actual.point_list, actual.label_names[: actual.hand_labels[-1].stop]
    partner = _matched_points(points, true_points)
    alone = partner < 0
    if alone.sum() > (1.0 - _LEAST_SHARED_POINTS) * len(alone):
        raise CaptureError(
            f"{what} shares {(~alone).sum()} of its {len(alone)} points with {_name_of(truth)}, {expected}"
        )
    # The points of the truth, and after them those that only the capture has.
    count = len(true_points.labels)
    true = np.full(count + alone.sum(), -1)
    true[:count] = np.where(true_points.labels < len(names), true_points.labels, -1)
    partner[alone] = np.arange(count, len(true))
    labels, confidence = np.full(len(true), -1), np.full(len(true), np.nan)
    labels[partner] = _labels_of_columns(points, columns, true[partner], actual, what)
    confidence[partner] = points.confidence
    frames = np.concatenate([true_points.frames, points.frames[alone]])
    order = np.argsort(frames, kind="stable")
    starts = np.searchsorted(frames[order], np.arange(1, given.num_frames))
    by_frame = (np.split(one[order], starts) for one in (labels, confidence, true))
    report = count_labels(names, zip(*by_frame, strict=True))
    report.numbers["points_of_truth_alone"] = count - int((~alone).sum())
    report.numbers["points_of_capture_alone"] = int(alone.sum())
    return dataclasses.replace(report, groups=actual.times.astype(np.int64), grouped_by="seconds")


def _matched_points(points: PointList, others: PointList) -> Int[np.ndarray, "P"]:
    """Index of each point's partner among the others, one to one by frame and position; -1 for none."""
    mine, theirs = (np.column_stack([one.points, one.frames]) for one in (points, others))
    distance, nearest = cKDTree(theirs).query(mine, distance_upper_bound=_SAME_POINT_DISTANCE)
    order = np.argsort(distance, kind="stable")
    taken, first = np.unique(nearest[order], return_index=True)
    there = taken < len(theirs)
    partner = np.full(len(mine), -1)
    partner[order[first[there]]] = taken[there]
    return partner


def _labels_of_columns(
    points: PointList, columns: Sequence[str], true: Int[np.ndarray, "P"], actual: Take, what: str
) -> Int[np.ndarray, "P"]:
    """Convert point labels that number columns of these names to labels of the true take's hands."""
    known = {name: label for label, name in enumerate(actual.label_names[: actual.hand_labels[-1].stop])}
    options = np.full((len(actual.hands), len(columns) + 1), -1)  # last entry: points without a label
    absent = np.zeros(len(columns) + 1, dtype=np.bool_)  # columns of hands missing in the truth
    for column, name in enumerate(columns):
        side, marker = (part.strip() for part in name.rpartition(":")[::2])
        absent[column] = side in SIDES and side not in actual.sides
        for hand, of in enumerate(actual.sides):
            options[hand, column] = known.get(f"{side if side in actual.sides else of}:{marker}", -1)
    held = options[0, (options[0] >= 0) & ~absent]
    if len(held) == 0 or len(set(held)) < len(held):
        found = "two columns of one marker" if len(held) else "no columns of markers"
        raise CaptureError(
            f"{what} has {found}, expected one for each of {', '.join(known)}, with or without the side"
        )
    choices = options[:, points.labels]
    fitting = np.stack(
        [np.bincount(points.frames[one == true], minlength=actual.num_frames) for one in choices]
    )
    labels: NDArray[np.int64] = choices[fitting.argmax(axis=0)[points.frames], np.arange(len(true))]
    # A marker assigned to a hand that is not in the truth is a mistake, whatever its name.
    return np.where(absent[points.labels] & (true >= 0), -1, labels)
