"""The interface of every labeler, without torch: from points of a frame to labels and confidences.

`OwnLabeler` wraps a user's labeler with checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import platformdirs
from jaxtyping import Bool, Float, Float32, Int
from numpy.typing import NDArray

from gloves.captures.capture import check_unit
from handsim._checks import as_numbers, check_count
from handsim._plugins import call_plugin, load_plugin, plugin_name
from handsim._process import with_own_numerics
from handsim.errors import ArgumentError, WeightsError
from train.labelers.matching import match_scores
from train.labelers.pose_prior import PosePrior

LABELERS: Final = "handsim.labelers"
"""Group of entry points for labelers."""
LEARNED: Final = ".safetensors"
"""Ending of the files in `learned_folder`."""
_NOUN: Final = "labeler"
MAX_POINTS: Final = 512
MOST_THREADS: Final = 1024
_PAIRS: Final = 1 << 18  # largest number of pairs of points in a batch; memory grows with it
_threads: ContextVar[int] = ContextVar("threads of labelers", default=1)


@dataclass(frozen=True, slots=True, eq=False)
class Labeling:
    """Labels of one frame's points."""

    labels: Int[np.ndarray, "N"]
    """Index of each point's marker in the layout, -1 for a ghost; no index occurs twice."""
    confidence: Float[np.ndarray, "N"]
    """Confidence of each label, a probability from 0 to 1."""


class Labeler(Protocol):
    """Labels the points of frames, each frame by itself."""

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers of the labeler, in label order."""
        ...

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points (N, 3) [m] of every frame; a frame may be empty.

        Raises:
            ArgumentError: A frame is not (N, 3), not finite, not in meters, or holds more than 512 points.
        """
        ...


def checked_names(names: object) -> tuple[str, ...]:
    """Validate marker names from a file; a ValueError unless they are distinct strings."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("marker_names is not a list of names")
    if len(set(names)) < len(names) or not names:
        raise ValueError("marker_names names a marker twice, or none")
    return tuple(names)


@with_own_numerics
def label_in_batches(
    frames: Sequence[Float[np.ndarray, "N 3"]], label: Callable[[list[NDArray[np.float64]]], list[Labeling]]
) -> list[Labeling]:
    """Validate frames, and label them in batches of similar size, so that padding stays small."""
    clouds = check_clouds(frames)
    order = sorted(range(len(clouds)), key=lambda number: -len(clouds[number]))
    results = [Labeling(np.zeros(0, dtype=np.int64), np.zeros(0)) for _ in clouds]
    first = 0
    while first < len(order) and (longest := len(clouds[order[first]])):
        chosen = order[first : first + min(256, max(1, _PAIRS // longest**2))]
        first += len(chosen)
        for number, labeling in zip(chosen, label([clouds[number] for number in chosen]), strict=True):
            results[number] = labeling
    return results


def check_clouds(frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[NDArray[np.float64]]:
    """The points of every frame [m], validated as `Labeler.label_frames` describes."""
    clouds = [as_numbers(f"frame {number}", points) for number, points in enumerate(frames)]
    for frame, cloud in enumerate(clouds):
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise ArgumentError(f"frame {frame} has shape {cloud.shape}, expected (N, 3)")
        if not np.isfinite(cloud).all():
            raise ArgumentError(f"frame {frame} holds NaN or infinite points; leave missing points out")
        if len(cloud) > MAX_POINTS:
            raise ArgumentError(f"frame {frame} holds {len(cloud)} points, expected at most {MAX_POINTS}")
    check_unit(clouds, only_wide=True)
    return clouds


def pad_clouds(
    clouds: Sequence[NDArray[np.float64]],
) -> tuple[Float32[np.ndarray, "B N 3"], Bool[np.ndarray, "B N"]]:
    """Clouds [m] relative to their means, padded to one length, and which points are not padding."""
    longest = max(len(cloud) for cloud in clouds)
    points = np.zeros((len(clouds), longest, 3), dtype=np.float32)
    present = np.zeros((len(clouds), longest), dtype=bool)
    for row, cloud in enumerate(clouds):
        if len(cloud):
            points[row, : len(cloud)] = cloud - cloud.mean(axis=0)  # before rounding to float32
        present[row, : len(cloud)] = True
    return points, present


def check_output(numbers: Float[np.ndarray, "..."]) -> None:
    """Raise a `WeightsError` for NaN in a network's output, which means damaged weights."""
    if np.isnan(numbers).any():
        raise WeightsError("the labeler's network outputs NaN; its weights are damaged")


def label_by_scores(
    clouds: Sequence[NDArray[np.float64]],
    point_scores: Float[np.ndarray, "B N M+1"],
    label_scores: Float[np.ndarray, "B M N+1"],
    prior: PosePrior | None,
) -> list[Labeling]:
    """Labelings from the log-probabilities of padded clouds, see `train.labelers.matching`."""
    longest = point_scores.shape[1]
    labelings = []
    for cloud, by_point, by_label in zip(clouds, point_scores, label_scores, strict=True):
        count = len(cloud)
        check_output(by_point[:count])
        check_output(by_label)
        of_points = by_label[:, [*range(count), longest]]
        labelings.append(Labeling(*match_scores(cloud, by_point[:count], of_points, prior)))
    return labelings


def learned_folder() -> Path:
    """Folder of the labelers of learned gloves; `XDG_CACHE_HOME` moves it."""
    return Path(platformdirs.user_cache_dir("handsim", appauthor=False)) / "gloves"


def learned_gloves() -> tuple[Path, ...]:
    """Files of learned gloves, the most recently used first."""
    files = learned_folder().glob(f"*{LEARNED}")
    return tuple(sorted(files, key=lambda file: file.stat().st_mtime, reverse=True))


def label_on(threads: int) -> None:
    """Set the number of threads of all labelers; the default is one."""
    check_count("threads", threads, 1, MOST_THREADS)
    _threads.set(threads)


@contextmanager
def torch_threads(count: int | None = None) -> Iterator[None]:
    """Use this many threads in torch and labelers, within the block; by default those of `label_on`.

    With torch's default of one thread per core, a small network is many times slower on a busy machine,
    because its threads wait for one another in every operation.
    """
    import torch

    count = _threads.get() if count is None else count
    before, token = torch.get_num_threads(), _threads.set(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


class OwnLabeler:
    """A user's `Labeler`, given as an object or by name, with validated results."""

    def __init__(self, labeler: Labeler | str) -> None:
        name = plugin_name(labeler)
        self._name = name
        self._labeler: Any = labeler
        if isinstance(labeler, str):
            self._labeler = load_plugin(labeler, group=LABELERS, noun=_NOUN)
        names = getattr(self._labeler, "marker_names", None)
        if not callable(getattr(self._labeler, "label_frames", None)) or not isinstance(names, list | tuple):
            raise ArgumentError(
                f"{_NOUN} '{name}' is {type(self._labeler).__name__}, expected marker_names and label_frames "
                "as train.Labeler has them"
            )
        self.marker_names: tuple[str, ...] = tuple(map(str, names))

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points (N, 3) [m] of every frame, see `Labeler`."""
        clouds = check_clouds(frames)
        returned = call_plugin(self._labeler.label_frames, self._name, _NOUN, clouds)
        if not isinstance(returned, list) or len(returned) != len(clouds):
            raise ArgumentError(f"{_NOUN} '{self._name}' returns no list of {len(clouds)} labelings")
        return [self._checked(one, len(cloud)) for one, cloud in zip(returned, clouds, strict=True)]

    def _checked(self, labeling: Any, count: int) -> Labeling:
        """Validate a labeling of `count` points."""
        owner = f"{_NOUN} '{self._name}'"
        try:
            labels = as_numbers(f"labels of {owner}", labeling.labels, None)
            confidence = as_numbers(f"confidence of {owner}", labeling.confidence)
        except AttributeError as error:
            raise ArgumentError(f"{owner} returns {type(labeling).__name__}, expected a Labeling") from error
        if labels.shape != (count,) or labels.dtype.kind not in "iu" or confidence.shape != (count,):
            raise ArgumentError(
                f"{owner} returns labels {labels.shape} of type {labels.dtype} and confidences "
                f"{confidence.shape}, expected whole numbers ({count},) and numbers ({count},)"
            )
        most = len(self.marker_names) - 1
        known = labels[labels >= 0]
        if labels.min(initial=-1) < -1 or labels.max(initial=-1) > most or len(set(known)) < len(known):
            raise ArgumentError(f"{owner} returns labels beyond -1 to {most}, or a marker twice in a frame")
        if not ((confidence >= 0.0) & (confidence <= 1.0)).all():
            raise ArgumentError(f"{owner} returns confidences that are not from 0 to 1")
        return Labeling(labels.astype(np.int64), confidence)
