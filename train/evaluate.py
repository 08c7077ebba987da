"""The evaluation of any labeler on anything whose labels are known: sets, captures, takes, or arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures.capture import Capture, select_hands
from gloves.captures.formats import find_captures, read_markers
from gloves.layout import MarkerLayout
from gloves.takes.take import Take, load_take
from handsim._checks import check_count, check_rng, check_type
from handsim.errors import ArgumentError, CaptureError
from train.data.augmentation import Corruption
from train.data.own_corruption import OwnCorruption
from train.data.shards import MANIFEST, Dataset, load_dataset
from train.glove_labeler import load_labeler
from train.labeler_evaluation import LabelingCount, Report
from train.labelers.protocol import Labeler

CLEAN: Final = Corruption(occlude=0, ghosts=0)
"""No corruption but the order of points."""
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
    check_count("every", every, 1)
    rng = np.random.default_rng(0) if rng is None else rng
    check_rng(rng)
    several = isinstance(truth, list | tuple) and not isinstance(truth, Capture | Take)
    given: list[Any] = list(truth) if several else [truth]  # type: ignore[arg-type]
    count, takes = LabelingCount(network), [one for one in given if _is_take(one)]
    if len(takes) < len(given) and takes:
        raise CaptureError(
            f"given {_shown(takes[0])} and other kinds of truth, expected one kind; evaluate each alone"
        )
    for one in takes:
        take = one if isinstance(one, Take) else load_take(one)
        if take.made_by_tracker:
            raise CaptureError(f"{_shown(one)}: a tracked take, expected the truth of a simulated capture")
        if corruption != CLEAN or every > 1:
            raise CaptureError(
                "a simulated take is counted whole, with its own gaps and ghosts: leave out the corruption "
                "(--occlude, --ghosts) and every (--every), which labeled captures take"
            )
        for hand in take.hands:
            _check_markers("the take's glove", hand.layout.names, network.marker_names)
        count.add_take(take)
    if not takes:
        count.add_markers(_markers(given, network.marker_names)[::every], corruption, rng=rng)
    report = count.report()
    if not report.confusion[:-1].any() and not all(isinstance(one, np.ndarray) for one in given):
        raise CaptureError(
            f"nothing to count: no frame holds any of {', '.join(network.marker_names)}, expected labeled "
            "captures"
        )
    return report


def _shown(take: Any) -> str:
    """A take as sentences name it."""
    return str(take) if isinstance(take, str | Path) else "the take"


def _is_take(truth: Any) -> bool:
    return isinstance(truth, Take) or (isinstance(truth, str | Path) and Path(truth).suffix == ".npz")


def _markers(truth: Sequence[Any], names: tuple[str, ...]) -> Float[np.ndarray, "T M 3"]:
    """The markers of all that was given [m], in the labeler's order."""
    parts = []
    for one in truth:
        if isinstance(one, np.ndarray):
            count = len(names)
            if one.ndim != 3 or one.shape[1:] != (count, 3) or one.dtype.kind not in "fiu":
                raise ArgumentError(
                    f"markers are {one.dtype} of shape {one.shape}, expected (T, {count}, 3) numbers [m]"
                )
            parts.append(one.astype(np.float64))
        elif isinstance(one, Capture):
            parts += select_hands(one, names)
        elif isinstance(one, Dataset) or (isinstance(one, str | Path) and (Path(one) / MANIFEST).is_file()):
            dataset = load_dataset(one)
            _check_markers(f"the set {dataset.path}", dataset.marker_names, names)
            markers: NDArray[np.float64] = dataset.rows()["markers"].astype(np.float64)
            parts.append(markers)
        else:
            expected = "markers (T, M, 3) [m], a Dataset, Capture or Take, or the path of one"
            check_type("truth", one, (str, Path), expected)
            parts.append(read_markers(find_captures([Path(one)]), names))
    if not parts:
        raise CaptureError("no capture was given, expected labeled captures, folders, training sets or takes")
    return np.concatenate(parts)


def _check_markers(owner: str, has: Sequence[str], knows: Sequence[str]) -> None:
    """Refuse markers that the labeler does not know."""
    if tuple(has) != tuple(knows):
        raise CaptureError(f"{owner} has markers {', '.join(has)}, the labeler knows {', '.join(knows)}")
